"""Pairs on which an answer is easily wrong and believed, or right and doubted.

Each is drawn from a seed. What the truth is comes with it: a motion, or None where the two clouds
have nothing to do with each other, so that every answer is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import solids
from scipy.spatial.transform import Rotation

from cfr_jax.io import PointCloud

_DEGREES, _RADII = 5.0, 0.1  # what counts as right, as the confidence means it


@dataclass(frozen=True)
class HardCase:
    kind: str
    source: Any
    target: Any
    truth: np.ndarray | None
    """Maps source onto target; None where nothing does."""
    points: np.ndarray
    """The source's points without what was done to spoil them: to measure errors on."""
    options: dict[str, Any] = field(default_factory=dict)
    """Of `align`."""

    def right(self, transform: np.ndarray) -> bool:
        """Within 5 degrees and a tenth of the source's radius."""
        if self.truth is None:
            return False
        center = self.points.mean(axis=0)
        radius = np.linalg.norm(self.points - center, axis=1).max()
        found, wanted = (solids.move(motion, center[None])[0] for motion in (transform, self.truth))
        scale = np.cbrt(np.linalg.det(transform[:3, :3]) / np.linalg.det(self.truth[:3, :3]))
        unscaled = [motion[:3, :3] / np.cbrt(np.linalg.det(motion[:3, :3]))
                    for motion in (transform, self.truth)]  # fmt: skip
        turned = np.degrees(Rotation.from_matrix(unscaled[0].T @ unscaled[1]).magnitude())
        off = np.linalg.norm(found - wanted) / np.cbrt(np.linalg.det(self.truth[:3, :3]))
        return bool(turned < _DEGREES and off < _RADII * radius and abs(np.log(scale)) < _RADII)


def drawn(kinds: tuple[str, ...], count: int, seed: int) -> Iterator[HardCase]:
    """`count` cases of each of the kinds."""
    for kind in kinds:
        for number in range(count):
            rng = np.random.default_rng([seed, list(KINDS).index(kind), number])
            yield KINDS[kind](kind, rng, number)


def turn(rng: np.random.Generator, most: float = 45.0) -> np.ndarray:
    """A motion of up to `most` degrees about each axis, as the network knows them."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler(
        "xyz", rng.uniform(-most, most, 3), degrees=True
    ).as_matrix()
    motion[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return motion


# --- shapes: functions that draw `count` points ---


def stack_of_boxes(seed: int) -> Callable[[int, np.random.Generator], np.ndarray]:
    """An object made of a few boxes, without a symmetry."""
    own = np.random.default_rng([seed, 7])
    sizes = own.uniform(0.15, 1.0, (4, 3))
    corners = own.uniform(0, 0.8, (4, 3))
    areas = np.stack([2 * np.prod(np.delete(sizes, axis, 1), axis=1) for axis in range(3)], axis=1)

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        place = rng.choice(12, count, p=areas.ravel() / areas.sum())
        box, axis = place // 3, place % 3
        unit = rng.random((count, 3))
        unit[np.arange(count), axis] = rng.integers(0, 2, count)
        return corners[box] + unit * sizes[box]

    return draw


def of_revolution(profile: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Callable:
    """A surface whose radius and height follow a parameter in [0, 1], drawn by area."""
    along = np.linspace(0, 1, 2001)
    radius, height = profile(along)
    area = np.hypot(np.gradient(radius), np.gradient(height)) * np.abs(radius)
    share = np.cumsum(area) / area.sum()

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        radii, heights = profile(np.interp(rng.random(count), share, along))
        angle = rng.uniform(0, 2 * np.pi, count)
        return np.stack([radii * np.cos(angle), radii * np.sin(angle), heights], axis=1)

    return draw


REVOLVED = {
    "cone": of_revolution(lambda t: (t, 2 * (1 - t))),
    "torus": of_revolution(
        lambda t: (1 + 0.35 * np.cos(2 * np.pi * t), 0.35 * np.sin(2 * np.pi * t))
    ),
    "cylinder": of_revolution(lambda t: (0.5 + 0 * t, 2 * t)),
    "sphere": of_revolution(lambda t: (np.sin(np.pi * t), np.cos(np.pi * t))),
    "disk": of_revolution(lambda t: (t, 0 * t)),
    "spheroid": of_revolution(lambda t: (0.6 * np.sin(np.pi * t), np.cos(np.pi * t))),
    "vase": of_revolution(lambda t: (0.5 + 0.25 * np.sin(5 * t), 2 * t)),
    "bowl": of_revolution(lambda t: (np.sin(1.3 * t), -np.cos(1.3 * t))),
}


def street(seed: int) -> Callable[[int, np.random.Generator], np.ndarray]:
    """What a turning scanner 1.7 m above a street sees within 50 m: ground, fronts, cars, poles."""
    own = np.random.default_rng([seed, 8])
    fronts = [(side * own.uniform(6, 14), start, own.uniform(8, 18), own.uniform(5, 12))
              for side in (-1, 1) for start in np.arange(-50, 45, own.uniform(18, 26))]  # fmt: skip
    cars = own.uniform([-45, -6, 0], [45, 6, 0], (10, 3))
    poles = own.uniform([-45, -8, 0], [45, 8, 0], (12, 3))

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        away, angle = 3 * np.exp(rng.random(count) * np.log(16)), rng.uniform(-np.pi, np.pi, count)
        parts = [np.stack([away * np.cos(angle), away * np.sin(angle), 0 * away], axis=1)]
        for y, start, length, height in fronts:
            unit = rng.random((count // 12, 2))
            parts.append(np.stack([start + length * unit[:, 0], 0 * unit[:, 0] + y,
                                   height * unit[:, 1]], axis=1))  # fmt: skip
        unit = rng.random((10, count // 40, 3)) * [4, 1.8, 1.5]
        unit[..., 1] = np.where(rng.random(unit.shape[:2]) < 0.5, 0, unit[..., 1])
        parts.append((cars[:, None] + unit).reshape(-1, 3))
        parts.append(
            (poles[:, None] + rng.random((12, count // 100, 3)) * [0.2, 0.2, 6]).reshape(-1, 3)
        )
        points = np.concatenate(parts)
        return points[rng.permutation(len(points))[:count]]

    return draw


# --- kinds: functions that make a case ---


def _pair(
    kind: str,
    draw: Callable[[int, np.random.Generator], np.ndarray],
    count: int,
    rng: np.random.Generator,
    noise: float = 0.003,
    **options: Any,
) -> HardCase:
    """Two noisy samplings of a shape, the target moved."""
    source, target = (draw(count, rng) for _ in range(2))
    source, target = (points + noise * rng.normal(size=points.shape) for points in (source, target))
    truth = turn(rng)
    return HardCase(kind, source, solids.move(truth, target), truth, source, options)


def _spoiled(case: HardCase, source: Any, target: Any) -> HardCase:
    return HardCase(case.kind, source, target, case.truth, case.points, case.options)


def well_shaped(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """Nothing is wrong with it."""
    return _pair(kind, stack_of_boxes(number), (120, 500, 1000)[number % 3], rng)


def revolution(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """A solid of revolution, drawn twice: it turns about its axis."""
    draw = list(REVOLVED.values())[number % len(REVOLVED)]
    return _pair(kind, draw, (60, 120, 500, 2000)[number // len(REVOLVED) % 4], rng)


def noise(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """Ten random points each, which have nothing to do with each other."""
    source, target = rng.normal(size=(2, 10, 3))
    return HardCase(kind, source, target, None, source)


def wrong_normals(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """Normals that are placeholders, colors, or chance."""
    case = _pair(kind, stack_of_boxes(100 + number), 500, rng)

    def normals(count: int) -> np.ndarray:
        match number % 4:
            case 0:
                return np.tile([0.0, 0.0, 1.0], (count, 1))
            case 1:
                return rng.normal(size=(count, 3))
            case 2:  # colors
                return rng.uniform(0.01, 1, (count, 3))
            case _:  # gray
                return np.ones((count, 3)) * rng.uniform(0.2, 1, (count, 1))

    source, target = (
        PointCloud(points, normals(len(points))) for points in (case.source, case.target)
    )
    return _spoiled(case, source, target)


def strays(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """One or two percent of the points lie 200 to 1,000 units away."""
    case = _pair(kind, stack_of_boxes(200 + number), 500, rng)

    def thrown(points: np.ndarray) -> np.ndarray:
        away = rng.normal(size=(len(points) // (100, 50)[number % 2], 3))
        away *= rng.uniform(200, 1000, (len(away), 1)) / np.linalg.norm(away, axis=1, keepdims=True)
        points = points.copy()
        points[: len(away)] = away
        return points

    return _spoiled(case, thrown(case.source), thrown(case.target))


def duplicates(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """Every point many times."""
    case = _pair(kind, stack_of_boxes(300 + number), 500, rng)
    return _spoiled(case, *(np.repeat(points, 20, axis=0) for points in (case.source, case.target)))


def notched_cube(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """A cube with an eighth cut out, turned any way: all but that fits in 24 positions."""

    def draw(count: int, rng: np.random.Generator) -> np.ndarray:
        unit = rng.uniform(-1, 1, (4 * count, 3))
        axis, side = rng.integers(0, 3, 4 * count), rng.integers(0, 2, 4 * count) * 2 - 1
        unit[np.arange(4 * count), axis] = side
        cut = (unit > 0).all(axis=1)  # mirrored into the notch, which has the same area
        unit[cut] -= unit[cut] == 1
        return unit[:count]

    case = _pair(kind, draw, 500, rng)
    if number % 2:
        return case
    far = turn(rng, 180.0)
    target = solids.move(far, case.target)
    return HardCase(kind, case.source, target, far @ case.truth, case.points, {"initial": "global"})


def one_sided(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """The side of a thing that one view shows, and all of it."""
    case = _pair(kind, stack_of_boxes(500 + number), 1000, rng)
    toward = rng.normal(size=3)
    along = case.source @ toward
    source = case.source[along >= np.quantile(along, 0.5)]
    options = {"initial": "global"} if number % 5 == 0 else {}
    return HardCase(kind, source, case.target, case.truth, source, options)


def low_overlap(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """Two parts that share half or less of themselves."""
    case = _pair(kind, stack_of_boxes(600 + number), 1000, rng)
    toward = rng.normal(size=3)
    source = case.source[np.argsort(case.source @ toward)[:500]]
    back = solids.move(np.linalg.inv(case.truth), case.target)
    target = case.target[np.argsort(-back @ toward)[: 500 + 50 * (number % 5)]]
    return HardCase(kind, source, target, case.truth, source, case.options)


def different(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """Two different things."""
    source, target = (stack_of_boxes(700 + 2 * number + one)(500, rng) for one in (0, 1))
    return HardCase(kind, source, target, None, source)


def narrow_view(kind: str, rng: np.random.Generator, number: int) -> HardCase:
    """A street within a field of view of 90 to 180 degrees, seen again a few meters on."""
    source, target = (street(800 + number)(6000, rng) for _ in range(2))
    half = np.radians((45, 60, 75, 90)[number % 4])
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_euler("z", rng.uniform(-8, 8), degrees=True).as_matrix()
    moved[:3, 3] = [rng.uniform(1, 4), rng.uniform(-0.5, 0.5), 0]

    def seen(points: np.ndarray, to_scanner: np.ndarray) -> np.ndarray:
        points = solids.move(to_scanner, points)
        points += 0.02 * rng.normal(size=points.shape)
        ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) < half
        return points[ahead & (np.hypot(*points[:, :2].T) < 50)]

    source = seen(source, np.eye(4))
    target = seen(target, np.linalg.inv(moved))
    return HardCase(kind, source, target, np.linalg.inv(moved), source)


KINDS: dict[str, Callable[[str, np.random.Generator, int], HardCase]] = {
    "well shaped": well_shaped,
    "revolution": revolution,
    "noise": noise,
    "wrong normals": wrong_normals,
    "strays": strays,
    "duplicates": duplicates,
    "notched cube": notched_cube,
    "one-sided": one_sided,
    "low overlap": low_overlap,
    "different": different,
    "narrow view": narrow_view,
}


@dataclass
class Counts:
    """How many answers were what."""

    answers: int = 0
    right: int = 0
    wrong_and_trusted: int = 0
    right_and_doubted: int = 0

    def add(self, right: bool, trusted: bool) -> None:
        self.answers += 1
        self.right += right
        self.wrong_and_trusted += trusted and not right
        self.right_and_doubted += right and not trusted

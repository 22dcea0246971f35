"""Training pairs of shapes, drawn on the device that trains on them.

One program does what `sources.ShapeSource` and `augment` do on the host, with the same
distributions (not the same random numbers). Only the indices of the shapes are copied from the
host. A pair depends only on its shape and its key, and the key depends only on the seed and the
position in the stream. So a resumed run draws the same pairs, and so does any number of devices.

Arrays have fixed sizes here. So cropped points get a score of minus infinity, and a draw of n rows
without replacement takes the n highest random scores. Most options that are set to zero cost
nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import random
from jaxtyping import Array, Bool, Float, Float16, Int8, Int32, Key, UInt32

from cfr_jax.data.augment import SENSOR_AWAY, Sampling, shared_count
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.protocol import NOISE_CLIP, NOISE_SCALE
from cfr_jax.geometry import neighbors, rigid

_MOST = NOISE_CLIP / NOISE_SCALE  # standard deviations at which noise is clipped
_BYTE = 127  # int8 value of a normal's coordinate 1


@struct.dataclass
class Shapes:
    """A corpus in as few bytes as its precision needs: 9 for a point with its normal."""

    points: Float16[Array, "s p 3"] | Float16[np.ndarray, "s p 3"]
    normals: Int8[Array, "s p 3"] | Int8[np.ndarray, "s p 3"]
    """In units of 1/127; zero where a shape has no normal."""

    @classmethod
    def of(cls, corpus: Corpus) -> Shapes:
        """The shapes of a corpus, still in host memory.

        Rounding changes coordinates in the unit sphere by at most 2^-12, and normals by 0.3
        degrees. Raises ValueError if a coordinate is too large for float16.
        """
        most = float(np.abs(corpus.points).max())
        if most > float(np.finfo(np.float16).max):  # float(), or it would compare in float16
            raise ValueError(
                f"corpus: got a coordinate of {most:g}, wanted shapes in the unit sphere"
            )
        normals = np.rint(_BYTE * corpus.normals).astype(np.int8)
        return cls(corpus.points.astype(np.float16), normals)


class _Draw(NamedTuple):
    """The random choices that both clouds of a pair share."""

    turn: Float[Array, "3 3"]
    motion: Float[Array, "4 4"]
    scale: Float[Array, ""]
    uneven: Bool[Array, ""]
    centered: Bool[Array, ""]
    sensor: Bool[Array, ""]
    estimate: Bool[Array, ""]


def draw_pairs(
    shapes: Shapes,
    seed: UInt32[Array, ""],
    items: Int32[Array, " b"],
    positions: UInt32[Array, " b"],
    sampling: Sampling,
) -> dict[str, Array]:
    """A batch in the format of `loader.batch_at`, with arrays (b, ...).

    Pair i is made from shape `items[i]` for position `positions[i]` of the stream. `sampling` is
    static.
    """
    key = random.key(seed)

    def one(item: Array, position: Array) -> dict[str, Array]:
        return draw_pair(
            shapes.points[item], shapes.normals[item], random.fold_in(key, position), sampling
        )

    return jax.vmap(one)(items, positions)


def draw_pair(
    points: Float16[Array, "p 3"],
    normals: Int8[Array, "p 3"],
    key: Key[Array, ""],
    sampling: Sampling,
) -> dict[str, Array]:
    """A pair made from one shape, in the format of `augment.finish_pair`.

    It has both clouds (n, 3) float32, each with normals and neighbors (n, k), "transform" (4, 4),
    which maps source onto target, and "estimate_normals".
    """
    points, normals = points.astype(jnp.float32), normals.astype(jnp.float32)
    length = jnp.sqrt(jnp.sum(normals * normals, axis=1, keepdims=True))
    normals = normals / jnp.maximum(length, 1)
    of_pair, of_sides = random.split(key)
    if sampling.copied:
        score = random.uniform(random.fold_in(of_pair, 1), (len(points),))
        rows = jnp.argsort(score)[: shared_count(sampling, len(points))]
        points, normals = points[rows], normals[rows]
    drawn = _decide(of_pair, sampling)

    def cloud(key: Array, placed: Array) -> tuple[Array, Array, Array]:
        return _cloud(points, normals, placed, drawn, key, sampling)

    # both clouds at once, which takes half as many kernels
    placed = jnp.stack([drawn.motion, jnp.eye(4)])
    x, n, middle = jax.vmap(cloud)(random.split(of_sides, 2), placed)
    found = jax.vmap(lambda x: neighbors.nearest(x, sampling.neighbors, radius=sampling.radius))(x)
    back = rigid.invert(drawn.motion)
    shift = rigid.rotate(back, middle[:1])[0] + back[:3, 3] - middle[1]
    pair = {
        "transform": rigid.from_parts(back[:3, :3], shift),
        "estimate_normals": drawn.estimate,
    }
    for row, side in enumerate(("source", "target")):
        pair |= {side: x[row], f"{side}_normals": n[row], f"{side}_neighbors": found[row]}
    return pair


def _decide(key: Key[Array, ""], sampling: Sampling) -> _Draw:
    of_flags, of_turn, of_scale, of_motion = random.split(key, 4)
    shares = ("any_orientation", "uneven", "centered", "sensor_noise", "estimated_normals")
    limits = jnp.array([getattr(sampling, name) for name in shares])
    turned, uneven, centered, sensor, estimate = random.uniform(of_flags, (5,)) < limits
    turn = jnp.eye(3)
    if sampling.any_orientation:
        turn = jnp.where(turned, rigid.from_quaternion(random.normal(of_turn, (4,))), turn)
    return _Draw(
        turn=turn,
        motion=_motion(of_motion, sampling),
        scale=_between(of_scale, sampling.scale),
        uneven=uneven,
        centered=centered,
        sensor=sensor,
        estimate=estimate,
    )


def _motion(key: Key[Array, ""], sampling: Sampling) -> Float[Array, "4 4"]:
    of_flags, of_angles, of_shift = random.split(key, 3)
    both_ways, near, factor = random.uniform(of_flags, (3,))
    factor = jnp.where(near < sampling.near, factor, 1)
    most = factor * np.float32(np.deg2rad(sampling.angle))
    share = random.uniform(of_angles, (3,))
    share = jnp.where(both_ways < sampling.both_ways, 2 * share - 1, share)
    (sx, sy, sz), (cx, cy, cz) = jnp.sin(most * share), jnp.cos(most * share)
    # Rx Ry Rz, multiplied out
    rotation = jnp.array(
        [
            [cy * cz, -cy * sz, sy],
            [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
            [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
        ]
    )
    shift = random.uniform(of_shift, (3,), minval=-1, maxval=1)
    return rigid.from_parts(rotation, factor * np.float32(sampling.translation) * shift)


def _cloud(
    points: Float[Array, "p 3"],
    normals: Float[Array, "p 3"],
    placed: Float[Array, "4 4"],
    drawn: _Draw,
    key: Key[Array, ""],
    sampling: Sampling,
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, " 3"]]:
    """Points and normals of one side, and the offset that was subtracted to center it."""
    of_rows, of_noise, of_outliers = random.split(key, 3)
    rows = _rows(points, drawn.uneven, of_rows, sampling)
    rotation = rigid.from_parts(drawn.turn, jnp.zeros(3))
    x = drawn.scale * rigid.rotate(rotation, points[rows])
    x = rigid.apply(placed, x)
    n = rigid.rotate(placed, rigid.rotate(rotation, normals[rows]))
    noisy = _add_noise(x, of_noise, sampling)
    if sampling.sensor_noise:
        noisy = jnp.where(drawn.sensor, _add_sensor_noise(x, of_noise, sampling), noisy)
    x = noisy
    if sampling.outliers[1]:
        x, n = _add_outliers(x, n, of_outliers, sampling)
    middle = jnp.where(drawn.centered, jnp.mean(x, axis=0), 0)
    return x - middle, n, middle


def _rows(
    points: Float[Array, "p 3"], uneven: Bool[Array, ""], key: Key[Array, ""], sampling: Sampling
) -> Int32[Array, " n"]:
    """Rows of one cloud: a crop, then `sampling.points` of its rows, as in `augment.choose_rows`.

    If the crop leaves too few rows, all of them are used and some are repeated.
    """
    of_keep, of_plane, of_side, of_scores, of_more = random.split(key, 5)
    count, n = points.shape[0], sampling.points
    keep = _between(of_keep, sampling.keep)
    kept = _crop(points, keep, of_plane)
    score = random.gumbel(of_scores, (count,))
    if sampling.uneven:
        height = _heights(points, of_side)
        low = jnp.min(jnp.where(kept, height, jnp.inf))
        high = jnp.max(jnp.where(kept, height, -jnp.inf))
        of_density, of_more = random.split(of_more)
        times = _between(of_density, sampling.density)
        weight = jnp.log(times) * (height - low) / jnp.maximum(high - low, 1e-12)
        score = score + jnp.where(uneven, weight, 0)
    # Gumbel noise on the log weights: the largest sums are a weighted draw without replacement.
    order = jnp.argsort(jnp.where(kept, score, -jnp.inf), descending=True)
    left = jnp.maximum(jnp.sum(kept), 1)
    place = jnp.arange(n)
    again = random.randint(of_more, (n,), 0, left)
    if sampling.uneven:
        # no row is used a third time before all are used twice
        chance = jnp.where(place < left, random.uniform(of_side, (n,)), jnp.inf)
        turns = jnp.argsort(chance)[jnp.clip(place - left, 0, n - 1)]
        again = jnp.where(uneven & (place < 2 * left), turns, again)
    return order[jnp.where(place < left, place, jnp.minimum(again, left - 1))]


def _crop(
    points: Float[Array, "p 3"], keep: Float[Array, ""], key: Key[Array, ""]
) -> Bool[Array, " p"]:
    """Which points a crop keeps: those beyond a plane with a random normal, as in `protocol.crop`.

    `keep` is the share of points that are kept.
    """
    count = points.shape[0]
    height = _heights(points - jnp.mean(points, axis=0), key)
    place = (1 - keep) * (count - 1)
    below = jnp.clip(jnp.floor(place), 0, count - 2)
    ordered, row = jnp.sort(height), below.astype(jnp.int32)
    plane = ordered[row] + (ordered[row + 1] - ordered[row]) * (place - below)
    return (height > jnp.where(keep == 0.5, 0, plane)) | (keep >= 1)


def _add_noise(
    x: Float[Array, "n 3"], key: Key[Array, ""], sampling: Sampling
) -> Float[Array, "n 3"]:
    of_scale, of_each = random.split(key)
    scale = _between(of_scale, sampling.noise)
    return x + scale * jnp.clip(random.normal(of_each, x.shape), -_MOST, _MOST)


def _add_sensor_noise(
    x: Float[Array, "n 3"], key: Key[Array, ""], sampling: Sampling
) -> Float[Array, "n 3"]:
    of_away, of_side, of_scale, of_each = random.split(key, 4)
    away = _between(of_away, SENSOR_AWAY)
    ray = x - (jnp.mean(x, axis=0) + away * _directions(of_side, 1))
    distance = jnp.maximum(jnp.sqrt(jnp.sum(ray * ray, axis=1, keepdims=True)), 1e-6)
    scale = _between(of_scale, sampling.sensor_scale)
    error = jnp.clip(random.normal(of_each, distance.shape), -_MOST, _MOST)
    return x + ray / distance * error * scale * (distance / away) ** 2


def _add_outliers(
    x: Float[Array, "n 3"], n: Float[Array, "n 3"], key: Key[Array, ""], sampling: Sampling
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    of_share, of_rows, of_radius, of_place, of_normal = random.split(key, 5)
    count = x.shape[0]
    share = _between(of_share, sampling.outliers)
    rank = jnp.argsort(random.uniform(of_rows, (count,)))
    out = (rank < jnp.floor(share * count).astype(jnp.int32))[:, None]
    middle = jnp.mean(x, axis=0)
    reach = jnp.sqrt(jnp.max(jnp.sum((x - middle) ** 2, axis=1)))
    radius = reach * jnp.cbrt(random.uniform(of_radius, (count, 1)))
    placed = middle + radius * _directions(of_place, count)
    return jnp.where(out, placed, x), jnp.where(out, _directions(of_normal, count), n)


def _between(key: Key[Array, ""], limits: tuple[float, float]) -> Float[Array, ""]:
    return random.uniform(key, minval=limits[0], maxval=limits[1])


def _heights(points: Float[Array, "p 3"], key: Key[Array, ""]) -> Float[Array, " p"]:
    """Heights along a random direction, summed in float32, which a GPU's matrix product is not."""
    return jnp.sum(points * _directions(key, 1), axis=1)


def _directions(key: Key[Array, ""], count: int) -> Float[Array, "n 3"]:
    drawn = random.normal(key, (count, 3))
    return drawn / jnp.sqrt(jnp.sum(drawn * drawn, axis=1, keepdims=True))

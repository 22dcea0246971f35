"""Reports a finished build in the caller's frames, with reasons in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.geometry import motions, twists
from cfr_jax.multiway import choosing
from cfr_jax.multiway.answers import Edge, Merged
from cfr_jax.multiway.building import Build, measured
from cfr_jax.multiway.pose_graph import placing
from cfr_jax.multiway.scans import LeftOut, Scan

# A scan whose points have a standard deviation of more than this share of its radius has no
# determined place.
_FREE = 0.2


def answer(
    names: tuple[str, ...],
    scans: Sequence[Scan],
    built: Build,
    covariances: Float[np.ndarray, "n 6 6"],
    left_out: Sequence[LeftOut],
    copies: Mapping[int, int],
    reference: int | None,
) -> Merged:
    """The answer without merged clouds and times.

    `scans` belong to the rows in `built`. `copies` maps the index of each repeated scan to the
    index of the first scan with the same points. `left_out` are the scans that could not be used.
    """
    placement = built.placement
    sizes = np.bincount(placement.component)
    free = np.array(
        [_freedom(scan, spread) for scan, spread in zip(scans, covariances, strict=True)]
    )
    held = (sizes[placement.component] > 1) & (free <= _FREE) & ~built.ambiguous
    # a component that has lost all scans but one is no component any longer
    held &= np.bincount(placement.component, held, len(sizes))[placement.component] > 1
    missing = list(left_out)
    for row in np.flatnonzero(~held).tolist():
        reason = _reason(row, scans, built, open_=bool(sizes[placement.component[row]] > 1))
        missing.append(LeftOut(scans[row].index, scans[row].name, reason))
    poses, references, labels = _in_frames(scans, built, held, reference)
    rows = {scans[row].index: row for row in np.flatnonzero(held).tolist()}
    notes = _notes(names, copies, references, labels)
    for copy, first in copies.items():
        if first in rows:
            rows[copy] = rows[first]
        else:
            missing.append(LeftOut(copy, names[copy], f"the same points as {names[first]}"))
    placed = np.array(sorted(rows), np.int64)
    order = np.array([rows[index] for index in placed.tolist()], np.int64)
    return Merged(
        names=names,
        placed=placed,
        poses=poses[order].reshape(-1, 4, 4),
        covariances=covariances[order].reshape(-1, 6, 6),
        component=labels[order],
        references=references,
        edges=tuple(_edges(scans, built, held)),
        left_out=tuple(sorted(missing, key=lambda each: each.index)),
        notes=notes,
        clouds=(),
        seconds={},
    )


def _in_frames(
    scans: Sequence[Scan], built: Build, held: np.ndarray, reference: int | None
) -> tuple[Float[np.ndarray, "n 4 4"], tuple[int, ...], Int[np.ndarray, " n"]]:
    """The poses of the caller's clouds, the reference of each component, and the component of each
    scan."""
    placement = built.placement
    labels, poses = np.full(len(scans), -1), placement.poses.copy()
    counts = np.bincount(placement.component[held], minlength=placement.component.max() + 1)
    references = []
    for number, label in enumerate(sorted(np.flatnonzero(counts), key=lambda k: (-counts[k], k))):
        rows = np.flatnonzero(held & (placement.component == label)).tolist()
        labels[rows] = number
        chosen = next((row for row in rows if scans[row].index == reference), rows[0])
        references.append(scans[chosen].index)
        back = twists.inverse(poses[chosen][None])[0]
        for row in rows:
            poses[row] = choosing.to_caller(
                back @ placement.poses[row], scans[row].center, scans[chosen].center
            )
    return poses, tuple(references), labels


def _edges(scans: Sequence[Scan], built: Build, held: np.ndarray) -> list[Edge]:
    placement, edges = built.placement, built.edges
    made = []
    for row, record in enumerate(built.records):
        source, target = int(edges.source[row]), int(edges.target[row])
        first, second = scans[source], scans[target]
        together = bool(
            held[source]
            and held[target]
            and placement.component[source] == placement.component[target]
        )
        kept = bool(placement.kept[row]) and together
        residual = distance = float("nan")
        if together:
            between = motions.inverse(placement.poses[target]) @ placement.poses[source]
            off = (between - edges.transform[row])[:3]
            moved = first.points @ off[:, :3].T + off[:, 3]
            residual = float(np.linalg.norm(moved, axis=1).mean())
            rms = measured(first, second, between)[1]
            distance = rms if np.isfinite(rms) else distance
        made.append(
            Edge(
                source=first.index,
                target=second.index,
                transform=np.array(record["transform"]),
                confidence=record["confidence"],
                kept=kept,
                residual=residual,
                distance=distance,
                reason="" if kept else _doubt(built, row, together),
            )
        )
    return made


def _doubt(built: Build, row: int, together: bool) -> str:
    """Why an edge is not kept."""
    if together:
        return "contradicts the poses"
    if built.placement.strong[row]:
        return "contradicts other edges"
    if built.confidence[row] >= placing.SURE and not built.determined[row]:
        return "the clouds do not determine the motion, and nothing confirms it"
    return f"confidence {built.confidence[row]:.2f}, and nothing confirms it"


def _reason(row: int, scans: Sequence[Scan], built: Build, open_: bool) -> str:
    """Why a scan is left out."""
    if built.ambiguous[row]:
        return "the scans fit together in more than one way: too symmetric to tell which is right"
    if open_:
        return "nothing determines its place: it slides or turns freely on the others"
    edges = built.edges
    own = np.flatnonzero((edges.source == row) | (edges.target == row))
    if not len(own):
        failed = [reason for source, target, reason in built.failures if row in (source, target)]
        return failed[0] if failed else "it was not registered with any other scan"
    best = int(own[np.argmax(built.confidence[own])])
    other = int(edges.target[best] if edges.source[best] == row else edges.source[best])
    return (
        f"no place is sure; the best registration is with {scans[other].name}: "
        f"{_doubt(built, best, False)}"
    )


def _freedom(scan: Scan, covariance: Float[np.ndarray, "6 6"]) -> float:
    """The standard deviation of a scan's points along the least certain direction, in radii."""
    size = np.array([scan.radius] * 3 + [1.0] * 3)
    worst = np.linalg.eigvalsh(covariance * np.outer(size, size))[-1]
    return float(np.sqrt(max(worst, 0.0)) / scan.radius)


def _notes(
    names: Sequence[str],
    copies: Mapping[int, int],
    references: Sequence[int],
    labels: Int[np.ndarray, " n"],
) -> tuple[str, ...]:
    notes = [
        f"{names[copy]} has the same points as {names[first]}, so they count once"
        for copy, first in copies.items()
    ]
    if len(references) > 1:
        counts = [int((labels == number).sum()) for number in range(len(references))]
        notes.append(
            f"the scans form {len(references)} models that nothing connects, of "
            f"{', '.join(map(str, counts[:-1]))} and {counts[-1]} scans"
        )
    return tuple(notes)

"""Builds a model from registered pairs: makes a pose graph of them and solves it for the poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax.multiway import choosing, contact, joint
from cfr_jax.multiway.choosing import Try
from cfr_jax.multiway.pose_graph import graph, placing
from cfr_jax.multiway.pose_graph.placing import Placement
from cfr_jax.multiway.registering import Record
from cfr_jax.multiway.scans import Scan

REACH = 3.0  # pairs of points up to this many spacings apart count for the information of an edge
PARTNERS = 6  # scans with which a scan is refined together


@dataclass(frozen=True, eq=False)
class Build:
    """Registered pairs as the edges of a graph, and the poses found from them. Here, scans are
    numbered by their row among the usable scans."""

    records: tuple[Record, ...]
    """The registration record of each edge."""
    edges: graph.Edges
    confidence: Float[np.ndarray, " e"]
    """The confidence of each edge; 0 if it is unknown."""
    determined: Bool[np.ndarray, " e"]
    """Whether the two scans of an edge determine its motion."""
    failures: tuple[tuple[int, int, str], ...]
    """The pairs that could not be registered at all: source, target, and why."""
    placement: Placement
    ambiguous: Bool[np.ndarray, " n"]
    """Whether a scan fits with its component in more than one way, so that its place is unsure."""


def build(
    scans: Sequence[Scan], tries: Sequence[Try], records: Sequence[Record], *, alone: bool
) -> Build:
    """Finds poses from registered pairs. If two scans have several records, the most confident one
    counts.

    `alone` is passed on to `placing.place`.
    """
    row_of = {scan.index: row for row, scan in enumerate(scans)}
    best: dict[frozenset[int], tuple[Try, Record]] = {}
    failures = []
    for pair, record in zip(tries, records, strict=True):
        if record["error"] is not None:
            failures.append((row_of[pair.source], row_of[pair.target], record["error"]))
            continue
        key = frozenset((pair.source, pair.target))
        if key not in best or _sureness(record) > _sureness(best[key][1]):
            best[key] = pair, record
    source, target, transforms, informations = [], [], [], []
    for pair, record in best.values():
        first, second = scans[row_of[pair.source]], scans[row_of[pair.target]]
        transform = choosing.to_centered(np.array(record["transform"]), first.center, second.center)
        source.append(row_of[pair.source])
        target.append(row_of[pair.target])
        transforms.append(transform)
        informations.append(measured(first, second, transform)[0])
    count = len(best)
    edges = graph.Edges(
        np.array(source, np.int64),
        np.array(target, np.int64),
        np.array(transforms).reshape(count, 4, 4),
        np.array(informations).reshape(count, 6, 6),
    )
    confidence = np.array([_sureness(record) for _, record in best.values()], np.float64)
    determined = np.array([record["determined"] for _, record in best.values()], bool)
    placement = placing.place(len(scans), edges, confidence, determined, alone=alone)
    radius = float(np.median([scan.radius for scan in scans]))
    others = placing.share_of_others(edges, placement, confidence, determined, radius)
    return Build(
        tuple(record for _, record in best.values()),
        edges,
        confidence,
        determined,
        tuple(failures),
        placement,
        (others > placing.MOST_OTHERS)[placement.component],
    )


def measured(
    source: Scan, target: Scan, transform: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "6 6"], float]:
    """The information matrix of a motion between two scans, and the RMS distance from the source's
    points to the target's planes."""
    reach = REACH * max(source.spacing, target.spacing)
    return contact.information(source, target, transform, reach)


def refined(
    scans: Sequence[Scan], built: Build, reference: int | None
) -> tuple[Build, Float[np.ndarray, "n 6 6"]]:
    """Refines each component as a whole. Returns the refined build and the covariance of each pose.

    The covariances come from a pose graph of all pairs that were refined together. The information
    of each pair comes from its surfaces. Covariances are relative to the `reference`, or to the
    first scan of a component without it.
    """
    placement = built.placement
    poses = placement.poses.copy()
    spread = np.zeros((len(scans), 6, 6))
    for label in np.unique(placement.component).tolist():
        rows = np.flatnonzero(placement.component == label)
        if len(rows) < 2:
            continue
        members = [scans[row] for row in rows.tolist()]
        pairs = _pairs(members, poses[rows], rows, built)
        fixed = np.array([scan.index == reference for scan in members])
        if not fixed.any():
            fixed[0] = True
        poses[rows] = joint.refine(members, poses[rows], pairs, fixed)
        spread[rows] = _covariances(members, poses[rows], pairs, fixed)
    return dataclasses.replace(built, placement=dataclasses.replace(placement, poses=poses)), spread


def _pairs(
    scans: Sequence[Scan],
    poses: Float[np.ndarray, "n 4 4"],
    rows: Int[np.ndarray, " n"],
    built: Build,
) -> Int[np.ndarray, "p 2"]:
    """The pairs to refine together: those that overlap most, and those that a kept edge
    connects."""
    place = {row: number for number, row in enumerate(rows.tolist())}
    found = {tuple(pair) for pair in choosing.overlapping(scans, poses, PARTNERS).tolist()}
    held = np.flatnonzero(built.placement.kept & built.placement.strong)
    for source, target in zip(
        built.edges.source[held].tolist(), built.edges.target[held].tolist(), strict=True
    ):
        if source in place and target in place:
            found.add(tuple(sorted((place[source], place[target]))))
    return np.array(sorted(found), np.int64).reshape(-1, 2)


def _covariances(
    scans: Sequence[Scan],
    poses: Float[np.ndarray, "n 4 4"],
    pairs: Int[np.ndarray, "p 2"],
    fixed: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, "n 6 6"]:
    between = np.linalg.inv(poses[pairs[:, 1]]) @ poses[pairs[:, 0]]
    information = [
        measured(scans[first], scans[second], motion)[0]
        for (first, second), motion in zip(pairs, between, strict=True)
    ]
    edges = graph.Edges(pairs[:, 0], pairs[:, 1], between, np.array(information).reshape(-1, 6, 6))
    return graph.covariances(edges, poses, fixed)


def _sureness(record: Record) -> float:
    return 0.0 if record["confidence"] is None else float(record["confidence"])

"""Pairs tried after the first poses are known: scans without a place, and closures of loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cfr_jax.multiway import choosing
from cfr_jax.multiway.building import Build, build
from cfr_jax.multiway.choosing import Try
from cfr_jax.multiway.pose_graph.placing import SURE
from cfr_jax.multiway.registering import ANYWHERE, Record, Registrar
from cfr_jax.multiway.scans import Scan

_CLOSING = 4  # the number of other scans with which each scan may close loops
_ENOUGH = 2  # after this many sure answers, the search for a scan ends


def searched(
    scans: Sequence[Scan],
    registrar: Registrar,
    tries: list[Try],
    records: list[Record],
    alone: bool,
) -> tuple[list[Try], list[Record], Build]:
    """Tries the scans outside the largest component from all rotations, one after the other.
    Returns all tries, all records, and the new build.

    A search takes several times as long as a plain registration, so it ends for each scan as soon
    as the scan has found its place.
    """
    built = build(scans, tries, records, alone=alone)
    for row in np.flatnonzero(built.placement.component > 0).tolist():
        if built.placement.component[row] == 0:
            continue
        others = np.flatnonzero(built.placement.component != built.placement.component[row])
        sure = 0
        for other in others.tolist():
            [pair] = choosing.all_pairs([scans[row], scans[other]])
            tries, records = [*tries, pair], [*records, *registrar.records([pair], ANYWHERE)]
            sure += (records[-1]["confidence"] or 0.0) >= SURE
            if sure >= _ENOUGH:
                break
        built = build(scans, tries, records, alone=alone)
    return tries, records, built


def closures(scans: Sequence[Scan], tries: Sequence[Try], built: Build) -> list[Try]:
    """Pairs of one component that overlap under its poses but were not tried yet."""
    known = {frozenset((pair.source, pair.target)) for pair in tries}
    made = []
    placement = built.placement
    for label in np.unique(placement.component):
        rows = np.flatnonzero(placement.component == label)
        members = [scans[row] for row in rows.tolist()]
        made += choosing.brought_together(members, placement.poses[rows], known, _CLOSING)
    return made

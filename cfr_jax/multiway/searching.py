"""Pairs that are tried once first poses are known: scans without a place, and closures of loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cfr_jax.multiway import choosing
from cfr_jax.multiway.building import Build, build
from cfr_jax.multiway.choosing import Try
from cfr_jax.multiway.pose_graph.placing import SURE
from cfr_jax.multiway.registering import ANYWHERE, Record, Registrar
from cfr_jax.multiway.scans import Scan

_CLOSING = 4  # other scans with which a scan may close loops
_ENOUGH = 2  # answers of a search that are sure: then a scan needs no more


def searched(
    scans: Sequence[Scan],
    registrar: Registrar,
    tries: list[Try],
    records: list[Record],
    alone: bool,
) -> tuple[list[Try], list[Record], Build]:
    """The same with more tries: scans that are not in the largest component are tried from all
    rotations, one after the other. A search takes some times as long, and a scan that has found its
    place needs no other."""
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
    """Pairs that were not tried, and overlap where the poses of a component lay them."""
    known = {frozenset((pair.source, pair.target)) for pair in tries}
    made = []
    placement = built.placement
    for label in np.unique(placement.component):
        rows = np.flatnonzero(placement.component == label)
        members = [scans[row] for row in rows.tolist()]
        made += choosing.brought_together(members, placement.poses[rows], known, _CLOSING)
    return made

"""Nudges are scaled up until they move the points as far as those of an object."""

import numpy as np
import pytest
import solids

from cfr_jax.alignment import doubts, measuring

RNG = np.random.default_rng(0)


def test_what_lies_near_the_axis_is_nudged_further_until_it_resists(monkeypatch):
    # given a long, thin bar: under a turn about its length, points move by a tenth of the angle
    source, target = (RNG.uniform(-1, 1, (800, 3)) * [1.0, 0.12, 0.06] for _ in range(2))
    about = np.eye(6)[:1]

    (found,) = measuring.resistance(source, target, np.eye(4), about)
    monkeypatch.setattr(measuring, "_FARTHEST", 1)  # nudged by the usual size only
    (usual,) = measuring.resistance(source, target, np.eye(4), about)

    assert usual < doubts.FREE < found


@pytest.mark.parametrize("twist", [[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1]])
def test_a_tube_is_still_free_when_nudged_further(twist):
    source, target = (solids.cylinder(500, seed).points for seed in (0, 1))

    assert measuring.resistance(source, target, np.eye(4), np.array([twist], float)) < doubts.FREE

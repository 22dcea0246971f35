"""A second look at doubtful answers: when it is taken, and that it never makes one worse."""

import dataclasses

import numpy as np
import pytest
import solids

from cfr_jax.alignment import doubts, search, starts
from cfr_jax.alignment.align import align
from cfr_jax.alignment.case import Search
from cfr_jax.alignment.planning import planned
from cfr_jax.batch.stream import align_many

TURN = solids.motion(90, (-1, 1, 0))


@pytest.fixture(scope="module")
def pair():
    """A pair whose turn is larger than the network can find from where the source lies."""
    return solids.two_samplings(256, TURN)


@pytest.fixture(scope="module")
def looked(pair):
    return align(*pair)


def test_a_pair_turned_too_far_for_one_start_is_found(pair, looked):
    once = align(*pair, second_look=False)

    assert once.confidence < doubts.TRUSTED and solids.degrees_between(once.transform, TURN) > 20
    assert looked.confidence > doubts.TRUSTED and solids.degrees_between(looked.transform, TURN) < 3
    assert once.starts == 1 and once.initial is None
    assert looked.starts == len(starts.around()) and looked.initial is not None
    assert not len(looked.alternatives)


def test_the_answer_is_the_one_that_a_start_given_by_hand_finds(pair, looked):
    again = align(*pair, initial=looked.initial)

    assert solids.degrees_between(again.transform, looked.transform) < 0.5
    np.testing.assert_allclose(again.transform[:3, 3], looked.transform[:3, 3], atol=0.01)


def test_many_pairs_are_looked_at_as_each_alone(pair, looked):
    easy = pair[0], solids.move(solids.motion(10), pair[0])

    outcomes = [outcome.alignment for outcome in align_many([pair, easy])]

    np.testing.assert_allclose(outcomes[0].transform, looked.transform, atol=1e-4)
    assert [outcome.starts for outcome in outcomes] == [looked.starts, 1]
    (first,) = align_many([pair], second_look=False)
    assert first.alignment.starts == 1


def test_a_start_that_somebody_gave_is_kept(pair):
    found = align(*pair, initial=np.eye(4))

    assert found.starts == 1 and found.confidence < doubts.TRUSTED


def test_what_is_less_likely_right_is_not_taken(pair, monkeypatch):
    # given a pair that needs no second look, but is forced to take one, from a half turn
    easy = pair[0], solids.move(solids.motion(10), pair[0])
    once = align(*easy)
    half = np.array([np.diag([1.0, -1.0, -1.0, 1.0])])
    asked = []

    def worse(case, starts, beside, nearby):
        asked.append(len(starts))
        found = Search(half, half, np.ones(1), case.plan.frames, len(starts), nearby)
        return dataclasses.replace(case, searched=found)

    monkeypatch.setattr(search, "tried", worse)
    monkeypatch.setattr(doubts, "TRUSTED", 2.0)

    # when
    found = align(*easy)

    # then
    assert asked == [len(starts.around())]
    assert found.confidence == once.confidence
    np.testing.assert_array_equal(found.transform, once.transform)


def test_a_plan_started_elsewhere_is_the_plan_of_a_moved_source(pair):
    plan, motion = planned(*pair), solids.motion(30, (0, 1, 1), (0.1, 0.2, -0.1))

    moved = plan.started_at(motion)

    np.testing.assert_allclose(
        moved.source.points, solids.move(motion, plan.source.points), atol=1e-6
    )
    # a motion of the moved source is the same motion of the first plan's source after `motion`
    unit = solids.motion(-20, (1, 0, 0), (0, 0.3, 0))
    np.testing.assert_allclose(
        moved.frames.to_caller(unit), plan.frames.to_caller(unit @ motion), atol=1e-9
    )
    assert moved.start_given and not plan.start_given

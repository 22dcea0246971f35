"""`align_many`: the answers of `align`, whatever the order, the batch and the neighbors in it.

All clouds have 65 to 128 points, so that one compiled program serves them.
"""

from __future__ import annotations

import threading

import batch_samples
import jax
import numpy as np
import pytest

import cfr_jax
from cfr_jax import io
from cfr_jax.alignment.align import align
from cfr_jax.batch import device, stream
from cfr_jax.batch.memo import Memo
from cfr_jax.batch.stream import align_many
from cfr_jax.geometry import units

PAIRS = [batch_samples.pair(i) for i in range(5)]


def same(outcome, wanted):
    np.testing.assert_allclose(outcome.alignment.transform, wanted.transform, atol=1e-5)
    np.testing.assert_allclose(outcome.alignment.transforms, wanted.transforms, atol=1e-5)
    np.testing.assert_allclose(outcome.alignment.weights, wanted.weights, atol=1e-5)
    assert outcome.alignment.confidence == pytest.approx(wanted.confidence, abs=1e-3)
    assert outcome.alignment.fitness == pytest.approx(wanted.fitness, abs=0.02)
    assert outcome.alignment.source_rows.tolist() == wanted.source_rows.tolist()


@pytest.fixture(scope="module")
def one_by_one():
    return [align(*pair, refine=False) for pair in PAIRS]


@pytest.mark.parametrize("batch", [1, 2])
def test_ragged_pairs_are_answered_in_order_as_align_answers_each(batch, one_by_one):
    # when: five pairs in batches of two leave one over
    outcomes = list(align_many(iter(PAIRS), refine=False, batch=batch, workers=2))

    # then
    assert [outcome.index for outcome in outcomes] == [0, 1, 2, 3, 4]
    assert all(outcome.error is None for outcome in outcomes)
    for outcome, wanted in zip(outcomes, one_by_one, strict=True):
        same(outcome, wanted)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 2])
def test_refined_answers_are_those_of_align(batch):
    outcomes = list(align_many(PAIRS[:3], batch=batch))
    for outcome, pair in zip(outcomes, PAIRS, strict=False):
        same(outcome, align(*pair))
    assert any(outcome.alignment.refined for outcome in outcomes)


def test_a_pair_that_has_no_answer_stops_no_other(tmp_path, one_by_one):
    # given: an empty file, a cloud in one place, a missing file, and a function that breaks
    (tmp_path / "empty.ply").write_bytes(b"")

    def breaks():
        raise RuntimeError("the sensor is off")

    wrong = [
        (tmp_path / "empty.ply", PAIRS[0][1]),
        (np.ones((80, 3)), PAIRS[0][1]),
        (PAIRS[0][0], tmp_path / "missing.ply"),
        breaks,
        (PAIRS[0][0],),
    ]

    # when
    outcomes = list(align_many([*wrong, lambda: PAIRS[1]], refine=False, batch=2))

    # then
    told = "is empty", "in one place", "missing.ply", "RuntimeError: the sensor is off", "pair:"
    for said, outcome in zip(told, outcomes, strict=False):
        assert said in outcome.error and outcome.alignment is None
    same(outcomes[-1], one_by_one[1])


def test_a_start_may_come_with_the_pair(one_by_one):
    initial = np.eye(4)
    initial[:3, 3] = (0.3, 0.0, 0.1)
    [outcome] = align_many([(*PAIRS[0], initial)], refine=False, batch=1)
    same(outcome, align(*PAIRS[0], initial=initial, refine=False))


def test_one_target_of_many_sources_is_read_prepared_and_encoded_once(tmp_path, monkeypatch):
    # given: five views, all smaller than the one file they lie on
    target = 2 * PAIRS[0][1]
    io.write(tmp_path / "target.ply", io.PointCloud(target))
    pairs = [(source, tmp_path / "target.ply") for source, _ in PAIRS]
    counts = {"read": 0, "unit": 0, "encoded": 0}
    lock = threading.Lock()

    def counted(name, function, is_it=lambda *_, **__: True):
        def call(*args, **options):
            with lock:
                counts[name] += is_it(*args, **options)
            return function(*args, **options)

        return call

    is_target = lambda cloud, *_, **__: getattr(cloud, "name", "") == "target.ply"  # noqa: E731
    read = counted("read", stream.as_point_cloud)
    monkeypatch.setattr(stream, "as_point_cloud", read)
    monkeypatch.setattr(units, "to_unit", counted("unit", units.to_unit, is_target))
    compiled = device.programs.compiled
    monkeypatch.setattr(
        device.programs,
        "compiled",
        counted("encoded", compiled, lambda function, *_, **__: function is device.encode_target),
    )

    # when
    outcomes = list(align_many(pairs, refine=False, batch=2, workers=3))

    # then
    assert counts == {"read": 1, "unit": 1, "encoded": 1}
    for outcome, (source, _) in zip(outcomes, PAIRS, strict=True):
        same(outcome, align(source, target, refine=False))


class Quick(device.Device):
    """A device that answers with the size of the source."""

    def __init__(self, params, refine, second_look, size):
        self.size, self.calls = size, []
        Quick.last = self

    def solve(self, plans):
        self.calls.append([len(plan.source.rows) for plan in plans])
        return [None] * len(plans)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(stream, "Device", Quick)


def sized(*counts):
    rng = np.random.default_rng(0)
    return [(rng.normal(size=(n, 3)), rng.normal(size=(n, 3))) for n in counts]


def test_clouds_of_one_padded_size_share_a_batch(quick):
    list(align_many(sized(90, 150, 100, 151, 110), batch=2))
    assert Quick.last.calls == [[90, 100], [150, 151], [110]]


def test_outcomes_come_in_order_or_as_they_are_done(quick):
    pairs = sized(90, 150, 100)
    as_done = [o.index for o in align_many(pairs, batch=2, ordered=False)]
    in_order = [o.index for o in align_many(pairs, batch=2)]
    assert as_done == [0, 2, 1] and in_order == [0, 1, 2]


def test_a_rare_size_does_not_wait_for_ever(quick):
    # given: one large pair, and many more small ones than may wait
    pairs = sized(300, *range(2, 63))

    # when: every small size is a program of its own
    order = [o.index for o in align_many(pairs[:40], batch=3, ordered=False)]

    # then
    assert sorted(order) == list(range(40)) and order.index(0) < 30


def test_pairs_are_drawn_only_as_they_are_needed(quick):
    drawn = []

    def endless():
        for pair in sized(90) * 10_000:
            drawn.append(pair)
            yield pair

    outcomes = align_many(endless(), batch=1, workers=2)
    next(outcomes)
    outcomes.close()
    assert len(drawn) < 10
    assert not [t for t in threading.enumerate() if t.name.startswith("cfr-read") and t.is_alive()]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"batch": 0}, "batch: got 0"),
        ({"workers": 1.5}, "workers: got 1.5"),
        ({"max_points": 2}, "max_points: got 2"),
        ({"seed": -1}, "seed: got -1"),
        ({"params": "object"}, "params: got a str"),
    ],
)
def test_wrong_options_are_refused_before_any_pair_is_drawn(options, said, unchecked):
    with pytest.raises(ValueError, match=said):
        align_many(iter([]), **options)


def test_no_pairs_are_no_outcomes(quick):
    assert list(cfr_jax.align_many([])) == []


def test_whoever_asks_for_a_value_that_is_being_made_waits_for_it():
    # given
    memo, entered, go = Memo(2), threading.Event(), threading.Event()

    def make():
        entered.set()
        go.wait(5)
        return object()

    got = []
    threads = [threading.Thread(target=lambda: got.append(memo.get("a", make))) for _ in range(3)]

    # when
    for thread in threads:
        thread.start()
    entered.wait(5)
    go.set()
    for thread in threads:
        thread.join()

    # then
    assert len(got) == 3 and len(set(map(id, got))) == 1


def test_a_value_that_could_not_be_made_is_tried_again():
    memo = Memo(2)
    with pytest.raises(ZeroDivisionError):
        memo.get("a", lambda: 1 / 0)
    assert memo.get("a", lambda: 2) == 2
    assert [memo.get(key, lambda: 3) for key in "bc"] == [3, 3]
    assert memo.get("a", lambda: 4) == 4  # only the last two are kept


def test_on_a_cpu_pairs_are_solved_one_at_a_time(quick):
    assert jax.default_backend() == "cpu"
    list(align_many(sized(90, 91)))
    assert Quick.last.size == stream.ON_CPU

"""How a confidence is fitted and measured, and the trials it is fitted to."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.calibration import fitting, reliability, trials
from cfr_jax.networks.probability import KEY, calibration_of, uncalibrated
from cfr_jax.weights.files import load_params


def test_the_fit_finds_the_coefficients_that_made_the_answers():
    rng = np.random.default_rng(0)
    told = rng.normal(size=(20_000, 2)) * [1, 5] + [3, 0]
    right = rng.random(len(told)) < 1 / (1 + np.exp(-(told @ [1.0, -0.2] - 2)))

    np.testing.assert_allclose(fitting.fit(told, right), [1.0, -0.2, -2], atol=0.15)


def test_a_true_probability_is_calibrated_and_a_bold_one_is_not():
    rng = np.random.default_rng(0)
    chance = rng.random(20_000)
    right = rng.random(len(chance)) < chance

    assert reliability.calibration_error(chance, right) < 0.02
    assert reliability.calibration_error(np.round(chance), right) == pytest.approx(0.25, abs=0.02)
    # of two uniform chances the right one is the larger with probability 5 / 6
    assert reliability.ranking(chance[:2000], right[:2000]) == pytest.approx(5 / 6, abs=0.02)


# --- the trials ---


def a_pair(seed, offset=(0.0, 0.0, 0.0)):
    cloud = solids.lopsided(300, seed)
    truth = solids.motion(10, translation=(0.1, 0.2, 0.0))
    source = cloud.points + np.array(offset)
    return Pair(f"pair {seed}", source, solids.move(truth, source), transform=truth)


PAIRS = [a_pair(seed, (1e4, -2e4, 50.0)) for seed in range(3)]


def test_every_case_of_a_pair_lies_on_its_target_under_its_truth():
    made = [trials.OfPairs(PAIRS, seed=0).trial(number) for number in range(10)]

    for trial in made:
        whole = PAIRS[trial.group]
        away, _ = cKDTree(whole.target).query(solids.move(trial.truth, trial.source))
        assert away.max() < 0.01
        np.testing.assert_allclose(trial.center, whole.source.mean(axis=0), atol=1e-6)
    turned = [solids.degrees_between(trial.truth, PAIRS[0].transform) for trial in made]
    assert sum(angle < 1e-3 for angle in turned) == 5
    halved = [trial for trial in made if len(trial.source) < 200 > len(trial.target)]
    assert len(halved) == 4 and all(len(trial.source) > 90 for trial in halved)
    assert sum(trial.searched for trial in made) == 1
    assert {trial.group for trial in made} <= {0, 1, 2}


def test_a_case_depends_on_its_number_and_the_seed_alone():
    first, again, other = (trials.OfPairs(PAIRS, seed).trial(5) for seed in (0, 0, 1))

    np.testing.assert_array_equal(first.source, again.source)
    assert not np.array_equal(first.truth, other.truth)


def test_a_pair_without_truth_is_refused():
    unknown = [Pair("p", PAIRS[0].source, PAIRS[0].target)]
    with pytest.raises(ValueError, match="data: pair p has no true transform"):
        trials.OfPairs(unknown, 0).trial(0)


def test_of_ten_pairs_of_shapes_one_is_of_two_things_and_one_searched(tmp_path):
    # given
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "corpus.h5", "w") as file:
        file["data"] = rng.normal(size=(4, 1100, 3)).astype(np.float32) / 3
        file["normal"] = rng.normal(size=(4, 1100, 3)).astype(np.float32)
        file["label"] = np.zeros((4, 1), np.uint8)

    # when
    opened = trials.open_trials(tmp_path / "corpus.h5", 0)
    made = [opened.trial(number) for number in range(10)]

    # then
    assert [trial.truth is None for trial in made] == [False] * 9 + [True]
    assert [trial.searched for trial in made] == [False] * 7 + [True] + [False] * 2
    channels = [trial.source.shape[1] for trial in made]
    assert channels == [6, 6, 6, 3, 3, 6, 3, 6, 6, 3]
    assert all(trial.radius == 1.0 for trial in made)


def test_data_without_motions_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((9, 3)))
    with pytest.raises(ValueError, match="data: .*point clouds.*wanted a list or an HDF5 file"):
        trials.open_trials(tmp_path, 0)


# --- right and wrong ---


def test_right_is_within_five_degrees_and_a_tenth_of_the_radius_about_the_center():
    truth, center = np.eye(4), (1e4, 0.0, 0.0)

    def turned_and_moved(degrees, away):
        motion = solids.motion(degrees, (0, 0, 1))
        motion[:3, 3] = np.array(center) - motion[:3, :3] @ center + [0, away, 0]
        return motion

    for degrees, away, right in ((4.9, 0.19, True), (5.1, 0.0, False), (0.0, 0.21, False)):
        answer = turned_and_moved(degrees, away)
        assert fitting.is_right(answer, truth, center, radius=2.0) == right


# --- what weights find ---


@pytest.fixture(scope="module")
def found():
    params = load_params()
    return fitting.gather(params, trials.OfPairs(PAIRS, seed=0), 2)


def test_what_is_gathered_are_the_clues_and_whether_each_answer_was_right(found):
    assert found.clues["register"].shape == (2, 7) and found.clues["align"].shape == (2, 11)
    assert found.right["align"].all() and np.isfinite(found.clues["align"]).all()
    chance = fitting.predicted(calibration_of(load_params()), found, "align")
    assert (chance > 0.5).all()


def test_uncalibrated_weights_are_looked_at_as_those_that_ship(found):
    bare = fitting.gather(uncalibrated(load_params()), trials.OfPairs(PAIRS, seed=0), 2)
    np.testing.assert_array_equal(bare.clues["align"], found.clues["align"])


def test_a_call_that_was_cut_off_goes_on_and_not_with_other_weights(tmp_path, monkeypatch):
    # given answers that need no network
    asked = []

    def row(params, trial):
        asked.append(trial.group)
        return [0.0] * 18 + [1.0, 0.0, float(trial.group)]

    monkeypatch.setattr(fitting, "_row", row)
    kept, opened = tmp_path / "kept.npz", trials.OfPairs(PAIRS, seed=0)
    params = {KEY: calibration_of(load_params())}
    fitting.gather(params, opened, 10, kept=kept, made_of="these")
    told = []

    # when
    more = fitting.gather(params, opened, 12, kept=kept, made_of="these", told=told.append)

    # then
    assert len(asked) == 12 and len(more.group) == 12 and told == [10, 1, 1]
    assert more.right["register"].all() and not more.right["align"].any()
    with pytest.raises(ValueError, match="keep: .* gathered with other weights"):
        fitting.gather(params, opened, 12, kept=kept, made_of="others")
    kept.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="keep: .* does not hold findings of trials"):
        fitting.gather(params, opened, 12, kept=kept, made_of="these")


def gathered(count=400):
    """Answers made by coefficients that are known."""
    rng = np.random.default_rng(0)
    clues = {name: rng.normal(size=(count, len(used))) for name, used in fitting.USED.items()}
    right = {
        name: rng.random(count) < 1 / (1 + np.exp(-(2 * values[:, 0] - 0.5)))
        for name, values in clues.items()
    }
    return fitting.Gathered(clues, right, rng.integers(20, size=count))


def test_the_calibration_holds_on_the_answers_it_was_fitted_to():
    made = gathered()

    fitted = fitting.fit_calibration(made)

    for name in fitting.USED:
        fitted.check(name, fitting.USED[name])
        chance = fitting.predicted(fitted, made, name)
        assert reliability.calibration_error(chance, made.right[name]) < 0.06
        apart = fitting.cross_validated(made, name)
        best = reliability.ranking(made.clues[name][:, 0], made.right[name])
        assert reliability.ranking(apart, made.right[name]) == pytest.approx(best, abs=0.03)
        assert not np.allclose(apart, chance, atol=1e-6)


def test_what_is_nearly_always_right_teaches_nothing():
    made = gathered()
    made.right["align"][9:] = True
    with pytest.raises(ValueError, match="pairs: align answered .* right and .* wrong, wanted at"):
        fitting.check_enough(made)
    fitting.check_enough(gathered())

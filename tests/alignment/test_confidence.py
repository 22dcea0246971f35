"""The clues of an answer, and the probabilities computed from them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import solids

from cfr_jax.alignment import confidence, doubts
from cfr_jax.alignment.align import align
from cfr_jax.alignment.answers import Alignment
from cfr_jax.alignment.confidence import Clues, gather, of_alignment
from cfr_jax.alignment.quality import Quality
from cfr_jax.batch.stream import align_many
from cfr_jax.networks.clues import NetworkClues, of_network, of_registration
from cfr_jax.networks.probability import KEY, Calibration, calibration_of, uncalibrated
from cfr_jax.weights.files import load_params

OF_NETWORK = [field.name for field in dataclasses.fields(NetworkClues)]
OF_SURFACES = [field.name for field in dataclasses.fields(Clues) if field.name != "network"]
NAMES = OF_NETWORK + OF_SURFACES
FITTED = calibration_of(load_params())
POINTS = solids.lopsided(40, 0).points


def clues(**changes):
    return dict.fromkeys(NAMES, 0.0) | changes


def seen(degrees, *, shrunk=1.0, off=0.0, weights=None, mask=None):
    """The clues of a registration whose iterations are turned by `degrees`. Its matches lie where
    the last iteration puts the points, but `shrunk` about their center and shifted by `off`."""
    transforms = np.stack([solids.motion(angle) for angle in degrees])
    weights = np.full(len(POINTS), 0.5) if weights is None else weights
    center = np.average(POINTS, axis=0, weights=weights)
    targets = solids.move(transforms[-1], center + shrunk * (POINTS - center)) + [off, 0, 0]
    arrays = (transforms, POINTS, targets, weights, weights)
    arrays = [jnp.asarray(array, jnp.float32) for array in arrays]
    return of_network(*arrays, mask, mask)


def test_the_network_tells_how_it_came_to_its_answer():
    found = seen([10, 25, 27])

    np.testing.assert_allclose(found.settled, np.log(2 + 0.1), rtol=1e-3)
    np.testing.assert_allclose(found.settling, np.log(15 + 0.1), rtol=1e-3)
    np.testing.assert_allclose(found.source_found, 0.5, rtol=1e-6)


def test_the_residual_is_the_distance_of_matched_places():
    np.testing.assert_allclose(
        [seen([10], off=off).residual for off in (0.0, 0.2)],
        np.log(np.hypot(0.01, [0, 0.2])),
        atol=1e-3,
    )


def test_an_undecided_match_points_to_the_middle_and_is_less_sharp():
    sharp, blurred = seen([10]), seen([10], shrunk=0.5)

    np.testing.assert_allclose(sharp.sharpness, 0, atol=1e-4)
    np.testing.assert_allclose(blurred.sharpness, np.log(0.5), atol=1e-2)
    assert blurred.residual > sharp.residual


def test_the_lever_is_that_of_the_two_smaller_eigenvalues():
    weights = np.random.default_rng(0).random(len(POINTS))

    found = seen([0], weights=weights)

    low, middle, high = np.linalg.eigvalsh(np.cov(POINTS.T, aweights=weights, ddof=0))
    wanted = (low * middle + low * high + middle * high) / (low + middle + high)
    np.testing.assert_allclose(found.lever, np.log(wanted) / 2, atol=1e-2)


def test_padding_is_no_clue():
    weights = np.arange(len(POINTS)) / 100
    mask = jnp.arange(len(POINTS)) < 30

    found = seen([10, 20], weights=weights, mask=mask)

    wanted = weights[:30].mean()
    np.testing.assert_allclose([found.source_found, found.target_found], wanted, rtol=1e-5)


def test_a_single_iteration_counts_as_settled_and_has_finite_slopes():
    found = seen([30])

    np.testing.assert_allclose([found.settled, found.settling], np.log(0.1), atol=1e-2)

    def probability(transforms):
        arrays = (transforms, *map(jnp.float32, (POINTS, POINTS)), *[jnp.full(40, 0.5)] * 2)
        return of_registration(FITTED, of_network(*arrays))

    slopes = jax.grad(probability)(jnp.eye(4)[None])
    assert np.isfinite(slopes).all()


def test_the_surfaces_tell_how_far_refining_went_and_how_the_answer_is_held():
    quality = Quality(
        fitness=jnp.array(0.75),
        inlier_rmse=jnp.array(0.02),
        resistance=jnp.array([0.25, 0.09, 0.5]),
        weakest=jnp.eye(6)[:3],
        overlap=jnp.array(0.8),
        moments=jnp.eye(4),
    )
    answers = (jnp.asarray(solids.motion(angle), jnp.float32) for angle in (27, 32))

    found = confidence.named(gather(seen([27]), *answers, quality))

    assert sorted(found) == sorted(NAMES) and found["fitness"] == 0.75
    np.testing.assert_allclose(found["agreement"], np.log(5 + 0.1), rtol=1e-3)
    np.testing.assert_allclose([found["distance"], found["resistance"]], [0.4, 0.3], rtol=1e-6)


def test_the_probability_is_the_logistic_of_the_weighted_clues():
    fitted = Calibration.of({"bias": 0.0}, {"bias": -1.0, "fitness": 2.0, "settled": -0.5})

    found = of_alignment(fitted, clues(fitness=0.75, settled=1.5))

    assert found == pytest.approx(1 / (1 + np.exp(0.25)))


@pytest.mark.parametrize("value", [-1e30, 1e30])
def test_extreme_clues_give_a_probability(value):
    fitted = Calibration.of({"bias": 0.0}, {"bias": 0.0, "fitness": 1.0})

    found = of_alignment(fitted, clues(fitness=value))

    assert found == pytest.approx(float(value > 0), abs=1e-9) and 0 <= found <= 1


@pytest.mark.parametrize("name", ["object", "scan"])
def test_what_ships_knows_its_clues_and_trusts_a_better_answer_more(name):
    fitted = calibration_of(load_params(name))
    fitted.check("register", OF_NETWORK)
    fitted.check("align", NAMES)

    low = of_alignment(fitted, clues(distance=0.8, residual=-1.5, resistance=0.1))
    high = of_alignment(fitted, clues(distance=0.4, residual=-2.5, resistance=0.5))
    sure = of_registration(fitted, seen([10, 20, 20]))
    unsure = of_registration(fitted, seen([10, 20, 60], off=0.2))

    assert 0 <= low < high <= 1 and 0 <= unsure < sure <= 1


# --- weights that nobody calibrated ---


@pytest.fixture(scope="module")
def pair():
    return solids.two_samplings(256, solids.motion(20))


def test_without_calibration_the_answer_is_the_same_and_its_confidence_is_unknown(pair):
    # given the same weights with and without
    calibrated, bare = load_params(), uncalibrated(load_params())

    # when
    known, unknown = (align(*pair, params=params) for params in (calibrated, bare))
    (many,) = align_many([pair], params=bare)

    # then
    np.testing.assert_array_equal(unknown.transform, known.transform)
    assert known.trusted and not unknown.trusted and not many.alignment.trusted
    assert unknown.confidence is many.alignment.confidence is None
    for told in (unknown.warnings, many.alignment.warnings):
        assert any("no calibration (`cfr calibrate` fits one)" in warning for warning in told)
    assert not any("calibration" in warning for warning in known.warnings)


def test_nothing_is_looked_at_twice_where_nothing_tells_which_answer_is_better(monkeypatch):
    pair = solids.two_samplings(256, solids.motion(90, (-1, 1, 0)))

    found = align(*pair, params=uncalibrated(load_params()))

    assert found.starts == 1 and isinstance(found, Alignment)
    assert doubts.probability(None, found.clues, 0.1) is None


def test_a_calibration_of_other_clues_is_refused_before_anything_is_computed(pair):
    fitted = Calibration.of({"bias": 0.0}, {"bias": 0.0, "luck": 1.0})

    with pytest.raises(ValueError, match="calibration: align has other clues"):
        align(*pair, params=load_params() | {KEY: fitted})

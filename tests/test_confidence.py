"""The clues of an answer, and the probability made of them."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import solids

from cfr_jax import confidence
from cfr_jax.confidence import Clues, gather, of_alignment
from cfr_jax.quality import Quality
from cfr_jax.refinement import Surface
from cfr_jax.registration import Registration

NAMES = [field.name for field in dataclasses.fields(Clues)]


def clues(**changes):
    return dict.fromkeys(NAMES, 0.0) | changes


@pytest.fixture
def fitted(monkeypatch):
    """Puts given coefficients in the place of those that ship."""

    def use(bias, **weights):
        monkeypatch.setattr(confidence, "_fitted", lambda: {"bias": bias, "weights": weights})

    return use


def gathered(degrees, *, refined=0.0, mask=(True, True, True)):
    """Clues of a registration whose iterations are turned by `degrees`."""
    transforms = np.stack([solids.motion(angle) for angle in degrees])
    registration = Registration(
        transforms=jnp.asarray(transforms, jnp.float32),
        weights=jnp.array([0.2, 0.4, 0.9]),
        covered=jnp.array([0.1, 0.5, 0.9]),
        targets=jnp.zeros((3, 3)),
        beta=jnp.ones(len(degrees)),
        alpha=jnp.ones(len(degrees)),
    )
    surface = Surface(jnp.zeros((3, 3)), jnp.zeros((3, 3)), jnp.array(mask))
    quality = Quality(
        fitness=jnp.array(0.75),
        inlier_rmse=jnp.array(0.02),
        resistance=jnp.array([0.25, 0.09, 0.5]),
        weakest=jnp.eye(6)[:3],
    )
    answer = jnp.asarray(solids.motion(degrees[-1] + refined), jnp.float32)
    return gather(registration, surface, surface, answer, quality)


def test_the_clues_are_read_off_the_answer():
    found = gathered([10, 25, 27], refined=5)

    np.testing.assert_allclose(found.settled, np.log(2 + 0.1), rtol=1e-4)
    np.testing.assert_allclose(found.agreement, np.log(5 + 0.1), rtol=1e-4)
    np.testing.assert_allclose(found.distance, 0.4, rtol=1e-6)
    np.testing.assert_allclose(found.resistance, 0.3, rtol=1e-6)
    np.testing.assert_allclose(found.source_found, 0.5, rtol=1e-6)
    assert found.fitness == 0.75


def test_padding_is_no_clue():
    found = gathered([10, 20], mask=(True, True, False))

    np.testing.assert_allclose([found.source_found, found.target_found], [0.3, 0.3], rtol=1e-6)


def test_a_single_iteration_counts_as_settled():
    np.testing.assert_allclose(gathered([30]).settled, np.log(0.1), rtol=1e-4)


def test_the_probability_is_the_logistic_of_the_weighted_clues(fitted):
    fitted(-1.0, fitness=2.0, settled=-0.5)

    found = of_alignment(clues(fitness=0.75, settled=1.5))

    assert found == pytest.approx(1 / (1 + np.exp(0.25)))


@pytest.mark.parametrize("value", [-1e30, 1e30])
def test_extreme_clues_give_a_probability(fitted, value):
    fitted(0.0, fitness=1.0)

    found = of_alignment(clues(fitness=value))

    assert found == pytest.approx(float(value > 0), abs=1e-9) and 0 <= found <= 1


def test_what_ships_knows_its_clues_and_trusts_a_better_fit_more():
    shipped = json.loads(confidence.FITTED.read_text())
    assert set(shipped["weights"]) <= set(NAMES)

    low, high = (of_alignment(clues(fitness=fitness)) for fitness in (0.0, 1.0))

    assert 0 <= low < high <= 1

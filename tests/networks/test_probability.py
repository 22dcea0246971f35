"""The calibration in the parameters: it goes along everywhere and is never trained."""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cfr_jax.networks.cfr.registration import register
from cfr_jax.networks.probability import KEY, Calibration, calibration_of, logit, uncalibrated
from cfr_jax.weights.files import load_params

FITTED = Calibration.of({"bias": -1.0, "settled": 0.1}, {"bias": 2.0, "fitness": -1 / 3})
TREE = {"kernel": jnp.arange(3.0), KEY: FITTED}


def test_the_logit_is_the_bias_and_the_weighted_clues():
    clues = {"settled": 2.0, "fitness": 0.3}
    assert logit(FITTED.register, clues) == -1 + 0.1 * 2
    assert logit(FITTED.align, clues) == 2 + (-1 / 3) * 0.3


def test_it_has_no_leaves_and_survives_what_is_done_to_parameters():
    # given, then
    assert len(jax.tree.leaves(TREE)) == 1
    assert jax.tree.map(jnp.negative, TREE)[KEY] == FITTED
    assert jax.jit(lambda tree: tree)(TREE)[KEY] == FITTED
    assert jax.vmap(lambda tree: tree)(TREE)[KEY] == FITTED
    assert jax.device_get(TREE)[KEY] == FITTED
    assert calibration_of(TREE) is FITTED and calibration_of({}) is None
    assert uncalibrated(TREE).keys() == {"kernel"} and KEY in TREE


def test_it_cannot_be_changed_under_a_compiled_program():
    with pytest.raises(dataclasses.FrozenInstanceError):
        FITTED.register = ()
    assert hash(FITTED) == hash(Calibration.read(FITTED.write()))


def test_gradients_and_optimizers_pass_it_by():
    # given
    def loss(tree):
        return jnp.sum(tree["kernel"] ** 2)

    gradient = jax.grad(loss)(TREE)
    optimizer = optax.adamw(0.1)

    # when
    with jax.numpy_dtype_promotion("standard"):  # optax mixes
        updates, _ = optimizer.update(gradient, optimizer.init(TREE), TREE)
        changed = optax.apply_updates(TREE, updates)

    # then
    assert changed[KEY] == gradient[KEY] == FITTED
    assert np.abs(changed["kernel"] - TREE["kernel"]).max() > 0.05


def test_the_note_keeps_every_digit_and_the_order():
    awkward = Calibration.of({"bias": 0.1 + 0.2, "b": 1e-300, "a": -7}, {"bias": 1 / 3})
    assert Calibration.read(awkward.write()) == awkward


GOOD = {"register": {"bias": 1.0}, "align": {"bias": 2.0}}


@pytest.mark.parametrize(
    ("note", "told"),
    [
        ("{", "the note is not valid JSON"),
        ("[]", "got list, wanted register and align"),
        ('{"register": {"bias": 1}}', r"got \['register'\], wanted register and align"),
        (json.dumps(GOOD | {"align": {"fitness": 1.0}}), "align has no bias"),
        (json.dumps(GOOD | {"align": 3}), "align has no bias"),
        (json.dumps(GOOD | {"register": {"bias": "1"}}), "register.bias is '1', wanted a finite"),
        (json.dumps(GOOD | {"register": {"bias": True}}), "register.bias is True"),
        (json.dumps(GOOD | {"align": {"bias": float("nan")}}), "align.bias is nan"),
    ],
)
def test_a_damaged_note_is_refused(note, told):
    with pytest.raises(ValueError, match=f"^calibration: {told}"):
        Calibration.read(note)


def test_coefficients_of_other_clues_are_refused():
    FITTED.check("register", ["settled"])
    wanted = r"align has other clues than .*\(fitness, speed\).*fit it again"
    with pytest.raises(ValueError, match=wanted):
        FITTED.check("align", ["speed"])


def samples_of_the_unit_sphere(rng):
    # `register` expects unit size, and trusts clouds of another less
    points = rng.normal(size=(12, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_register_gives_a_confidence_where_the_weights_have_one_and_none_elsewhere(params):
    # given the same weights twice, and a calibration that is sure of everything
    rng = np.random.default_rng(0)
    clouds = [jnp.float32(samples_of_the_unit_sphere(rng)) for _ in range(2)]
    sure = {name: 0.0 for name, _ in calibration_of(load_params()).register} | {"bias": 3.0}
    calibrated = params | {KEY: Calibration.of(sure, {"bias": 0.0})}

    # when
    with_it, without = (register(held, *clouds) for held in (calibrated, params))

    # then
    assert without.confidence is None
    np.testing.assert_allclose(with_it.confidence, 1 / (1 + np.exp(-3)), rtol=1e-6)
    np.testing.assert_array_equal(with_it.transforms, without.transforms)
    batched = jax.vmap(register, (None, 0, 0))(calibrated, *(cloud[None] for cloud in clouds))
    np.testing.assert_allclose(batched.confidence, [1 / (1 + np.exp(-3))], rtol=1e-6)

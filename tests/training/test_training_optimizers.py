"""Optimizers and learning rates do what their names say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.training.optimizers import OPTIMIZERS, make_optimizer, make_schedule, planned


@pytest.fixture(autouse=True)
def promotion_as_optax_needs_it():
    """Its schedules and moments mix integers with floats."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def rates(kind, **changes):
    given = {"peak_rate": 1.0, "steps": 100, "warmup": 0.1, "cooldown": 0.2} | changes
    schedule = make_schedule(kind, **given)
    return np.array([float(schedule(step)) for step in range(101)])


@pytest.mark.parametrize("kind", ["cosine", "wsd", "constant"])
def test_every_rate_rises_from_a_25th_to_the_peak(kind):
    found = rates(kind)

    assert found[0] == pytest.approx(1 / 25) and found[10] == pytest.approx(1.0)
    assert (np.diff(found[:11]) > 0).all() and found.max() <= 1 + 1e-6


def test_cosine_falls_along_half_a_wave():
    found = rates("cosine")

    wanted = 0.001 + 0.999 * 0.5 * (1 + np.cos(np.pi * np.linspace(0, 1, 91)))
    np.testing.assert_allclose(found[10:], wanted, atol=1e-5)


def test_wsd_stays_and_then_falls_in_a_straight_line():
    found = rates("wsd")

    np.testing.assert_allclose(found[10:81], 1.0, rtol=1e-6)
    np.testing.assert_allclose(found[80:], np.linspace(1, 0.001, 21), atol=1e-5)


def test_a_trapezoid_rises_from_zero_stays_and_falls_to_zero():
    found = rates("trapezoid")

    np.testing.assert_allclose(found[:10], np.linspace(0.1, 1, 10), rtol=1e-5)
    np.testing.assert_allclose(found[10:81], 1.0, rtol=1e-6)
    np.testing.assert_allclose(found[80:], np.linspace(1, 0, 21), atol=1e-5)


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_a_trapezoid_can_be_made_longer_without_another_program(kind):
    def made(steps):
        schedule = make_schedule("trapezoid", peak_rate=0.05, steps=steps, warmup=0.1, cooldown=0.5)
        return make_optimizer(kind, schedule, clip=1.0, weight_decay=1e-3)

    rule, wanted = made(7), made(20)
    x = jnp.array([[1.0, -2.0], [0.5, 1.0]])
    state, same = planned(rule.init(x), jnp.int32(20)), wanted.init(x)

    for step in range(20):
        gradient = jnp.cos(x * step)
        updates, state = rule.update(gradient, state, x)
        expected, same = wanted.update(gradient, same, x)
        np.testing.assert_array_equal(updates, expected)
    # the last rate is a tenth of the peak, as one of the ten steps of the cooldown is left
    assert float(
        make_schedule("trapezoid", peak_rate=1.0, steps=20, warmup=0.1, cooldown=0.5)(19)
    ) == pytest.approx(0.1)


def test_another_schedule_is_not_planned():
    rule = make_optimizer("adamw", lambda _: 0.1, clip=1.0, weight_decay=0.0)
    state = rule.init(jnp.ones(2))

    assert planned(state, jnp.int32(5)) is state


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_under_a_trapezoid_every_optimizer_is_what_it_is_under_that_rate(kind):
    schedule = make_schedule("trapezoid", peak_rate=0.05, steps=10, warmup=0.3, cooldown=0.3)
    rule = make_optimizer(kind, schedule, clip=1.0, weight_decay=1e-2)
    plain = make_optimizer(kind, lambda step: schedule(step), clip=1.0, weight_decay=1e-2)
    x = y = jax.random.normal(jax.random.key(0), (33, 32))
    state, other = rule.init(x), plain.init(y)

    for step in range(10):
        updates, state = rule.update(jnp.sin(3 * x + step), state, x)
        wanted, other = plain.update(jnp.sin(3 * y + step), other, y)
        x, y = x + updates, y + wanted

    np.testing.assert_allclose(x, y, atol=1e-5)


def test_constant_stays():
    np.testing.assert_allclose(rates("constant")[10:], 1.0, rtol=1e-6)


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_every_optimizer_finds_the_bottom_of_a_bowl(kind):
    rule = make_optimizer(kind, lambda _: 0.05, clip=1.0, weight_decay=0.0)
    x = jnp.array([1.0, -2.0])
    state = rule.init(x)
    for _ in range(150):
        updates, state = rule.update(2 * x, state, x)
        x = x + updates

    assert float(jnp.abs(x).max()) < 0.15


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_weights_shrink_where_nothing_pulls(kind):
    rule = make_optimizer(kind, lambda _: 0.1, clip=1.0, weight_decay=0.1)
    x = jnp.array([1.0])
    updates, _ = rule.update(jnp.zeros(1), rule.init(x), x)

    assert float(updates[0]) < 0


def test_the_gradient_is_clipped_by_its_norm():
    rule = make_optimizer("sgd", lambda _: 1.0, clip=1.0, weight_decay=0.0)
    x = jnp.zeros(2)

    long, _ = rule.update(jnp.array([30.0, 40.0]), rule.init(x), x)
    short, _ = rule.update(jnp.array([0.3, 0.4]), rule.init(x), x)

    np.testing.assert_allclose(long, 2 * np.array(short), rtol=1e-5)


def test_muon_moves_hidden_matrices_alike_in_all_directions_and_the_rest_as_adamw():
    def drawn(*shape):
        return jnp.asarray(np.random.default_rng(0).normal(size=shape), jnp.float32)

    gradient = {"stack": drawn(2, 48, 96), "input": drawn(7, 96), "bias": drawn(96)}
    zeros = jax.tree.map(jnp.zeros_like, gradient)
    rule = make_optimizer("muon", lambda _: 0.1, clip=1e9, weight_decay=0.0)

    updates, _ = rule.update(gradient, rule.init(zeros), zeros)

    # 0.2 times the root of the longer side makes entries about 0.2 in size, as AdamW's are
    lengths = np.linalg.svd(updates["stack"], compute_uv=False) / (0.1 * 0.2 * np.sqrt(96))
    assert 0.6 < lengths.min() and lengths.max() < 1.3
    left, _, right = np.linalg.svd(np.asarray(gradient["stack"], float), full_matrices=False)
    aligned = np.einsum("sij,sij->s", updates["stack"], -left @ right)
    np.testing.assert_allclose(
        aligned / np.linalg.norm(updates["stack"], axis=(1, 2)), 48**0.5, rtol=0.05
    )
    for name in ("input", "bias"):
        # Nesterov's first step is 1 + 0.9 / (1 + 0.9) long, shrunk by less than a hundredth
        first = 0.1 * (1 + 0.9 / 1.9)
        np.testing.assert_allclose(updates[name], -first * np.sign(gradient[name]), rtol=1e-2)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"kind": "step"}, "got 'step', wanted one of cosine, wsd, constant"),
        ({"steps": 0}, "0 steps"),
        ({"warmup": 1.0}, "warmup 1.0"),
        ({"cooldown": 0.95}, "cooldown 0.95"),
    ],
)
def test_impossible_rates_are_refused(change, wanted):
    given = {"kind": "wsd", "peak_rate": 1.0, "steps": 10, "warmup": 0.1} | change
    with pytest.raises(ValueError, match=wanted):
        make_schedule(given.pop("kind"), **given)
    with pytest.raises(ValueError, match="optimizer: got 'adagrad'"):
        make_optimizer("adagrad", lambda _: 1.0, clip=1.0, weight_decay=0.0)

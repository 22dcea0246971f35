"""Every form of the match against the reference, over all the annealing a network may ask for."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces

from cfr_jax.sinkhorn import match, match_in_log_space

N, M = 12, 15
FORMS = {"log-free": match, "log space": match_in_log_space}
# beta, alpha: diffuse, as trained, far beyond where exp(alpha beta) overflows, nothing in reach
ANNEALING = [(1e-3, 1e-3), (12.0, 0.3), (60.0, 1.0), (100.0, 2.0), (200.0, 4.0), (1e4, 1.0),
             (1e4, 0.01), (300.0, 0.0), (2.0, 50.0)]  # fmt: skip


@functools.cache
def compiled(form, passes):
    return jax.jit(functools.partial(FORMS[form], passes=passes))


def affinities(beta, alpha, seed=0):
    """Log affinities of unit features, and target points."""
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(N, 8)), rng.normal(size=(M, 8))
    target[:5] = source[:5] + 0.05 * rng.normal(size=(5, 8))
    source, target = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in (source, target))
    square = 2 - 2 * source @ target.T
    return (-beta * (square - alpha)).astype(np.float32), rng.normal(size=(M, 3)).astype(np.float32)


def reference(log_affinity, points, passes):
    block = pieces.sinkhorn_log(log_affinity.astype(np.float64), passes)
    weights = block.sum(axis=1)
    return weights, (block @ points) / (weights[:, None] + 1e-5), block.sum(axis=0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("passes", [1, 2, 5])
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_every_form_is_the_reference(form, passes, beta, alpha):
    log_affinity, points = affinities(beta, alpha)

    found = compiled(form, passes)(jnp.asarray(log_affinity), jnp.asarray(points))

    # log affinities beyond 1e4 carry no more than three decimals in float32: taken as given here
    weights, targets, covered = reference(log_affinity, points, passes)
    atol = 1e-5 if np.abs(log_affinity).max() < 1000 else 2e-2 if form == "log space" else 1e-5
    np.testing.assert_allclose(found.weights, weights, atol=atol)
    np.testing.assert_allclose(found.covered, covered, atol=atol)
    # where hardly anything is matched, the mean of it is a quotient of two small numbers
    np.testing.assert_allclose(found.targets * weights[:, None], targets * weights[:, None],
                               atol=3 * atol)  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_masked_points_neither_give_nor_take(form, beta, alpha):
    log_affinity, points = affinities(beta, alpha)
    here, there = np.arange(N) % 3 != 1, np.arange(M) % 4 != 2
    junk = np.where(np.outer(here, there), log_affinity, 50).astype(np.float32)

    found = compiled(form, 3)(
        jnp.asarray(junk),
        jnp.asarray(np.where(there[:, None], points, 1e3), jnp.float32),
        source_mask=jnp.asarray(here),
        target_mask=jnp.asarray(there),
    )

    alone = compiled(form, 3)(jnp.asarray(log_affinity[here][:, there]), jnp.asarray(points[there]))
    np.testing.assert_allclose(found.weights[here], alone.weights, atol=1e-5)
    np.testing.assert_allclose(found.covered[there], alone.covered, atol=1e-5)
    np.testing.assert_allclose(found.targets[here], alone.targets, atol=1e-5)
    assert not found.weights[~here].any() and not found.covered[~there].any()


@functools.cache
def slope(form, passes=3):
    def total(log_affinity, points, source_mask, target_mask):
        found = FORMS[form](
            log_affinity, points, passes=passes, source_mask=source_mask, target_mask=target_mask
        )
        pull = (jnp.sin(jnp.arange(part.size, dtype=part.dtype)) for part in found)
        return sum(jnp.sum(part.ravel() * by) for part, by in zip(found, pull, strict=True))

    return jax.jit(jax.value_and_grad(total, (0, 1)))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_gradients_are_finite_masked_or_not(form, beta, alpha):
    log_affinity, points = (jnp.asarray(a) for a in affinities(beta, alpha))
    everywhere = jnp.ones(N, bool), jnp.ones(M, bool)
    somewhere = jnp.arange(N) % 3 != 1, jnp.arange(M) % 4 != 2
    nowhere = jnp.zeros(N, bool), jnp.zeros(M, bool)

    for masks in (everywhere, somewhere, nowhere):
        value, gradients = slope(form)(log_affinity, points, *masks)

        assert np.isfinite(value)
        assert all(np.isfinite(gradient).all() for gradient in gradients)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("beta", "alpha"), [(12.0, 0.3), (200.0, 4.0)])
def test_gradients_are_their_finite_differences(x64, form, beta, alpha):
    log_affinity, points = (jnp.asarray(a, jnp.float64) for a in affinities(beta, alpha))
    masks = jnp.arange(N) % 3 != 1, jnp.arange(M) % 4 != 2
    rng = np.random.default_rng(1)
    change = jnp.asarray(rng.normal(size=(N, M))), jnp.asarray(rng.normal(size=(M, 3)))
    step = 1e-5

    _, gradients = slope(form)(log_affinity, points, *masks)

    derivative = sum(jnp.sum(g * c) for g, c in zip(gradients, change, strict=True))
    ahead, behind = (
        slope(form)(log_affinity + s * step * change[0], points + s * step * change[1], *masks)[0]
        for s in (1, -1)
    )
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("form", FORMS)
def test_no_point_finds_more_than_one_partner(form):
    log_affinity, points = affinities(30.0, 1.5, seed=2)

    found = compiled(form, 5)(jnp.asarray(log_affinity), jnp.asarray(points))

    for sums in (found.weights, found.covered):
        assert (sums >= 0).all() and (sums <= 1 + 1e-5).all()
    np.testing.assert_allclose(found.weights.sum(), found.covered.sum(), rtol=1e-5)


@pytest.mark.parametrize("form", FORMS)
def test_at_least_one_pass_is_asked_for(form):
    log_affinity, points = (jnp.asarray(a) for a in affinities(1.0, 1.0))

    with pytest.raises(ValueError, match="^passes: got 0"):
        FORMS[form](log_affinity, points, passes=0)

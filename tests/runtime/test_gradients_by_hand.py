"""Gradients written by hand: JAX's derivatives in every mode, of the first and the second order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.runtime.tracing.gradients import with_gradient


def plain(weights, x, mask):
    return jnp.sin(x @ weights["w"]) * jnp.where(mask, 1.0, 0.0).astype(x.dtype)[:, None], {
        "sum": jnp.sum(x**3, axis=1)
    }


def by_hand(weights, x, mask):
    """The same, with a gradient of its own. The numbers are of the rows: they do not move."""

    def forward(weights, x, mask):
        return plain(weights, x, mask), jnp.cos(x @ weights["w"])

    def backward(arguments, cosine, gradient):
        weights, x, mask = arguments
        of_rows = gradient[0] * cosine * jnp.where(mask, 1.0, 0.0).astype(x.dtype)[:, None]
        of_x = of_rows @ weights["w"].T + 3 * x**2 * gradient[1]["sum"][:, None]
        return {"w": x.T @ of_rows}, of_x, None

    return with_gradient(forward, backward, weights, x, mask)


RNG = np.random.default_rng(0)
W = {"w": jnp.asarray(RNG.normal(size=(3, 2)), jnp.float32)}
X = jnp.asarray(RNG.normal(size=(4, 3)), jnp.float32)
MASK = jnp.asarray([True, False, True, True])


def scalar(function):
    def of(x):
        first, second = function({"w": W["w"] * jnp.sum(x * x)}, x, MASK)
        return jnp.sum(first**2) + jnp.sum(jnp.tanh(second["sum"]))

    return of


def close(found, wanted):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "derivative",
    [
        jax.grad,
        jax.jacfwd,
        jax.jacrev,
        jax.hessian,
        lambda f: jax.jacfwd(jax.jacfwd(f)),
        lambda f: jax.jacrev(jax.jacrev(f)),
        lambda f: jax.jacrev(jax.jacfwd(f)),
        lambda f: jax.grad(jax.jit(f)),
        lambda f: jax.jit(jax.jacfwd(jax.jit(f))),
        lambda f: jax.grad(jax.checkpoint(f)),
    ],
)
def test_every_derivative_is_that_of_the_plain_function(derivative):
    found = derivative(scalar(by_hand))(X)
    close(found, derivative(scalar(plain))(X))


@pytest.mark.parametrize("axes", [(None, 0), ({"w": 0}, None), ({"w": 0}, 0)])
def test_derivatives_of_a_batch_are_those_of_the_plain_function(axes):
    weights = W if axes[0] is None else {"w": jnp.stack([W["w"], 2 * W["w"]])}
    x = X if axes[1] is None else jnp.stack([X, X + 1])

    def gradients(function):
        def loss(weights, x):
            return sum(jnp.sum(part**2) for part in jax.tree.leaves(function(weights, x, MASK)))

        def mean(weights, x):
            return jnp.mean(jax.vmap(loss, axes)(weights, x))

        forward = jax.vmap(jax.jacfwd(loss, 1), axes)(weights, x)
        return forward, jax.grad(mean, (0, 1))(weights, x)

    close(gradients(by_hand), gradients(plain))


def test_what_does_not_move_costs_no_derivative():
    asked = []

    def backward(arguments, _, gradient):
        asked.append(True)
        return (gradient * 2 * arguments[0],)

    def square(x):
        return with_gradient(lambda x: (x * x, None), backward, x)

    assert jax.grad(lambda y: jnp.sum(square(jnp.ones(2)) * y))(jnp.ones(2)).tolist() == [1, 1]
    assert not asked
    assert jax.grad(lambda x: jnp.sum(square(x)))(jnp.ones(2)).tolist() == [2, 2]
    assert asked

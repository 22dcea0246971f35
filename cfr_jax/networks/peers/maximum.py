"""The maximum that pools features, with a gradient that holds whatever a compiler does to it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def highest(x: Float[Array, "*rows k c"]) -> Float[Array, "*rows c"]:
    """The maximum over the axis before the last, channel by channel.

    The gradient goes to the first of the largest, as in the published programs. JAX's own compares
    the entries with the maximum and divides by how many are equal: none is, and the gradient NaN,
    where a compiler makes the entries twice and rounds them apart.
    """
    return _highest(x)


@jax.custom_vjp
def _highest(x: Array) -> Array:
    return jnp.max(x, axis=-2)


def _forward(
    x: Float[Array, "*rows k c"],
) -> tuple[Float[Array, "*rows c"], tuple[Int[Array, "*rows c"], Float[Array, " k"]]]:
    chosen = jnp.argmax(x, axis=-2)
    value = jnp.take_along_axis(x, chosen[..., None, :], axis=-2)[..., 0, :]
    return value, (chosen, jnp.zeros(x.shape[-2], x.dtype))


def _backward(
    kept: tuple[Int[Array, "*rows c"], Float[Array, " k"]], gradient: Float[Array, "*rows c"]
) -> tuple[Float[Array, "*rows k c"]]:
    chosen, axis = kept
    own = jnp.arange(len(axis), dtype=chosen.dtype)[:, None] == chosen[..., None, :]
    return (jnp.where(own, gradient[..., None, :], 0),)


_highest.defvjp(_forward, _backward)

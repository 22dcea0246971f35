"""The maximum that pools features, with a gradient that holds whatever a compiler does to it."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cfr_jax.runtime.tracing.gradients import with_gradient


def highest(x: Float[Array, "*rows k c"]) -> Float[Array, "*rows c"]:
    """The maximum over the axis before the last, channel by channel.

    The gradient goes to the first of the largest, as in the published programs. JAX's own compares
    the entries with the maximum and divides by how many are equal: none is, and the gradient NaN,
    where a compiler makes the entries twice and rounds them apart.
    """
    return with_gradient(_forward, _backward, x)


def _forward(x: Float[Array, "*rows k c"]) -> tuple[Float[Array, "*rows c"], Int[Array, "*rows c"]]:
    chosen = jnp.argmax(x, axis=-2)
    value = jnp.take_along_axis(x, chosen[..., None, :], axis=-2)[..., 0, :]
    return value, chosen


def _backward(
    arguments: tuple[Array], chosen: Int[Array, "*rows c"], gradient: Float[Array, "*rows c"]
) -> tuple[Float[Array, "*rows k c"]]:
    (x,) = arguments
    own = jnp.arange(x.shape[-2], dtype=chosen.dtype)[:, None] == chosen[..., None, :]
    return (jnp.where(own, gradient[..., None, :], 0),)

"""Batch norm (Ioffe & Szegedy, 2015) for networks that see one pair at a time.

Two modes. A registration normalizes by the running statistics, which stand among the parameters. A
training normalizes by those of the batch: a batch is a `vmap` whose axis is called `PAIRS`, and
sums go over it. How the running statistics then follow the batch is written as a gradient: that of
half the squared distance to the batch's. A step of gradient descent at the rate `MOMENTUM` on it is
the moving average of the published programs (`training.optimizers.keep_running`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.layers import EPSILON, kernel_init
from cfr_jax.networks.record import Params

PAIRS = "pairs"
MOMENTUM = 0.1
RUNNING = ("running_mean", "running_variance")
_PULL = "pull"


class BatchNorm(nn.Module):
    """Each channel brought to mean zero and variance one, then scaled and shifted."""

    training: bool

    @nn.compact
    def __call__(
        self, x: Float[Array, "*rows c"], mask: Bool[Array, "*rows"] | None = None
    ) -> Float[Array, "*rows c"]:
        channels = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,))
        shift = self.param("shift", nn.initializers.zeros, (channels,))
        running_mean = self.param(RUNNING[0], nn.initializers.zeros, (channels,))
        running_variance = self.param(RUNNING[1], nn.initializers.ones, (channels,))
        if not self.training:
            mean, variance = lax.stop_gradient((running_mean, running_variance))
            return (x - mean) * (lax.rsqrt(variance + EPSILON) * scale) + shift
        valid = jnp.ones(x.shape[:-1], x.dtype) if mask is None else mask.astype(x.dtype)
        axes = tuple(range(x.ndim - 1))
        count = jnp.maximum(lax.psum(jnp.sum(valid), PAIRS), 1)
        mean = lax.psum(jnp.sum(x * valid[..., None], axes), PAIRS) / count
        centered = x - mean
        square = lax.psum(jnp.sum(centered * centered * valid[..., None], axes), PAIRS)
        # as published: biased where it normalizes, unbiased where it is kept
        kept = mean, square / jnp.maximum(count - 1, 1)
        away = (
            jnp.sum((running - lax.stop_gradient(batch)) ** 2) / 2
            for running, batch in zip((running_mean, running_variance), kept, strict=True)
        )
        self.sow(_PULL, "away", sum(away))
        return centered * (lax.rsqrt(square / count + EPSILON) * scale) + shift


class NormedLinear(nn.Module):
    """Linear (the published 1x1 convolution), batch norm, ReLU."""

    width: int
    bias: bool
    training: bool

    @nn.compact
    def __call__(
        self, x: Float[Array, "*rows i"], mask: Bool[Array, "*rows"] | None = None
    ) -> Float[Array, "*rows o"]:
        dense = nn.Dense(self.width, use_bias=self.bias, kernel_init=kernel_init, name="dense")
        return nn.relu(BatchNorm(self.training, name="norm")(dense(x), mask))


def apply_in_training(
    module: nn.Module, params: Params, *given: Any, method: Any = None
) -> tuple[Any, Float[Array, ""]]:
    """What a module answers in training, and a term for its loss: zero, with the gradient that lets
    the running statistics follow the batch. Only inside a `vmap` whose axis is `PAIRS`."""
    answer, found = module.apply({"params": params}, *given, method=method, mutable=[_PULL])
    pull: Any = sum(jax.tree.leaves(found))
    return answer, pull - lax.stop_gradient(pull)


def is_running(path: Iterable[Any]) -> bool:
    """Whether a parameter, told by its path in the tree, is a running statistic."""
    return str(getattr(list(path)[-1], "key", "")) in RUNNING


def places_of_layer(theirs: tuple[str, str], ours: str, *, bias: bool) -> dict[str, str]:
    """Where the tensors of a layer go, by the authors' names of it and of its norm."""
    linear, norm = theirs
    places = {
        f"{linear}.weight": f"{ours}/dense/kernel",
        f"{norm}.weight": f"{ours}/norm/scale",
        f"{norm}.bias": f"{ours}/norm/shift",
        f"{norm}.running_mean": f"{ours}/norm/{RUNNING[0]}",
        f"{norm}.running_var": f"{ours}/norm/{RUNNING[1]}",
    }
    return places | ({f"{linear}.bias": f"{ours}/dense/bias"} if bias else {})

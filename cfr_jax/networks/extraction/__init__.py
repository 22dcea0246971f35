"""The heavy part: a shared MLP on every neighbor of every point, pooled by maximum.

Three layers of Linear, GroupNorm and ReLU process n k rows per cloud. The statistics of the norm
run over all of these rows, so the plain form writes and reads n k 96 floats eight times, and four
times as often for its gradient. Here, tiles of points stay in the CPU's cache, and at most one such
array is ever stored. On an accelerator the whole cloud is one tile.

- The first layer's statistics follow exactly from the mean and covariance of the seven raw
  channels.
- One pass over the tiles sums the second layer's output for its statistics. It stores the output up
  to the limits; the rest is recomputed when it is needed.
- A second pass sums the third layer's output and keeps its largest value over the neighbors. The
  norm and the ReLU are monotonic per channel, so the pooled feature is that value, normalized.
  (Where the norm's scale is negative, it is the smallest value: the sign is folded into the
  weights.)

The gradient is written by hand for the same reason. The gradient through a norm is the incoming
gradient minus its projections on 1 and on the normalized values. Both projections are sums over
rows. For the last layer they follow from the pooled values alone, for the first layer from sums of
seven channels.
"""

from __future__ import annotations

import functools
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.extraction.backward import backward
from cfr_jax.networks.extraction.forward import Intermediates, forward
from cfr_jax.networks.extraction.mixed import pooled_mixed
from cfr_jax.networks.extraction.tiles import ACCELERATOR, CPU, Limits, kept_of, tiling_of
from cfr_jax.networks.layers import Layer, apply_layer
from cfr_jax.runtime.tracing.gradients import with_gradient
from cfr_jax.runtime.tracing.vectorizing import cloud_by_cloud

__all__ = ["Activations", "pooled_features"]


Activations = Literal["float32", "bfloat16"]


@functools.partial(jax.jit, static_argnames=("groups", "activations", "on_cpu", "elsewhere"))
def pooled_features(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    *,
    groups: int,
    mask: Bool[Array, " n"] | None = None,
    columns: Bool[Array, " k"] | None = None,
    activations: Activations = "float32",
    on_cpu: Limits = CPU,
    elsewhere: Limits = ACCELERATOR,
) -> Float[Array, "n d"]:
    """An MLP on every neighbor, then the maximum over the neighbors: one feature per point.

    Masked points do not affect the statistics, and their own features are zero. Where `columns` are
    given, the other columns of neighbors are padding (`neighbors.others`). The gradient has a rule
    of its own, and needs memory for one activation (at most `on_cpu.kept` numbers of it) and its
    gradient; forward mode and second derivatives need more. The platform that the program is
    lowered for decides which limits apply. `activations` is the type in which the values between
    the layers are stored and multiplied; for "bfloat16" see `mixed`. Raises ValueError for any
    other type.
    """
    n = raw.shape[0]
    valid = jnp.ones(n, raw.dtype) if mask is None else mask.astype(raw.dtype)
    if activations not in ("float32", "bfloat16"):
        raise ValueError(f"activations: got {activations!r}, wanted 'float32' or 'bfloat16'")
    if columns is not None:
        return _of_few(layers, raw, valid, columns, groups) * valid[:, None]
    if activations == "bfloat16":
        return pooled_mixed(layers, raw, valid, groups) * valid[:, None]
    return _pooled(layers, raw, valid, groups, (on_cpu, elsewhere)) * valid[:, None]


_Layers = tuple[Layer, Layer, Layer]


def _of_few(layers: _Layers, raw: Array, valid: Array, columns: Array, groups: int) -> Array:
    """`_pooled` of a cloud with columns of padding; so small that nothing needs to be saved."""
    n, k, _ = raw.shape
    counted = ((valid[:, None] > 0) & columns[None]).reshape(-1)
    rows = raw.reshape(n * k, -1)
    for layer in layers:
        rows = jax.nn.relu(apply_layer(layer, rows, groups=groups, mask=counted))
    return rows.reshape(n, k, -1).max(axis=1)


def _pooled(
    layers: _Layers, raw: Array, valid: Array, groups: int, limits: tuple[Limits, ...]
) -> Array:
    n, k, _ = raw.shape
    # the same number of rows on every platform: until it is lowered, this is one program
    tiling = tiling_of(n, k, limits[0])
    rows_kept = kept_of(tiling, k, layers[1].bias.size, limits[0]) * tiling.size * k
    there = (functools.partial(forward, groups=groups, limits=one, rows_kept=rows_kept)
             for one in limits)  # fmt: skip
    back = (functools.partial(backward, groups=groups, limits=one) for one in limits)
    of_clouds, gradient_of_clouds = cloud_by_cloud(*there), cloud_by_cloud(*back)

    def gradients(
        arguments: tuple[_Layers, Array, Array], kept: Intermediates, gradient: Array
    ) -> tuple[_Layers, Array, None]:
        return *gradient_of_clouds(*arguments, kept, gradient), None

    return with_gradient(of_clouds, gradients, layers, raw, valid)

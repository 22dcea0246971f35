"""A layer of RGM: edges within each cloud, features mixed along them, and a soft assignment."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.layers import EPSILON, kernel_init
from cfr_jax.networks.peers.transformer import Transformer, places_of_transformer
from cfr_jax.networks.sinkhorn.plan import log_plan

_HIGHEST = lax.Precision.HIGHEST


class GraphLayer(nn.Module):
    """From features of both clouds to their soft assignment, and the features as they are mixed."""

    width: int
    passes: int
    slack: bool

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "n i"],
        y: Float[Array, "m i"],
        x_mask: Bool[Array, " n"] | None,
        y_mask: Bool[Array, " m"] | None,
    ) -> tuple[Float[Array, "n m"], Float[Array, "n w"], Float[Array, "m w"]]:
        look = Transformer(2 * self.width, name="look")
        along = nn.Dense(self.width, kernel_init=kernel_init, name="along")
        own = nn.Dense(self.width, kernel_init=kernel_init, name="own")
        seen = look(x, y, x_mask, y_mask), look(y, x, y_mask, x_mask)
        x, y = (
            # what the transformer saw decides about the edges alone
            edges(e, mask) @ nn.relu(along(f)) + nn.relu(own(f))
            for e, f, mask in zip(seen, (x, y), (x_mask, y_mask), strict=True)
        )
        kernel = self.param("affinity", _near_identity, (self.width, self.width))
        product = jnp.matmul(x, (kernel + kernel.T) / 2, precision=_HIGHEST)
        values = jnp.matmul(product, y.T, precision=_HIGHEST)
        scale = self.param("scale", nn.initializers.ones, (1,))
        shift = self.param("shift", nn.initializers.zeros, (1,))
        values = scale * _standardized(values, x_mask, y_mask) + shift
        soft = log_plan(
            values, passes=self.passes, slack=self.slack, source_mask=x_mask, target_mask=y_mask
        )
        return soft, x, y


def edges(e: Float[Array, "n i"], mask: Bool[Array, " n"] | None = None) -> Float[Array, "n n"]:
    """How strongly each point of a cloud is tied to each other one.

    As published: the softmax of each row, then each column divided by its sum, so that neither rows
    nor columns add up to one on the axis of the softmax.
    """
    scores = jnp.matmul(e, e.T, precision=_HIGHEST) / jnp.sqrt(jnp.asarray(e.shape[1], e.dtype))
    if mask is not None:
        scores = jnp.where(mask, scores, -jnp.inf)
    rows = nn.softmax(scores, axis=1)
    if mask is not None:
        rows = jnp.where(mask[:, None], rows, 0)
    return rows / jnp.maximum(jnp.sum(rows, axis=0), 1e-12)


def _standardized(
    values: Float[Array, "n m"],
    x_mask: Bool[Array, " n"] | None,
    y_mask: Bool[Array, " m"] | None,
) -> Float[Array, "n m"]:
    """Instance norm of the block as one channel: mean zero and variance one over its entries."""
    valid = jnp.ones_like(values)
    if x_mask is not None:
        valid *= x_mask[:, None].astype(values.dtype)
    if y_mask is not None:
        valid *= y_mask.astype(values.dtype)
    count = jnp.maximum(jnp.sum(valid), 1)
    centered = values - jnp.sum(values * valid) / count
    variance = jnp.sum(centered * centered * valid) / count
    return centered * lax.rsqrt(variance + EPSILON)


def _near_identity(key: jax.Array, shape: tuple[int, int]) -> Float[Array, "w w"]:
    reach = shape[0] ** -0.5
    drawn = jax.random.uniform(key, shape, jnp.float32, minval=-reach, maxval=reach)
    return jnp.eye(shape[0], dtype=jnp.float32) + drawn


def places_of_graphs() -> dict[str, str]:
    """By the authors' names, where the tensors of both layers go."""
    places: dict[str, str] = {}
    for i in range(2):
        ours = f"graph_{i}"
        places |= places_of_transformer(f"gmattend{i}.model", f"{ours}/look")
        for their, our in (("a_fc", "along"), ("u_fc", "own")):
            theirs = f"gnn_layer_{i}.gconv.{their}"
            places |= {
                f"{theirs}.weight": f"{ours}/{our}/kernel",
                f"{theirs}.bias": f"{ours}/{our}/bias",
            }
        places |= {
            f"affinity_{i}.A": f"{ours}/affinity",
            f"InstNorm_layer_{i}.weight": f"{ours}/scale",
            f"InstNorm_layer_{i}.bias": f"{ours}/shift",
        }
    return places

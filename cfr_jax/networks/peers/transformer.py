"""The transformer of DCP and RGM: each point of one cloud looks at both clouds.

One block of an encoder on the cloud that is looked at, and one of a decoder on the cloud that looks
(Vaswani et al., 2017), normalized before each part, with no positions and no dropout.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.layers import kernel_init

HEADS = 4
_EPSILON = 1e-6
_LINEARS = ("query", "key", "value", "out")
_MOST = 8192  # points of a cloud: a gigabyte of scores in float32, of all heads


def check_sizes(title: str, n: int, m: int) -> None:
    """Raises ValueError for clouds of which all pairs of points would be too many to be stored."""
    if max(n, m) > _MOST:
        raise ValueError(
            f"{title} stores scores of all pairs of points: got clouds of {n} and {m}, wanted at "
            f"most {_MOST}"
        )


class PointNorm(nn.Module):
    """Layer norm as published: the unbiased standard deviation, and epsilon added outside of the
    root. Its gradient is zero, and not NaN, where all channels of a point are equal."""

    @nn.compact
    def __call__(self, x: Float[Array, "n w"]) -> Float[Array, "n w"]:
        width = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (width,))
        shift = self.param("shift", nn.initializers.zeros, (width,))
        centered = x - jnp.mean(x, axis=-1, keepdims=True)
        variance = jnp.sum(centered * centered, axis=-1, keepdims=True) / (width - 1)
        varied = variance > 0
        deviation = jnp.where(varied, jnp.sqrt(jnp.where(varied, variance, 1)), 0)
        return scale * centered / (deviation + _EPSILON) + shift


class Attention(nn.Module):
    """Attention of `HEADS` heads from the rows of `queries` to those of `memory`."""

    @nn.compact
    def __call__(
        self,
        queries: Float[Array, "n w"],
        memory: Float[Array, "m w"],
        mask: Bool[Array, " m"] | None = None,
    ) -> Float[Array, "n w"]:
        width = queries.shape[-1]
        layers = [nn.Dense(width, kernel_init=kernel_init, name=name) for name in _LINEARS]
        query, key, value = (
            layer(x).reshape(len(x), HEADS, width // HEADS)
            for layer, x in zip(layers[:3], (queries, memory, memory), strict=True)
        )
        scores = jnp.einsum("nhd,mhd->hnm", query, key) / jnp.sqrt(width // HEADS).astype(
            query.dtype
        )
        if mask is not None:
            scores = jnp.where(mask, scores, -jnp.inf)
        seen = jnp.einsum("hnm,mhd->nhd", nn.softmax(scores, axis=-1), value)
        return layers[3](seen.reshape(len(queries), width))


class FeedForward(nn.Module):
    """Two linear layers with a ReLU between them."""

    inner: int

    @nn.compact
    def __call__(self, x: Float[Array, "n w"]) -> Float[Array, "n w"]:
        hidden = nn.relu(nn.Dense(self.inner, kernel_init=kernel_init, name="wide")(x))
        return nn.Dense(x.shape[-1], kernel_init=kernel_init, name="narrow")(hidden)


class Transformer(nn.Module):
    """What the points of the first cloud make of themselves and of the second."""

    inner: int

    @nn.compact
    def __call__(
        self,
        looking: Float[Array, "n w"],
        seen: Float[Array, "m w"],
        looking_mask: Bool[Array, " n"] | None = None,
        seen_mask: Bool[Array, " m"] | None = None,
    ) -> Float[Array, "n w"]:
        y = PointNorm(name="encoder_norm_0")(seen)
        seen = seen + Attention(name="encoder_attention")(y, y, seen_mask)
        y = PointNorm(name="encoder_norm_1")(seen)
        seen = seen + FeedForward(self.inner, name="encoder_feed")(y)
        memory = PointNorm(name="encoder_norm")(seen)
        x = PointNorm(name="decoder_norm_0")(looking)
        looking = looking + Attention(name="decoder_attention")(x, x, looking_mask)
        x = PointNorm(name="decoder_norm_1")(looking)
        looking = looking + Attention(name="decoder_cross")(x, memory, seen_mask)
        x = PointNorm(name="decoder_norm_2")(looking)
        looking = looking + FeedForward(self.inner, name="decoder_feed")(x)
        return PointNorm(name="decoder_norm")(looking)


def places_of_transformer(theirs: str, ours: str) -> dict[str, str]:
    """By the authors' names, where the tensors go."""
    places: dict[str, str] = {}
    sides = {"encoder": {"self_attn": "attention"}}
    sides["decoder"] = sides["encoder"] | {"src_attn": "cross"}
    for side, attentions in sides.items():
        block = f"{theirs}.{side}.layers.0"
        for their, our in attentions.items():
            for i, name in enumerate(_LINEARS):
                places |= _linear(f"{block}.{their}.linears.{i}", f"{ours}/{side}_{our}/{name}")
        for their, our in (("w_1", "wide"), ("w_2", "narrow")):
            places |= _linear(f"{block}.feed_forward.{their}", f"{ours}/{side}_feed/{our}")
        for i in range(len(attentions) + 1):
            places |= _norm(f"{block}.sublayer.{i}.norm", f"{ours}/{side}_norm_{i}")
        places |= _norm(f"{theirs}.{side}.norm", f"{ours}/{side}_norm")
    return places


def _linear(theirs: str, ours: str) -> dict[str, str]:
    return {f"{theirs}.weight": f"{ours}/kernel", f"{theirs}.bias": f"{ours}/bias"}


def _norm(theirs: str, ours: str) -> dict[str, str]:
    return {f"{theirs}.a_2": f"{ours}/scale", f"{theirs}.b_2": f"{ours}/shift"}

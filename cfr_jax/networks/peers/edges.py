"""The features of DCP and RGM: an MLP on the edges from each point to its neighbors.

A variant of DGCNN (Wang et al., 2019) with one graph, of the points as they are given: an edge is
the places of both of its ends, so the features change when the cloud moves.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.networks.peers.batch_norm import NormedLinear, places_of_layer
from cfr_jax.networks.peers.maximum import highest

# The widths of the layers on edges, as shares of the whole: together they are as wide as it.
_SHARES = (8, 8, 4, 2)


class EdgeFeatures(nn.Module):
    """Two sets of features of each point: what its edges pooled to after each of four layers, side
    by side, and a fifth layer of that."""

    width: int = 512
    training: bool = False

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n 3"],
        neighbors: Int32[Array, "n k"],
        mask: Bool[Array, " n"] | None = None,
    ) -> tuple[Float[Array, "n w"], Float[Array, "n w"]]:
        # the published 20 neighbors count the point itself
        own = jnp.arange(len(points), dtype=neighbors.dtype)[:, None]
        ends = points[jnp.concatenate([own, neighbors], axis=1)]
        starts = jnp.broadcast_to(points[:, None], ends.shape)
        x, pooled = jnp.concatenate([ends, starts], axis=-1), []
        of_edges = None if mask is None else jnp.broadcast_to(mask[:, None], x.shape[:2])
        for i, share in enumerate(_SHARES):
            layer = NormedLinear(self.width // share, False, self.training, name=f"edge_{i}")
            x = layer(x, of_edges)  # the next layer takes the edges, not what they are pooled to
            pooled.append(highest(x))
        node = jnp.concatenate(pooled, axis=-1)
        return node, NormedLinear(self.width, False, self.training, name="point")(node, mask)


def places_of_edges(theirs: str, ours: str) -> dict[str, str]:
    """By the authors' names, where the tensors go."""
    names = (*(f"edge_{i}" for i in range(len(_SHARES))), "point")
    places: dict[str, str] = {}
    for number, name in enumerate(names, 1):
        layer = f"{theirs}.conv{number}", f"{theirs}.bn{number}"
        places |= places_of_layer(layer, f"{ours}/{name}", bias=False)
    return places

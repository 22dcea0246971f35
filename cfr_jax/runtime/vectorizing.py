"""What `vmap` does to the heavy functions: a batch on a CPU is done cloud by cloud.

Side by side, the activations of all clouds would be in flight at once, and every product would
become a batch of products with weights of their own (the norms are folded into them, and differ
from cloud to cloud). On a CPU one cloud keeps all cores busy, and one tile of it fits a cache:
a batch in turn takes three quarters of the time. Accelerators take it side by side, as usual.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array, lax
from jax.custom_batching import custom_vmap


def cloud_by_cloud(on_cpu: Callable, elsewhere: Callable) -> Callable:
    """One function, arrays in and arrays out, such that `vmap` maps it in turn on CPUs; two ways to
    the same result, for CPUs and for the rest."""

    @custom_vmap
    def mapped(*arguments: Any) -> Any:
        return lax.platform_dependent(*arguments, cpu=on_cpu, default=elsewhere)

    @mapped.def_vmap
    def batch(size: int, batched: Any, *arguments: Any) -> tuple[Any, Any]:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        leaves, structure = jax.tree.flatten(arguments)
        flags = jax.tree.leaves(batched)

        def in_turn(*leaves: Array) -> Any:
            def one(own: list[Array]) -> Any:
                mapped_over = iter(own)
                every = [
                    next(mapped_over) if b else leaf for leaf, b in zip(leaves, flags, strict=True)
                ]
                return on_cpu(*jax.tree.unflatten(structure, every))

            return lax.map(one, [leaf for leaf, b in zip(leaves, flags, strict=True) if b])

        def side_by_side(*leaves: Array) -> Any:
            return jax.vmap(elsewhere, in_axes=axes)(*jax.tree.unflatten(structure, leaves))

        found = lax.platform_dependent(*leaves, cpu=in_turn, default=side_by_side)
        return found, jax.tree.map(lambda _: True, found)

    return mapped

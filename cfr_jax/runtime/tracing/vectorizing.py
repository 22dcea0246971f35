"""How `vmap` treats the heavy functions: on a CPU, a batch is processed one cloud at a time.

Side by side, the activations of all clouds would be in memory at once. Every matrix product would
become a batch of products with different weights, because the norms are folded into the weights
and differ from cloud to cloud. On a CPU one cloud keeps all cores busy, and a tile of it fits in a
cache: one cloud at a time takes three quarters of the time. Accelerators process the clouds side by
side, as usual.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array, lax
from jax.custom_batching import custom_vmap


def cloud_by_cloud(on_cpu: Callable, elsewhere: Callable) -> Callable:
    """A function of arrays that `vmap` maps one example at a time on CPUs, side by side elsewhere.

    `on_cpu` and `elsewhere` compute the same result in two ways.
    """

    @custom_vmap
    def mapped(*arguments: Any) -> Any:
        return lax.platform_dependent(*arguments, cpu=on_cpu, default=elsewhere)

    @mapped.def_vmap
    def batch(
        size: Any,  # a number, or a symbol in a program exported for any number
        batched: Any,
        *arguments: Any,
    ) -> tuple[Any, Any]:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        leaves, structure = jax.tree.flatten(arguments)
        flags = jax.tree.leaves(batched)
        if not any(flags):  # as in a Jacobian, where tangents alone are batched
            found = lax.platform_dependent(*arguments, cpu=on_cpu, default=elsewhere)
            return found, jax.tree.map(lambda _: False, found)

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

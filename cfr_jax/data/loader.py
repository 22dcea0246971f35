"""Training batches: pairs drawn from sources, each with its own random seed.

Which pair comes at a position depends only on (seed, position). So any number of workers draws the
same pairs, and a run that resumes at a position continues with the pair it would have had.
"""

from __future__ import annotations

import collections
import functools
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.worker_pool import open_pool


@runtime_checkable
class Source(Protocol):
    """Where pairs come from."""

    def __len__(self) -> int: ...

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        """A pair made from item `index`, in the format of `pairs_on_host.finish_pair`."""
        ...


def batch_at(
    source: Source, position: int, size: int, sampling: Sampling, seed: int
) -> dict[str, np.ndarray]:
    """`size` pairs of the endless shuffled stream, starting at `position`; arrays (size, ...)."""
    pairs = []
    for number, item in zip(
        range(position, position + size), items_at(len(source), position, size, seed), strict=True
    ):
        rng = np.random.default_rng((seed, *divmod(number, len(source))))
        pairs.append(source.draw(int(item), sampling, rng))
    return {key: np.stack([pair[key] for pair in pairs]) for key in pairs[0]}


def items_at(count: int, position: int, size: int, seed: int) -> Int[np.ndarray, " size"]:
    """The item indices of `size` pairs, starting at `position`.

    Each of the `count` items comes once per epoch, in an order that depends on the seed and the
    epoch.
    """
    epochs, places = np.divmod(np.arange(position, position + size), count)
    return np.array(
        [
            _order(count, seed, int(epoch))[place]
            for epoch, place in zip(epochs, places, strict=True)
        ]
    )


@functools.lru_cache(4)
def _order(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


def batches(
    source: Source,
    sampling: Sampling,
    *,
    size: int,
    position: int,
    count: int,
    seed: int,
    workers: int = 2,
    share: slice = slice(None),
) -> Iterator[dict[str, np.ndarray]]:
    """`count` batches starting at `position`, prepared ahead of use by `workers` threads, or
    processes where there are many (`worker_pool`).

    Only the rows of each batch that are in `share` are made, so that each of several processes
    makes only its own. Raises ValueError for fewer than one worker.
    """
    if workers < 1:
        raise ValueError(f"workers: got {workers}, wanted at least 1")
    start, stop, _ = share.indices(size)
    draw = functools.partial(batch_at, source, size=stop - start, sampling=sampling, seed=seed)
    with open_pool(workers, draw) as submit:
        waiting: collections.deque = collections.deque()
        for number in range(count):
            waiting.append(submit(position + number * size + start))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

"""Where the pairs of a training are drawn, and so what it does in one go.

`HostDrawing`: workers draw batches ahead of their use, and each is a step. `DeviceDrawing`: the
corpus lies on the device, and a program of several steps draws its own pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, runtime_checkable

from jax.sharding import Mesh

from cfr_jax.data.augment import Sampling
from cfr_jax.data.mixture import Mixture
from cfr_jax.training.config import Phase, TrainingConfig
from cfr_jax.training.losses import PairLoss
from cfr_jax.training.step import Recipe, TrainState


class Stretch(NamedTuple):
    """Some steps in one go; `run` donates the state that it is given."""

    steps: int
    run: Callable[[TrainState], tuple[TrainState, PairLoss]]


class Leg(NamedTuple):
    """A phase, and what its steps are compiled for."""

    phase: Phase
    sampling: Sampling
    recipe: Recipe


@runtime_checkable
class Drawing(Protocol):
    """What the loop asks of a place where pairs are drawn."""

    def begin(self, leg: Leg, state: TrainState) -> None:
        """Compiles in the background what can be, as soon as it is known that `leg` is next."""
        ...

    def stretches(self, leg: Leg, state: TrainState, ran: int, position: int) -> Iterator[Stretch]:
        """The steps of a leg of which `ran` are done, from that position in the stream on. (Of
        `state` only the sizes are of interest.)"""
        ...


def make_drawing(config: TrainingConfig, mixture: Mixture, mesh: Mesh) -> Drawing:
    """What `config.train.draw` asks for, "host" or "device"."""
    # imported here: each knows this file
    if config.train.draw == "device":
        from cfr_jax.training.drawing.device import DeviceDrawing

        return DeviceDrawing(config, mixture, mesh)
    from cfr_jax.training.drawing.host import HostDrawing

    return HostDrawing(config, mixture, mesh)

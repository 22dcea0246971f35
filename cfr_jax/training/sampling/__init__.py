"""Where training pairs are drawn, and so how many steps run at once.

`HostDrawing`: threads draw batches ahead of time, and each batch is one step. `DeviceDrawing`: the
corpus is on the device, and a program of several steps draws its own pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, runtime_checkable

from jax.sharding import Mesh

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.mixture import Mixture
from cfr_jax.training.config import Phase, TrainingConfig
from cfr_jax.training.losses import PairLoss
from cfr_jax.training.step import Recipe, TrainState


class Stretch(NamedTuple):
    """Some steps that run at once; `run` donates the state that it is given."""

    steps: int
    run: Callable[[TrainState], tuple[TrainState, PairLoss]]


class Leg(NamedTuple):
    """A phase, and what its steps depend on when they are compiled."""

    phase: Phase
    sampling: Sampling
    recipe: Recipe


@runtime_checkable
class Drawing(Protocol):
    """A way to draw pairs, as the training loop uses it."""

    def begin(self, leg: Leg, state: TrainState) -> None:
        """Starts to compile in the background, as soon as it is known that `leg` is next."""
        ...

    def stretches(self, leg: Leg, state: TrainState, ran: int, position: int) -> Iterator[Stretch]:
        """Yields the remaining steps of a leg, of which `ran` are done.

        `position` is the next pair in the stream. Only the shapes of `state` matter.
        """
        ...


def make_drawing(config: TrainingConfig, mixture: Mixture, mesh: Mesh) -> Drawing:
    """The drawing that `config.train.draw` names, "host" or "device"."""
    # imported here because both modules import this one
    if config.train.draw == "device":
        from cfr_jax.training.sampling.device import DeviceDrawing

        return DeviceDrawing(config, mixture, mesh)
    from cfr_jax.training.sampling.host import HostDrawing

    return HostDrawing(config, mixture, mesh)

"""Draws batches on the host's cores; each batch is one step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jax.sharding import Mesh

from cfr_jax.data.loader import batches
from cfr_jax.data.mixture import Mixture
from cfr_jax.training import devices, step
from cfr_jax.training.config import TrainingConfig
from cfr_jax.training.losses import PairLoss
from cfr_jax.training.sampling import Leg, Stretch
from cfr_jax.training.step import TrainState


class HostDrawing:
    """`config.train.workers` threads or processes draw ahead, from sources of any kind."""

    def __init__(self, config: TrainingConfig, mixture: Mixture, mesh: Mesh):
        self._config, self._mixture, self._mesh = config, mixture, mesh

    def begin(self, leg: Leg, state: TrainState) -> None:
        """Does nothing: the first step compiles."""

    def stretches(self, leg: Leg, state: TrainState, ran: int, position: int) -> Iterator[Stretch]:
        """Yields one step per batch."""
        stream = batches(
            self._mixture,
            leg.sampling,
            size=leg.phase.batch,
            position=position,
            count=leg.phase.steps - ran,
            seed=self._config.seed,
            workers=self._config.train.workers,
            share=devices.share_of(leg.phase.batch),
        )
        for batch in stream:

            def run(
                state: TrainState, batch: dict[str, np.ndarray] = batch
            ) -> tuple[TrainState, PairLoss]:
                return step.train_step(state, devices.spread(batch, self._mesh), recipe=leg.recipe)

            yield Stretch(1, run)

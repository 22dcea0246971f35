"""Draws pairs on the devices that train on them, for several steps at a time."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from cfr_jax.data.augmentation.pairs_on_device import Shapes
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.loader import items_at
from cfr_jax.data.mixture import Mixture
from cfr_jax.data.sources import ShapeSource
from cfr_jax.training import devices, step
from cfr_jax.training.config import TrainingConfig
from cfr_jax.training.losses import PairLoss
from cfr_jax.training.sampling import Leg, Stretch
from cfr_jax.training.step import TrainState

_TIMED = 2  # stretches that are timed to measure the speed


class DeviceDrawing:
    """`config.train.steps_at_once` steps in one program; the host only chooses the shapes.

    Raises ValueError if the data contain anything but shapes, or shapes of different sizes.
    """

    def __init__(self, config: TrainingConfig, mixture: Mixture, mesh: Mesh):
        self._steps, self._seed, self._mesh = config.train.steps_at_once, config.seed, mesh
        shapes, self._rows = _shapes(mixture)
        self._on_device = devices.replicate((shapes, np.uint32(config.seed % 2**32)), mesh)
        self._programs: dict[tuple[Any, ...], Future[jax.stages.Compiled]] = {}

    def begin(self, leg: Leg, state: TrainState) -> None:
        """Traces the program now, and compiles it in a thread."""
        self._compiling(leg, self._steps, state)

    def stretches(self, leg: Leg, state: TrainState, ran: int, position: int) -> Iterator[Stretch]:
        """Yields the configured number of steps at a time, and at the end those that are left."""
        while ran < leg.phase.steps:
            steps = min(self._steps, leg.phase.steps - ran)
            program = self._compiling(leg, steps, state).result()
            places = self._places(leg.phase.batch, steps, position)
            yield Stretch(steps, functools.partial(_run, program, self._on_device, places))
            ran, position = ran + steps, position + steps * leg.phase.batch

    def speed(self, leg: Leg, state: TrainState) -> float:
        """Steps per second, measured on a copy of the state."""
        program = self._compiling(leg, self._steps, state).result()
        places = self._places(leg.phase.batch, self._steps, 0)
        copy, began = jax.tree.map(jnp.copy, state), 0.0
        for number in range(1 + _TIMED):
            if number == 1:  # the first run still loads the program
                began = time.perf_counter()
            copy, measured = _run(program, self._on_device, places, copy)
            jax.block_until_ready(measured.total)
        return _TIMED * self._steps / (time.perf_counter() - began)

    def _compiling(self, leg: Leg, steps: int, state: TrainState) -> Future[jax.stages.Compiled]:
        known = leg.recipe, leg.sampling, leg.phase.batch, steps
        if known not in self._programs:
            lowered = step.train_on_drawn.lower(
                state,
                *self._on_device,
                *self._places(leg.phase.batch, steps, 0),
                recipe=leg.recipe,
                sampling=leg.sampling,
            )
            thread = ThreadPoolExecutor(1)
            self._programs[known] = thread.submit(lowered.compile)
            thread.shutdown(wait=False)
        return self._programs[known]

    def _places(self, batch: int, steps: int, position: int) -> list[jax.Array]:
        """Rows of the corpus and positions in the stream, both (steps, batch), on the devices."""
        share = devices.share_of(batch)
        items = items_at(len(self._rows), position, steps * batch, self._seed)
        places = np.arange(position, position + steps * batch)
        return [
            devices.spread_steps(rows.astype(kind).reshape(steps, batch)[:, share], self._mesh)
            for rows, kind in ((self._rows[items], np.int32), (places % 2**32, np.uint32))
        ]


def _run(
    program: jax.stages.Compiled,
    on_device: tuple[Any, ...],
    places: list[jax.Array],
    state: TrainState,
) -> tuple[TrainState, PairLoss]:
    return program(state, *on_device, *places)


def _shapes(mixture: Mixture) -> tuple[Shapes, np.ndarray]:
    """All shapes of a mixture, and for each item of the mixture the row of its shape."""
    corpora: list[Corpus] = []
    rows, before = [], 0
    for source, repeat in zip(mixture.sources, mixture.repeats, strict=True):
        if not isinstance(source, ShapeSource):
            raise ValueError(
                'draw: got "device", but data.train holds scans; wanted "host", or only shapes'
            )
        rows.append(np.tile(before + np.arange(len(source)), repeat))
        corpora.append(source.corpus)
        before += len(source)
    sizes = sorted({corpus.points.shape[1] for corpus in corpora})
    if len(sizes) > 1:
        raise ValueError(
            f'draw: got "device", but the shapes of data.train have {sizes} points; wanted "host", '
            "or equally many points in each"
        )
    parts = [Shapes.of(corpus) for corpus in corpora]
    shapes = Shapes(*(np.concatenate(leaves) for leaves in zip(*map(_fields, parts), strict=True)))
    return shapes, np.concatenate(rows)


def _fields(shapes: Shapes) -> tuple[jax.Array | np.ndarray, jax.Array | np.ndarray]:
    return shapes.points, shapes.normals

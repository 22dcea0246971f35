"""Opens and checks everything that a config names, before anything is compiled."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.making.build import ENOUGH
from cfr_jax.data.mixture import (
    Mixture,
    check_apart,
    check_readable,
    fixed_pairs,
    open_mixture,
)
from cfr_jax.networks.probability import uncalibrated
from cfr_jax.networks.record import Params
from cfr_jax.training import devices, optimizers
from cfr_jax.training.config import Phase, TrainingConfig, checked
from cfr_jax.training.learner import Learner, learner
from cfr_jax.weights.files import load_params


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """What to train, on which data, for how long, and what to validate on."""

    learner: Learner
    mesh: Mesh
    phases: tuple[Phase, ...]
    samplings: tuple[Sampling, ...]
    """One for each phase."""
    mixture: Mixture
    pairs: dict[str, np.ndarray]
    """The validation pairs, as one batch."""
    schedule: optax.Schedule
    optimizer: optax.GradientTransformation
    stamps: dict[str, str]
    """Identify the training and the validation data: different data have different stamps."""
    told: tuple[str, ...]
    """Messages for the user."""

    @property
    def steps(self) -> int:
        """The steps of all phases together."""
        return sum(phase.steps for phase in self.phases)

    def planned(self, steps: int) -> Task:
        """The same task, with `steps` steps in its only phase."""
        phase = dataclasses.replace(self.phases[0], steps=steps)
        schedule = dataclasses.replace(self.schedule, steps=steps)
        return dataclasses.replace(self, phases=(phase,), schedule=schedule)


def prepare(config: TrainingConfig, workdir: Path) -> Task:
    """The task of a config.

    Refined truths are kept in `workdir`, and so is a note that all scans can be read. Raises a
    ValueError that names the field if the config cannot be used, if the data cannot be read, or if
    training and validation share a scan.
    """
    config = checked(config)
    chosen, mesh = learner(config), devices.make_mesh()
    for phase in config.phases:
        devices.check_batch(phase.batch, config.train.pairs_at_once, mesh)
    radius = chosen.validated.radius
    samplings = tuple(config.sampling_of(phase, radius) for phase in config.phases)
    schedule = optimizers.make_schedule(
        config.train.schedule,
        peak_rate=config.train.peak_rate,
        # with minutes, the number of steps is known only later
        steps=1 if config.train.minutes else sum(phase.steps for phase in config.phases),
        warmup=config.train.warmup,
        cooldown=config.train.cooldown,
        drops=config.train.drops,
        factor=config.train.drop_factor,
    )
    optimizer = optimizers.make_optimizer(
        config.train.optimizer,
        schedule,
        clip=config.train.clip,
        weight_decay=config.train.weight_decay,
    )
    if chosen.objective is not None:
        optimizer = optimizers.keep_running(optimizer)
    mixture = open_mixture(config.data.train, workdir, "data.train")
    held_out = open_mixture(config.data.validation, workdir, "data.validation")
    check_apart(mixture, held_out)
    check_readable(mixture, workdir, "data.train", remember=devices.is_first())
    check_readable(held_out, workdir, "data.validation", remember=devices.is_first())
    pairs = fixed_pairs(
        held_out,
        config.validation_pairs,
        samplings[-1],
        chosen.validated.neighbors,
        radius,
    )
    return Task(
        learner=chosen,
        mesh=mesh,
        phases=config.phases,
        samplings=samplings,
        mixture=mixture,
        pairs=pairs,
        schedule=schedule,
        optimizer=optimizer,
        stamps={
            "data.train": mixture.stamp(),
            "data.validation": held_out.stamp(pairs["transform"]),
        },
        told=_told(config, mixture, held_out, len(pairs["transform"]), workdir),
    )


def fresh_params(config: TrainingConfig, chosen: Learner) -> Params:
    """The weights that a run starts from: those of `train.start_from`, or random ones.

    Raises ValueError if given weights do not have the shapes that the config asks for.
    """
    key = jax.random.key(config.seed)
    if not config.train.start_from:
        return jax.jit(chosen.fresh)(key)
    # the calibration would not fit the weights after training
    params = uncalibrated(load_params(config.train.start_from, config.network))
    shapes = [jax.tree.map(jnp.shape, tree) for tree in (params, jax.eval_shape(chosen.fresh, key))]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"train.start_from: {config.train.start_from} was not made with config.iterations = "
            f"{config.iterations} and config.shared = {config.shared}; set both to what it was "
            "made with"
        )
    return params


def _told(
    config: TrainingConfig, mixture: Mixture, held_out: Mixture, count: int, workdir: Path
) -> tuple[str, ...]:
    begun = config.train.start_from or "random numbers"
    told = [
        f"training on {mixture.told()}, starting from {begun}; "
        f"validating on {count} pairs of {held_out.told()}; writing to {workdir}"
    ]
    if count < ENOUGH:
        told.append(
            f"only {count} validation pairs: with fewer than {ENOUGH}, the choice of the best "
            "weights depends on chance"
        )
    return tuple(told)

"""All that a config asks for, opened and checked before anything is compiled."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from cfr_jax.data.augment import Sampling
from cfr_jax.data.loader import Mixture
from cfr_jax.data.making.build import ENOUGH
from cfr_jax.training import devices, optimizers, sources, step
from cfr_jax.training.learner import Learner, Phase, learner
from cfr_jax.weights import files as weights

_FIELDS = (
    "seed", "network", "iterations", "data.train", "data.validation", "phases", "sampling",
    "train.optimizer", "train.schedule", "train.peak_rate", "train.warmup", "train.cooldown",
    "train.clip", "train.weight_decay", "train.correspondence_weight", "train.average_decay",
    "train.precision", "train.pairs_at_once", "train.max_skipped", "train.workers",
    "train.start_from", "log_every", "checkpoint_every", "validate_every", "validation_pairs",
    "keep_checkpoints",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """What is trained, on what, for how long, and what it is validated on."""

    learner: Learner
    mesh: Mesh
    phases: tuple[Phase, ...]
    samplings: tuple[Sampling, ...]
    """One of each phase."""
    mixture: Mixture
    pairs: dict
    """What is validated on, as one batch."""
    schedule: optax.Schedule
    optimizer: optax.GradientTransformation
    stamps: dict[str, str]
    """Of the training and of the validation data: other text, other data."""
    told: tuple[str, ...]
    """In words, for whoever watches."""

    @property
    def steps(self) -> int:
        """Of all phases."""
        return sum(phase.steps for phase in self.phases)


def prepare(config: Any, workdir: Path) -> Task:
    """The task of a config; refined truths, and that all scans can be read, are kept in `workdir`.

    Raises ValueError, naming the field, where the config cannot be used, the data cannot be read,
    or training and validation share a scan.
    """
    _check_fields(config)
    chosen, mesh = learner(config), devices.make_mesh()
    phases = tuple(_made(Phase, dict(phase), "phases") for phase in config.phases)
    for phase in phases:
        devices.check_batch(phase.batch, config.train.pairs_at_once, mesh)
    samplings = tuple(
        _sampling(phase, chosen.validated.radius, config.sampling.to_dict() | phase.sampling)
        for phase in phases
    )
    if config.train.precision not in step.PRECISIONS:
        raise ValueError(
            f"precision: got {config.train.precision!r}, wanted one of {', '.join(step.PRECISIONS)}"
        )
    schedule = optimizers.make_schedule(
        config.train.schedule,
        peak_rate=config.train.peak_rate,
        steps=sum(phase.steps for phase in phases),
        warmup=config.train.warmup,
        cooldown=config.train.cooldown,
    )
    optimizer = optimizers.make_optimizer(
        config.train.optimizer,
        schedule,
        clip=config.train.clip,
        weight_decay=config.train.weight_decay,
    )
    mixture = sources.open_mixture(config.data.train, workdir, "data.train")
    held_out = sources.open_mixture(config.data.validation, workdir, "data.validation")
    sources.check_apart(mixture, held_out)
    sources.check_readable(mixture, workdir, "data.train")
    sources.check_readable(held_out, workdir, "data.validation")
    pairs = sources.fixed_pairs(
        held_out,
        config.validation_pairs,
        samplings[-1],
        chosen.validated.neighbors,
        chosen.validated.radius,
    )
    return Task(
        learner=chosen,
        mesh=mesh,
        phases=phases,
        samplings=samplings,
        mixture=mixture,
        pairs=pairs,
        schedule=schedule,
        optimizer=optimizer,
        stamps={
            "data.train": sources.stamp(mixture),
            "data.validation": sources.stamp(held_out, pairs["transform"]),
        },
        told=_told(config, mixture, held_out, len(pairs["transform"]), workdir),
    )


def fresh_params(config: Any, chosen: Learner) -> dict:
    """The weights that a run begins with: those of `train.start_from`, or random ones.

    Raises ValueError where those do not have the iterations that the config asks for.
    """
    key = jax.random.key(config.seed)
    if not config.train.start_from:
        return jax.jit(chosen.fresh)(key)
    params = weights.load_params(config.train.start_from, config.network)
    shapes = [jax.tree.map(jnp.shape, tree) for tree in (params, jax.eval_shape(chosen.fresh, key))]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"train.start_from: {config.train.start_from} has other iterations than "
            f"config.iterations = {config.iterations}, or shares its layer where config.shared "
            "says otherwise (or the other way round); set both as they were"
        )
    return params


def _check_fields(config):
    def lacks(name):
        room, _, field = name.rpartition(".")
        return field not in (config.get(room, {}) if room else config)

    if lacking := [name for name in _FIELDS if lacks(name)]:
        raise ValueError(
            f"config: lacks {', '.join(lacking)}; configs/open_cad.py says what they are"
        )
    counts = "log_every", "checkpoint_every", "validate_every", "validation_pairs"
    for field in (*counts, "keep_checkpoints"):
        if config[field] < 1:
            raise ValueError(f"{field}: got {config[field]}, wanted at least 1")
    for field, least in (("workers", 1), ("max_skipped", 0)):
        if config.train[field] < least:
            raise ValueError(f"{field}: got {config.train[field]}, wanted at least {least}")


def _sampling(phase, radius, fields):
    # neighbors are found on the host: within the network's radius, as many as the phase says
    if wrong := fields.keys() & {"points", "neighbors", "radius"}:
        raise ValueError(
            f"sampling: got {', '.join(sorted(wrong))}; points and neighbors stand in a phase, the "
            "radius in config.settings"
        )
    given = {"points": phase.points, "neighbors": phase.neighbors, "radius": radius}
    return _made(Sampling, given | fields, "sampling")


def _made(kind, fields, where):
    """What a config file describes by `fields`; one of its author's own may have others."""
    try:
        return kind(**fields)
    except TypeError as error:
        raise ValueError(f"{where}: {error}") from error


def _told(config, mixture, held_out, count, workdir):
    begun = config.train.start_from or "random numbers"
    told = [
        f"training on {sources.told(mixture)}, from {begun}; "
        f"validated on {count} pairs of {sources.told(held_out)}; all of it goes to {workdir}"
    ]
    if count < ENOUGH:
        told.append(
            f"only {count} validation pairs: which weights are best is a matter of chance with "
            f"fewer than {ENOUGH}"
        )
    return tuple(told)

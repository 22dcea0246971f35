"""The training loop: batches in, checkpoints, measurements and weights out."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import time
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cfr_jax import __version__, weights
from cfr_jax.data.augment import Sampling
from cfr_jax.data.batches import batches
from cfr_jax.training import devices, optimizers, sources, step, validation
from cfr_jax.training.checkpoints import Checkpoints
from cfr_jax.training.learner import Phase, learner, remaining
from cfr_jax.training.reports import Reports

_NAMED = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


def run(config: Any, workdir: Path) -> dict:
    """Trains by `config` in `workdir`, going on where a checkpoint there left off.

    Writes `checkpoints/`, `metrics.jsonl` (a line each time something is measured),
    `weights.safetensors` (the averaged weights of the best validation so far), and at the end
    `summary.html`. Returns the best validation. Raises ValueError where config, data or
    checkpoints cannot be used, `Diverged` where gradients stay infinite, and OSError where nothing
    can be written.
    """
    chosen, mesh = learner(config), devices.make_mesh()
    phases = [Phase(**phase) for phase in config.phases]
    samplings = [_sampling(config, phase) for phase in phases]
    for phase in phases:
        devices.check_batch(phase.batch, config.train.pairs_at_once, mesh)
        if phase.batch % jax.process_count():
            raise ValueError(f"batch: got {phase.batch}, wanted a multiple of the processes")
    if config.train.precision not in step.PRECISIONS:
        raise ValueError(
            f"precision: got {config.train.precision!r}, wanted one of {', '.join(step.PRECISIONS)}"
        )
    workdir.mkdir(parents=True, exist_ok=True)
    mixture = sources.open_mixture(config.data.train, workdir, "data.train")
    held_out = sources.open_mixture(config.data.validation, workdir, "data.validation")
    sources.check_apart(mixture, held_out)
    pairs = sources.fixed_pairs(
        held_out,
        config.validation_pairs,
        phases[-1].points,
        chosen.validated.neighbors,
        chosen.validated.radius,
    )
    placed = validation.place(pairs, mesh)
    total = sum(phase.steps for phase in phases)
    schedule = optimizers.make_schedule(
        config.train.schedule,
        peak_rate=config.train.peak_rate,
        steps=total,
        warmup=config.train.warmup,
        cooldown=config.train.cooldown,
    )
    optimizer = optimizers.make_optimizer(
        config.train.optimizer,
        schedule,
        clip=config.train.clip,
        weight_decay=config.train.weight_decay,
    )
    if config.train.start_from:
        params = weights.load_params(config.train.start_from, config.network)
    else:
        params = jax.jit(chosen.fresh)(jax.random.key(config.seed))
    state = devices.replicate(step.init_state(params, optimizer), mesh)
    about = _about(config)
    with Checkpoints(workdir / "checkpoints", keep=config.keep_checkpoints) as checkpoints:
        restored = checkpoints.restore(state)
        if restored is not None:
            state, before = restored
            _warn_of_changes(before["config"], about["config"])
            about |= {key: before[key] for key in ("best", "validation", "position", "clock")}
        done = int(state.step)
        reports = Reports(workdir, total, done, about["clock"], schedule, pairs)
        for phase, ran in remaining(phases, done):
            recipe = step.Recipe(
                unroll=chosen.unroll,
                settings=chosen.trained(phase.neighbors),
                optimizer=optimizer,
                mesh=mesh,
                correspondence_weight=config.train.correspondence_weight,
                average_decay=config.train.average_decay,
                pairs_at_once=config.train.pairs_at_once,
                precision=config.train.precision,
            )
            stream = batches(
                mixture,
                samplings[phases.index(phase)],
                size=phase.batch,
                position=about["position"],
                count=phase.steps - ran,
                seed=config.seed,
                workers=config.train.workers,
                share=devices.share_of(phase.batch),
            )
            reports.resume()
            for batch in stream:
                state, measured = step.train_step(state, devices.spread(batch, mesh), recipe=recipe)
                done, about["position"] = done + 1, about["position"] + phase.batch
                reports.step(done, measured)
                if done % config.log_every == 0:
                    reports.measured(done, int(state.skipped))
                    _stop_if_diverged(int(state.skipped_in_row), done, config.train.max_skipped)
                validating = done % config.validate_every == 0 or done == total
                if validating:
                    reports.pause()
                    found = validation.validate(
                        chosen, state.average, placed, pairs["transform"], mesh
                    )
                    reports.validated(done, found)
                    del found["transforms"]
                    about["validation"] = {"step": done, **found}
                    if found["rotation_mean"] < about["best"].get("rotation_mean", np.inf):
                        about["best"] = about["validation"]
                        if devices.is_first():
                            weights.save_params(
                                workdir / "weights.safetensors",
                                state.average,
                                _notes(config, about),
                            )
                    reports.resume()
                if validating or done % config.checkpoint_every == 0:
                    about |= {"clock": reports.clock.read(), "skipped": int(state.skipped)}
                    checkpoints.save(state, about | {"step": done}, best=about["best"].get("step"))
        about |= {"clock": reports.clock.read(), "skipped": int(state.skipped)}
        reports.close(about | {"step": done})
    return about["best"]


class Diverged(ValueError):
    """Too many steps in a row had a gradient that is not finite."""


def _stop_if_diverged(in_row: int, done: int, most: int) -> None:
    if in_row > most:
        raise Diverged(
            f"the last {in_row} of {done} steps had gradients that are not finite, more than "
            f"train.max_skipped = {most}; the last checkpoint holds the last sound weights.\n"
            "Try a lower train.peak_rate or train.clip, and look for broken shapes in the data"
        )


def _sampling(config, phase):
    return Sampling(points=phase.points, neighbors=phase.neighbors, **config.sampling.to_dict())


def _about(config) -> dict:
    """What a checkpoint says of itself, before the first step."""
    versions = {name: importlib.metadata.version(name) for name in _NAMED}
    versions |= {"cfr_jax": __version__, "python": platform.python_version()}
    return {
        "best": {},
        "validation": {},  # the last one
        "position": 0,  # pairs of the stream that were used; with the seed it decides all others
        "random_key": np.asarray(jax.random.key_data(jax.random.key(config.seed))).tolist(),
        "skipped": 0,
        "clock": {"seconds": 0.0, "processor_seconds": 0.0},
        "config": json.loads(json.dumps(config.to_dict())),
        "versions": versions,
        "started": time.strftime("%Y-%m-%d %H:%M:%S %z"),
    }


def _warn_of_changes(before: dict, now: dict) -> None:
    changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    if changed:
        warnings.warn(
            f"the config differs from the checkpoint's in {', '.join(changed)}: going on by the "
            "new one",
            stacklevel=3,
        )


def _notes(config, about) -> dict[str, str]:
    """What the weights file says of its own making."""
    return {
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "validation": json.dumps(about["best"]),
        "made_by": f"cfr_jax {__version__} train.py",
    }

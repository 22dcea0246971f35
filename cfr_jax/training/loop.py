"""The training loop: batches in, checkpoints, measurements and weights out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from cfr_jax.data.loader import batches
from cfr_jax.training import devices, identity, step, stopping, validation
from cfr_jax.training.checkpoints import Checkpoints
from cfr_jax.training.config import Phase, TrainingConfig
from cfr_jax.training.learner import remaining
from cfr_jax.training.reporting.reporter import Reporter
from cfr_jax.training.step import TrainState
from cfr_jax.training.task import Task, fresh_params, prepare
from cfr_jax.weights import files as weights


def run(config: TrainingConfig, workdir: Path) -> dict:
    """Trains by `config` in `workdir`, going on where a checkpoint there left off.

    Writes `checkpoints/`, `metrics.jsonl` (a line each time something is measured),
    `weights.safetensors` (the averaged weights of the best validation so far, those it began with
    included where these were trained), and when it ends or is stopped `summary.html`. Returns the
    best validation.

    Raises ValueError where config, data or checkpoints cannot be used, `Diverged` where gradients
    or answers stay infinite, OSError where nothing can be written, and `Stopped` after SIGINT or
    SIGTERM, once all is saved.
    """
    if workdir.exists() and not workdir.is_dir():
        raise ValueError(f"workdir: {workdir} is a file, wanted a folder")
    workdir.mkdir(parents=True, exist_ok=True)
    task = prepare(config, workdir)
    state = devices.replicate(
        step.init_state(fresh_params(config, task.learner), task.optimizer), task.mesh
    )
    about, told = identity.begin(config, task.stamps), list(task.told)
    with Checkpoints(workdir / "checkpoints", keep=config.keep_checkpoints) as checkpoints:
        restored = checkpoints.restore(state)
        if restored is not None:
            state, before = restored
            told += identity.go_on(before, about, task.steps, workdir)
        with Reporter(workdir, task, about) as reports:
            for line in told:
                reports.say(line)
            _Training(config, workdir, task, state, about, checkpoints, reports).go_to_the_end()
    return about["best"]


@dataclasses.dataclass
class _Training:
    """A run from its start, or from a checkpoint, to its end; `about` tells where it is."""

    config: TrainingConfig
    workdir: Path
    task: Task
    state: TrainState
    about: dict
    checkpoints: Checkpoints
    reports: Reporter

    def __post_init__(self):
        self._placed = validation.place(self.task.pairs, self.task.mesh)

    def go_to_the_end(self) -> None:
        if self.config.train.start_from and self.about["step"] == 0:
            self._validate()
        self._keep_best()  # a kill may have come between a checkpoint and its weights
        with stopping.stop_requests() as requests:
            for phase, ran in remaining(self.task.phases, self.about["step"]):
                self._go_through(phase, ran, requests)
        if not self.about["best"]:  # stopped before its first validation, and cut short since
            self._validate()
            self._keep_best()
        self._take_note()

    def _go_through(self, phase: Phase, ran: int, requests: stopping.Requests) -> None:
        config, task, about = self.config, self.task, self.about
        recipe = step.Recipe(
            unroll=task.learner.unroll,
            settings=task.learner.trained(phase.neighbors),
            optimizer=task.optimizer,
            mesh=task.mesh,
            correspondence_weight=config.train.correspondence_weight,
            average_decay=config.train.average_decay,
            pairs_at_once=config.train.pairs_at_once,
            precision=config.train.precision,
            max_skipped=config.train.max_skipped,
        )
        stream = batches(
            task.mixture,
            task.samplings[task.phases.index(phase)],
            size=phase.batch,
            position=about["position"],
            count=phase.steps - ran,
            seed=config.seed,
            workers=config.train.workers,
            share=devices.share_of(phase.batch),
        )
        self.reports.begin(phase)
        for batch in stream:
            self.state, measured = step.train_step(
                self.state, devices.spread(batch, task.mesh), recipe=recipe
            )
            done = about["step"] = about["step"] + 1
            about["position"] += phase.batch
            self.reports.step(done, measured)
            last, asked = done == task.steps, requests.received
            logging = last or done % config.log_every == 0
            validating = last or done % config.validate_every == 0
            saving = validating or done % config.checkpoint_every == 0 or asked
            if logging:
                self.reports.measured(done, int(self.state.skipped))
            if logging or saving:
                _stop_if_diverged(int(self.state.skipped_in_row), done, config.train.max_skipped)
            if validating:
                self._validate()
            if saving:
                self._take_note()
                self.checkpoints.save(self.state, about.copy(), best=about["best"].get("step"))
            if validating:
                self._keep_best()
            if asked:
                self.checkpoints.wait()
                raise stopping.Stopped(
                    f"stopped at step {done} of {task.steps}, all saved; "
                    "the same command goes on from there",
                    asked,
                )

    def _validate(self) -> None:
        task, about = self.task, self.about
        self.reports.pause()
        found = validation.validate(
            task.learner, self.state.average, self._placed, task.pairs["transform"], task.mesh
        )
        self.reports.validated(about["step"], found)
        del found["transforms"]
        about["validation"] = {"step": about["step"], **found}
        if found["rotation_mean"] < about["best"].get("rotation_mean", np.inf):
            about["best"] = about["validation"]
        self.reports.resume()

    def _keep_best(self) -> None:
        """Writes the weights where they are the best so far and not yet in their file, after the
        checkpoint that says so."""
        if self.about["best"].get("step") != self.about["step"]:
            return
        self.reports.pause()
        self.checkpoints.wait()
        file, notes = self.workdir / identity.WEIGHTS, identity.notes(self.config, self.about)
        if devices.is_first() and not identity.holds(file, self.about["best"]):
            weights.save_params(file, self.state.average, notes)
        self.reports.resume()

    def _take_note(self) -> None:
        self.about |= {"clock": self.reports.clock.read(), "skipped": int(self.state.skipped)}


def _stop_if_diverged(in_row: int, done: int, most: int) -> None:
    if in_row > most:
        raise stopping.Diverged(
            f"by step {done}, more than train.max_skipped = {most} steps in a row had gradients "
            "that are not finite; the last checkpoint, if there is one, holds sound weights.\n"
            "Try a lower train.peak_rate or train.clip, and look for broken shapes in the data"
        )

"""The training loop: batches in, checkpoints, measurements and weights out."""

from __future__ import annotations

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.training import devices, identity, optimizers, step, stopping, validation
from cfr_jax.training.checkpoints import Checkpoints
from cfr_jax.training.config import Phase, TrainingConfig
from cfr_jax.training.learner import remaining
from cfr_jax.training.reporting.reporter import Reporter
from cfr_jax.training.sampling import Drawing, Leg, make_drawing
from cfr_jax.training.sampling.device import DeviceDrawing
from cfr_jax.training.step import TrainState
from cfr_jax.training.task import Task, fresh_params, prepare
from cfr_jax.weights.files import save_params

_TRAINED = 0.97  # share of the remaining time for steps; validations and checkpoints get the rest


def run(config: TrainingConfig, workdir: Path) -> dict[str, Any]:
    """Trains as `config` says in `workdir`; resumes from a checkpoint if there is one.

    Writes `checkpoints/`, `metrics.jsonl` (one line per measurement), and `weights.safetensors`:
    the averaged weights with the best validation so far. (If training starts from given weights,
    these are validated too.) Writes `summary.html` when it ends or is stopped. Returns the best
    validation.

    Raises ValueError if config, data or checkpoints cannot be used, OSError if files cannot be
    written, `Diverged` if gradients stay infinite or NaN or if answers to validation pairs are, and
    `Stopped` after SIGINT or SIGTERM, when everything is saved.
    """
    began = time.monotonic()
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
            if config.train.minutes and before.get("steps"):  # the first run has decided them
                task = task.planned(before["steps"])
            told += identity.go_on(before, about, task.steps, workdir)
        drawing = make_drawing(config, task.mixture, task.mesh)
        with Reporter(workdir, task, about) as reports:
            for line in told:
                reports.say(line)
            training = _Training(
                config, workdir, task, state, about, checkpoints, reports, drawing, began
            )
            training.go_to_the_end()
    return about["best"]


@dataclasses.dataclass
class _Training:
    """A run, from its start or a checkpoint to its end; `about` says where it is."""

    config: TrainingConfig
    workdir: Path
    task: Task
    state: TrainState
    about: dict[str, Any]
    checkpoints: Checkpoints
    reports: Reporter
    drawing: Drawing
    began: float
    """When the command started, by `time.monotonic`."""

    def __post_init__(self) -> None:
        self._placed = validation.place(
            self.task.pairs, self.task.mesh, self.config.train.pairs_at_once
        )

    def go_to_the_end(self) -> None:
        unplanned = self.config.train.minutes and not self.about["steps"]
        left = [phase for phase, _ in remaining(self.task.phases, self.about["step"])]
        for phase in (self.task.phases if unplanned else left)[:1]:
            self.drawing.begin(self._leg(phase), self.state)  # while the weights are validated
        if self.config.train.start_from and self.about["step"] == 0:
            self._validate()
        self._keep_best()  # a kill may have come between a checkpoint and its weights
        if unplanned:
            self._plan()
        steps = devices.replicate(np.int32(self.task.steps), self.task.mesh)
        self.state = dataclasses.replace(
            self.state, optimizer=optimizers.planned(self.state.optimizer, steps)
        )
        with stopping.stop_requests() as requests:
            for phase, ran in remaining(self.task.phases, self.about["step"]):
                self._go_through(phase, ran, requests)
        if not self.about["best"]:  # stopped before any validation, and then shortened by config
            self._validate()
            self._keep_best()
        self._take_note()

    def _go_through(self, phase: Phase, ran: int, requests: stopping.Requests) -> None:
        config, task, about = self.config, self.task, self.about
        leg = self._leg(phase)
        self.drawing.begin(leg, self.state)
        self.reports.begin(phase)
        for steps, advance in self.drawing.stretches(leg, self.state, ran, about["position"]):
            self.state, measured = advance(self.state)
            before, done = about["step"], about["step"] + steps
            about["step"] = done
            about["position"] += steps * phase.batch
            self.reports.step(done, measured, steps)
            last, asked = done == task.steps, requests.received

            def due(every: int, before: int = before, done: int = done, last: bool = last) -> bool:
                return last or before // every < done // every

            logging, validating = due(config.log_every), due(config.validate_every)
            saving = validating or due(config.checkpoint_every) or asked
            if logging:
                self.reports.measured(done, int(self.state.skipped))
            if logging or saving:
                _stop_if_diverged(int(self.state.skipped_in_row), done, config.train.max_skipped)
            if validating:
                self._validate()
            if saving:
                self._take_note()
                best, then = about["best"], None
                if validating and best["step"] == done:
                    then = functools.partial(self._write_best, best)
                self.checkpoints.save(self.state, about.copy(), best=best.get("step"), then=then)
            if asked:
                self.checkpoints.wait()
                raise stopping.Stopped(
                    f"stopped at step {done} of {task.steps}, all saved; "
                    "run the same command again to resume",
                    asked,
                )

    def _validate(self) -> None:
        task, about = self.task, self.about
        self.reports.pause()
        found = validation.validate(
            task.learner,
            self.state.average,
            self._placed,
            task.pairs["transform"],
            task.mesh,
            self.config.train.pairs_at_once,
        )
        self.reports.validated(about["step"], found)
        del found["transforms"]
        about["validation"] = {"step": about["step"], **found}
        if found["rotation_mean"] < about["best"].get("rotation_mean", np.inf):
            about["best"] = about["validation"]
        self.reports.resume()

    def _keep_best(self) -> None:
        """Writes the weights if they are the best so far and not yet in their file."""
        if self.about["best"].get("step") == self.about["step"] and devices.is_first():
            self._write_best(self.about["best"], self.state)

    def _write_best(self, best: dict[str, Any], state: TrainState) -> None:
        """Writes the weights of a state whose validation is `best`.

        During a training this runs in the background, after the checkpoint that names them best.
        """
        file = self.workdir / identity.WEIGHTS
        if not identity.holds(file, best):
            save_params(
                file,
                state.average,
                identity.notes(self.config, best),
                float16=self.config.float16,
            )

    def _plan(self) -> None:
        """Measures the speed, and plans as many steps as fit into `train.minutes`."""
        assert isinstance(self.drawing, DeviceDrawing)  # the config was checked for this
        (phase,), at_once = self.task.phases, self.config.train.steps_at_once
        speed = self.drawing.speed(self._leg(phase), self.state)
        spent = time.monotonic() - self.began
        left = 60 * self.config.train.minutes - spent
        steps = devices.agree(max(0, int(_TRAINED * left * speed)) // at_once * at_once)
        if not steps:
            raise ValueError(
                f"minutes: got {self.config.train.minutes}, wanted more: opening and compiling "
                f"took {spent:.0f} seconds, and {at_once} steps take {at_once / speed:.1f}"
            )
        self.about["steps"], self.task = steps, self.task.planned(steps)
        self.reports.plan(self.task)
        self.reports.say(
            f"{speed:.1f} steps/s, {speed * phase.batch:.0f} pairs/s: {steps} steps in the "
            f"{left:.0f} s left"
        )

    def _leg(self, phase: Phase) -> Leg:
        config, task = self.config, self.task
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
            objective=task.learner.objective,
        )
        return Leg(phase, task.samplings[task.phases.index(phase)], recipe)

    def _take_note(self) -> None:
        self.about |= {
            "clock": self.reports.clock.read(),
            "skipped": int(self.state.skipped),
            "pending": self.reports.pending(),
        }


def _stop_if_diverged(in_row: int, done: int, most: int) -> None:
    if in_row > most:
        raise stopping.Diverged(
            f"by step {done}, more than train.max_skipped = {most} steps in a row had gradients "
            "that are not finite; the last checkpoint, if there is one, holds sound weights.\n"
            "Try a lower train.peak_rate or train.clip, and look for broken shapes in the data"
        )

"""All reports of a training in one place; of several processes, only the first one reports."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cfr_jax.training.config import Phase
from cfr_jax.training.devices import is_first
from cfr_jax.training.losses import PairLoss
from cfr_jax.training.reporting.board import Board
from cfr_jax.training.reporting.log import Bar, Clock, MetricsLog, read_journal, summarize
from cfr_jax.training.reporting.pending import pack, unpack
from cfr_jax.training.reporting.summary import write_summary
from cfr_jax.training.stopping import Stopped
from cfr_jax.training.task import Task
from cfr_jax.training.validation import in_words
from cfr_jax.viewer.scene import Scene

_PICTURES = 3  # validation pairs drawn for TensorBoard


class Reporter:
    """The progress bar, the journal, TensorBoard, and the page at the end.

    Measurements stay on the device until they are written. `clock` stops between `pause` and
    `resume`.
    """

    def __init__(self, workdir: Path, task: Task, about: dict[str, Any]):
        self.clock: Clock = Clock(**about["clock"])
        self._workdir, self._task, self._about = workdir, task, about
        # what was measured and not yet written, perhaps before an interruption
        before = about["pending"]
        self._waiting = unpack(before.get("measured", ()))
        self._steps = before.get("steps", 0)
        self._written = before.get("written", self.clock.read()["seconds"])
        self._compiling = False
        self._bar = Bar(task.steps, about["step"], shown=is_first())
        self._journal = self._board = None
        if is_first():
            self._journal = MetricsLog(workdir / "metrics.jsonl", about["step"])
            self._board = Board(workdir / "tensorboard", about["step"])
            if self._board.missing:
                self._bar.say(self._board.missing)

    def __enter__(self) -> Reporter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes the bar, and writes the page unless there was an error."""
        self._bar.close()
        if self._journal is not None and self._board is not None:
            # on a full disk there may be a second error, but the first one says what to do
            with contextlib.nullcontext() if kind is None else contextlib.suppress(OSError):
                self._board.close()
            if kind is None or issubclass(kind, Stopped):
                lines = read_journal(self._journal.path)
                write_summary(self._workdir / "summary.html", lines, self._about)

    def say(self, text: str) -> None:
        """Prints a line above the bar."""
        self._bar.say(text)

    def begin(self, phase: Phase) -> None:
        """Announces a phase and counts time from here on; its first step has to compile."""
        self._bar.say(
            f"{phase.steps} steps of {phase.batch} pairs, {phase.points} points, "
            f"{phase.neighbors} neighbors: compiling, up to a minute"
        )
        self._compiling = True
        self.resume()

    def resume(self) -> None:
        """Counts time again."""
        self._bar.forget_time()
        self.clock.start()

    def pause(self) -> None:
        """Stops counting time until `resume`."""
        if self._waiting:
            jax.block_until_ready(self._waiting[-1].total)
        self.clock.stop()

    def plan(self, task: Task) -> None:
        """Sets the number of steps, if it was not known before."""
        self._task = task
        self._bar.plan(task.steps)

    def step(self, done: int, measured: PairLoss, steps: int = 1) -> None:
        """Notes some new steps, and waits for the ones before them.

        So the device always has some steps queued, but never many.
        """
        if self._waiting:
            jax.block_until_ready(self._waiting[-1].total)
        self._waiting.append(measured)
        self._steps += steps
        if self._compiling:
            self._bar.forget_time()
        self._compiling = False
        self._bar.step(done)

    def measured(self, done: int, skipped: int) -> None:
        """Writes the means since the last call."""
        used = self.clock.read()
        line = {
            "step": done,
            **summarize(self._waiting),
            # the optimizer has not counted the skipped steps
            "learning_rate": float(self._task.schedule(np.int32(max(0, done - 1 - skipped)))),
            "steps_per_second": self._steps / max(used["seconds"] - self._written, 1e-9),
            # of the whole training, including earlier runs, without validations
            "training_seconds": used["seconds"],
            "processor_seconds": used["processor_seconds"],
            "skipped": skipped,
            "time": time.time(),
        }
        if self._journal is not None and self._board is not None:
            self._journal.write(line)
            self._board.training(line, self._waiting)
        self._waiting, self._steps, self._written = [], 0, used["seconds"]
        self._bar.measured(line)

    def pending(self) -> dict[str, Any]:
        """What a checkpoint has to know, so that a run that goes on writes the same lines."""
        if not self._waiting:
            return {}
        return {
            "measured": pack(self._waiting),
            "steps": self._steps,
            "written": self._written,
        }

    def validated(self, done: int, found: dict[str, Any]) -> None:
        """Writes a validation; `found["transforms"]` (b, L, 4, 4) is for the pictures."""
        shown = {name: value for name, value in found.items() if name != "transforms"}
        if self._journal is not None and self._board is not None:
            self._journal.write({"step": done, "validation": shown})
            self._board.validation(done, shown, self._scenes(found["transforms"]))
        self._bar.say(f"step {done}: {in_words(found)}")

    def _scenes(self, transforms: np.ndarray) -> list[tuple[str, Scene]]:
        scenes = []
        for row in np.linspace(0, len(transforms) - 1, _PICTURES).astype(int).tolist():
            stations = np.concatenate([np.eye(4)[None], transforms[row]])
            labels = ["start", *(str(i) for i in range(1, len(stations)))]
            clouds = self._task.pairs["source"][row], self._task.pairs["target"][row]
            scenes.append((f"pair_{row}", Scene(*clouds, stations, labels)))
        return scenes

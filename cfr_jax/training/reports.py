"""Everything that a training reports, in one hand: only the first of several processes speaks."""

from __future__ import annotations

import time
from pathlib import Path

import jax
import numpy as np
import optax

from cfr_jax.losses import PairLoss
from cfr_jax.training.board import Board
from cfr_jax.training.devices import is_first
from cfr_jax.training.log import Bar, Clock, Journal, read_journal, summarize
from cfr_jax.training.summary import write_summary
from cfr_jax.viewer.scene import Scene

_PICTURES = 3  # validation pairs drawn for TensorBoard


class Reports:
    """Bar, journal, TensorBoard and the page at the end.

    Measurements stay on the device until they are written. `clock` stands still between `pause`
    and `resume`.
    """

    def __init__(
        self,
        workdir: Path,
        total: int,
        step: int,
        used: dict[str, float],
        schedule: optax.Schedule,
        pairs: dict,
    ):
        self.clock = Clock(**used)
        self._workdir, self._schedule, self._pairs = workdir, schedule, pairs
        self._waiting: list[PairLoss] = []
        self._written = self.clock.read()["seconds"]
        self._bar = Bar(total, step, shown=is_first())
        self._journal = self._board = None
        if is_first():
            self._journal = Journal(workdir / "metrics.jsonl", step)
            self._board = Board(workdir / "tensorboard", step)
            if self._board.missing:
                self._bar.say(self._board.missing)

    def resume(self) -> None:
        """Counts time again."""
        self.clock.start()

    def pause(self) -> None:
        """Counts no time until `resume`."""
        if self._waiting:
            jax.block_until_ready(self._waiting[-1].total)
        self.clock.stop()

    def step(self, done: int, measured: PairLoss) -> None:
        """Takes note of one step, and waits for the one before: the device has always one to do,
        and never many."""
        if self._waiting:
            jax.block_until_ready(self._waiting[-1].total)
        self._waiting.append(measured)
        self._bar.step(done)

    def measured(self, done: int, skipped: int) -> None:
        """Writes the means since the last call."""
        used, steps = self.clock.read(), len(self._waiting)
        line = {
            "step": done,
            **summarize(self._waiting),
            "learning_rate": float(self._schedule(np.int32(done - 1))),
            "steps_per_second": steps / max(used["seconds"] - self._written, 1e-9),
            # all of a training, over its restarts, without validations
            "training_seconds": used["seconds"],
            "processor_seconds": used["processor_seconds"],
            "skipped": skipped,
            "time": time.time(),
        }
        if self._journal is not None and self._board is not None:
            self._journal.write(line)
            self._board.training(line, self._waiting)
        self._waiting, self._written = [], used["seconds"]
        self._bar.measured(line)

    def validated(self, done: int, found: dict) -> None:
        """Writes a validation; `found["transforms"]` (b, L, 4, 4) is for the pictures."""
        shown = {name: value for name, value in found.items() if name != "transforms"}
        if self._journal is not None and self._board is not None:
            self._journal.write({"step": done, "validation": shown})
            self._board.validation(done, shown, self._scenes(found["transforms"]))
        self._bar.say(
            f"step {done}: validation RE {found['rotation_mean']:.2f} mean, "
            f"{found['rotation_median']:.2f} median, recall {found['recall_5deg_0.1']:.2f}"
        )

    def close(self, about: dict) -> None:
        """Ends the bar and writes the page; `about` is what the last checkpoint says."""
        self._bar.close()
        if self._journal is not None and self._board is not None:
            self._board.close()
            lines = read_journal(self._journal.path)
            write_summary(self._workdir / "summary.html", lines, about)

    def _scenes(self, transforms: np.ndarray) -> list[tuple[str, Scene]]:
        scenes = []
        for row in np.linspace(0, len(transforms) - 1, _PICTURES).astype(int).tolist():
            stations = np.concatenate([np.eye(4)[None], transforms[row]])
            if np.isfinite(stations).all():
                labels = ["start", *(str(i) for i in range(1, len(stations)))]
                clouds = self._pairs["source"][row], self._pairs["target"][row]
                scenes.append((f"pair_{row}", Scene(*clouds, stations, labels)))
        return scenes

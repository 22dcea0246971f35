"""The running reports of a training: a progress bar for people, `metrics.jsonl` for programs."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.progress import Progress
from cfr_jax.training.losses import PairLoss


class Clock:
    """Wall-clock and processor seconds of a training; it is stopped during validations.

    It starts from the seconds that earlier runs have used, so that it counts the whole training.
    Processor seconds are those of all threads of this process.
    """

    def __init__(self, seconds: float = 0.0, processor_seconds: float = 0.0):
        self._used = np.array([seconds, processor_seconds])
        self._since: np.ndarray | None = None

    def start(self) -> None:
        """Starts or resumes counting."""
        if self._since is None:
            self._since = self._now()

    def stop(self) -> None:
        """Stops counting."""
        self._used, self._since = self._total(), None

    def read(self) -> dict[str, float]:
        """Both counts."""
        seconds, processor = self._total()
        return {"seconds": float(seconds), "processor_seconds": float(processor)}

    def _total(self) -> np.ndarray:
        return self._used if self._since is None else self._used + self._now() - self._since

    @staticmethod
    def _now() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Inside this context, an OSError says what could not be written and what to do."""
    try:
        yield
    except OSError as error:
        raise OSError(
            f"{path} could not be written ({error.strerror or error}); make room, then run the "
            "same command again"
        ) from error


class MetricsLog:
    """`metrics.jsonl`: one appended object per line; a run that resumes continues the file."""

    def __init__(self, path: Path, step: int):
        self.path = path
        # what an interrupted run measured after its last checkpoint will be measured again; without
        # a checkpoint, that is everything
        lines = [line for line in read_journal(path) if step and line["step"] <= step]
        write_atomically(path, "".join(json.dumps(line) + "\n" for line in lines).encode())

    def write(self, line: dict[str, Any]) -> None:
        """Appends one line. Raises an OSError that names the file if it cannot be written."""
        with writing(self.path), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")


def read_journal(path: Path) -> list[dict[str, Any]]:
    """The lines of a `metrics.jsonl`; skips a line that a crash left unfinished."""
    lines = []
    for text in path.read_text("utf-8").splitlines() if path.exists() else ():
        try:
            lines.append(json.loads(text))
        except ValueError:
            continue
    return lines


def summarize(measured: list[PairLoss]) -> dict[str, Any]:
    """Means over the pairs of several steps; errors, alpha and beta per iteration.

    Pairs with any value that is not finite are left out; if none remain, the result is empty.
    """
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *measured)
    rows = [leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(joined)]
    sound = np.isfinite(np.concatenate(rows, axis=1)).all(axis=1)
    if not sound.any():
        return {}
    joined = jax.tree.map(lambda leaf: leaf[sound].mean(axis=0), joined)
    return {
        "loss": float(joined.total),
        "pose": float(joined.pose),
        "correspondence": float(joined.correspondence),
        "rotation_error": joined.rotation_error.tolist(),
        "translation_error": joined.translation_error.tolist(),
        "beta": joined.beta.tolist(),
        "alpha": joined.alpha.tolist(),
    }


class Bar:
    """A progress bar with loss, errors, steps per second and remaining time, on standard error."""

    def __init__(self, total: int, step: int, shown: bool):
        options = {"total": total, "initial": step, "disable": not shown, "mininterval": 5}
        self._bar = Progress(desc="training", unit=" steps", **options)

    def plan(self, total: int) -> None:
        """Sets the total number of steps."""
        self._bar.total = total
        self._bar.refresh()

    def step(self, step: int) -> None:
        """Sets the number of steps done so far."""
        self._bar.update(step - self._bar.n)

    def forget_time(self) -> None:
        """Ignores the time since the last step, which does not predict the coming steps."""
        self._bar.unpause()

    def measured(self, line: dict[str, Any]) -> None:
        """Shows the newest means, if any: rotation error in degrees, translation error in radii."""
        if "loss" not in line:
            return
        self._bar.set_postfix(
            loss=f"{line['loss']:.3f}",
            RE=f"{line['rotation_error'][-1]:.1f}",
            TE=f"{line['translation_error'][-1]:.3f}",
            refresh=False,
        )

    def say(self, text: str) -> None:
        """Prints a line above the bar."""
        if not self._bar.disable:
            self._bar.write(text)

    def close(self) -> None:
        """Closes the bar."""
        self._bar.close()

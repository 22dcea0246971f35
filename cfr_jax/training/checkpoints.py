"""Checkpoints of a training: each is complete or absent, and is verified before it is used.

    checkpoints/1500/state/...      what orbax wrote
    checkpoints/1500/about.json     config, position in the data, measurements, versions
    checkpoints/1500/manifest.json  SHA-256 of all these files

A checkpoint is written in `checkpoints/.unfinished`, with its manifest last, and then renamed. If
the process is killed at any moment, the earlier checkpoints stay as they were. A damaged checkpoint
is renamed to `1500.damaged`, and the newest sound one before it is used. (Orbax's CheckpointManager
also renames, but it writes into a checkpoint after its last callback, so no manifest could list all
files.)
"""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from cfr_jax.runtime import manifest
from cfr_jax.training.devices import agree, is_first, make_mesh
from cfr_jax.training.step import TrainState

_UNFINISHED = ".unfinished"


class SaveError(OSError):
    """A checkpoint could not be written; the message says where, why, and which one is left."""


class Checkpoints:
    """The checkpoints in a folder; leaving the context waits for the last one.

    Keeps the last `keep` checkpoints and the best one. With several processes, all of them must
    call every method, and the folder must be the same for all.
    """

    def __init__(self, folder: Path, keep: int):
        self.folder: Path = Path(folder).absolute()
        self._keep = keep
        self._writer = ocp.StandardCheckpointer()
        self._thread = ThreadPoolExecutor(1)
        self._running: Future[None] | None = None
        if is_first():
            self.folder.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(self.folder / _UNFINISHED, ignore_errors=True)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.wait()
        finally:
            # after an error the writing still finishes, but its result no longer matters
            self._thread.shutdown()
            self._writer.close()

    def steps(self) -> list[int]:
        """The steps that have a checkpoint, oldest first; the checkpoints are not verified here."""
        return sorted(int(path.name) for path in self.folder.iterdir() if path.name.isdigit())

    def save(
        self,
        state: TrainState,
        about: dict[str, Any],
        best: int | None = None,
        then: Callable[[TrainState], None] | None = None,
    ) -> None:
        """Saves in the background, after waiting for the previous save.

        `about` is any JSON value; `best` is the step of the checkpoint to keep. When the checkpoint
        is complete, the first process calls `then` with the saved state. Raises `SaveError` if a
        checkpoint, this one or the previous one, could not be written, and what the `then` of the
        previous save raised.
        """
        self.wait()
        step = int(state.step)
        beside = self.folder / _UNFINISHED / str(step)
        copy = jax.tree.map(jnp.copy, state)  # the next step donates the original
        try:
            if is_first():
                beside.mkdir(parents=True)
            self._writer.save(beside / "state", copy)
        except (OSError, ValueError) as error:
            self._fail(step, error)
        self._running = self._thread.submit(self._finish, step, beside, about, best)
        if then is not None:
            self._running = self._thread.submit(_after, self._running, then, copy)

    def wait(self) -> None:
        """Waits until the last save is complete; raises `SaveError` if it could not be written."""
        running, self._running = self._running, None
        if running is not None:
            running.result()

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]] | None:
        """The newest sound state and its `about`; None if nothing was ever saved.

        Warns about each damaged checkpoint. Raises ValueError if all are damaged (again in every
        call), and if the newest sound one does not have the structure of `like`.
        """
        step = agree(self._newest_sound() if is_first() else 0)
        if step < 0:
            return None
        folder = self.folder / str(step)
        everywhere = NamedSharding(make_mesh(), P())
        shapes = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=everywhere), like
        )
        try:
            state = self._writer.restore(folder / "state", shapes)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{folder} belongs to a different training: was the network or the optimizer "
                "changed in the config? Use another workdir, or the config in about.json there"
            ) from error
        return state, json.loads((folder / "about.json").read_text("utf-8"))

    def _newest_sound(self) -> int:
        for step in reversed(self.steps()):
            folder = self.folder / str(step)
            try:
                manifest.verify(folder)
                return step
            except manifest.Damaged as error:
                warnings.warn(f"{error}; going back to the checkpoint before it", stacklevel=4)
                aside = folder.with_name(f"{step}.damaged")
                shutil.rmtree(aside, ignore_errors=True)
                folder.rename(aside)
        damaged = list(self.folder.glob("*.damaged"))
        if damaged:
            raise ValueError(
                f"no sound checkpoint in {self.folder}: {len(damaged)} are damaged; "
                "remove the folder to start over"
            )
        return -1

    def _finish(self, step: int, beside: Path, about: dict[str, Any], best: int | None) -> None:
        try:
            self._writer.wait_until_finished()
            if not is_first():
                return
            (beside / "about.json").write_text(json.dumps(about, indent=1), "utf-8")
            manifest.write(beside)
            final = self.folder / str(step)
            shutil.rmtree(final, ignore_errors=True)
            beside.rename(final)
        except Exception as error:  # orbax passes on whatever its storage raises
            self._fail(step, error)
        steps = self.steps()
        for old in steps[: -self._keep]:
            if old != best:
                shutil.rmtree(self.folder / str(old))

    def _fail(self, step: int, error: Any) -> NoReturn:
        if is_first():
            shutil.rmtree(self.folder / _UNFINISHED, ignore_errors=True)
        left = self.steps()[-1:]
        kept = f"the last good one is at step {left[0]}" if left else "there is none before it"
        why = " ".join(str(error).split())
        raise SaveError(
            f"the checkpoint of step {step} in {self.folder} could not be written; {kept}.\n"
            f"Make room or give another --workdir, then run the same command again ({why[:300]})"
        ) from error


def _after(saved: Future[None], then: Callable[[TrainState], None], state: TrainState) -> None:
    saved.result()
    if is_first():
        then(state)

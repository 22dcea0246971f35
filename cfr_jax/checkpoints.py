"""Checkpoints of a training: written beside and renamed by orbax, the last ones kept."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import orbax.checkpoint as ocp

from cfr_jax.training import TrainState


@dataclasses.dataclass
class Checkpoints:
    """The checkpoints in a folder; leaving the context waits for the last one."""

    folder: Path
    keep: int

    def __post_init__(self):
        self._manager = ocp.CheckpointManager(
            Path(self.folder).absolute(),
            options=ocp.CheckpointManagerOptions(max_to_keep=self.keep, create=True),
        )

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_) -> None:
        self._manager.close()

    def save(self, state: TrainState, about: dict) -> None:
        """Saves a copy in the background; `about` is anything JSON holds."""
        self._manager.save(
            int(state.step),
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(state), about=ocp.args.JsonSave(about)
            ),
        )

    def restore(self, like: TrainState) -> tuple[TrainState, dict] | None:
        """The newest state and what was said about it; None if there is none yet."""
        step = self._manager.latest_step()
        if step is None:
            return None
        here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        shapes = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=here), like
        )
        restored = self._manager.restore(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardRestore(shapes), about=ocp.args.JsonRestore()
            ),
        )
        return restored["state"], restored["about"]

"""The same measurements for TensorBoard, with histograms and pictures, where it is installed."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.losses import PairLoss
from cfr_jax.viewer.picture import write_picture
from cfr_jax.viewer.scene import Scene

_SCALARS = ("loss", "pose", "correspondence", "learning_rate", "steps_per_second", "skipped")
_VALIDATIONS = ("rotation_mean", "rotation_median", "translation_mean", "recall_5deg_0.1")
MISSING = 'no TensorBoard files: pip install "cfr_jax[train]" to have them'


class Board:
    """Event files in `folder`; does nothing, and says so in `missing`, without tensorboardX."""

    def __init__(self, folder: Path, step: int):
        self.missing: str | None = None
        self._writer: Any = None
        try:
            from tensorboardX import SummaryWriter
        except ModuleNotFoundError:
            self.missing = MISSING
            return
        # what an interrupted run wrote after its last checkpoint is hidden
        self._writer = SummaryWriter(str(folder), purge_step=step + 1)

    def training(self, line: dict, measured: list[PairLoss]) -> None:
        """The line of the journal, and how alpha and beta are spread over the pairs."""
        if self._writer is None:
            return
        for name in _SCALARS:
            self._writer.add_scalar(f"training/{name}", line[name], line["step"])
        for name in ("rotation_error", "translation_error"):
            for i, value in enumerate(line[name], start=1):
                self._writer.add_scalar(f"training/{name}/{i}", value, line["step"])
        for name in ("alpha", "beta"):
            spread = np.concatenate([np.asarray(getattr(step, name)) for step in measured])
            for i, values in enumerate(spread.T, start=1):
                if np.isfinite(values).all():
                    self._writer.add_histogram(f"{name}/{i}", values, line["step"])

    def validation(self, step: int, found: dict, pictures: list[tuple[str, Scene]]) -> None:
        """Errors, and pairs as the network laid them; pictures need matplotlib, too."""
        if self._writer is None:
            return
        for name in _VALIDATIONS:
            self._writer.add_scalar(f"validation/{name}", found[name], step)
        for i, value in enumerate(found["rotation_by_iteration"], start=1):
            self._writer.add_scalar(f"validation/rotation/{i}", value, step)
        for name, scene in pictures:
            pixels = _pixels(scene)
            if pixels is not None:
                self._writer.add_image(f"validation/{name}", pixels, step, dataformats="HWC")

    def close(self) -> None:
        """Writes what is left."""
        if self._writer is not None:
            self._writer.close()


def _pixels(scene: Scene) -> np.ndarray | None:
    try:
        from matplotlib.image import imread

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pair.png"
            write_picture(path, scene)
            image = imread(path)
    except ModuleNotFoundError:
        return None
    return (image[..., :3] * 255).astype(np.uint8)

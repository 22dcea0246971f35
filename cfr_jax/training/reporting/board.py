"""The same measurements for TensorBoard, with histograms and pictures, if it is installed.

This uses the records of tensorboardX but not its usual writer. That one works in a thread: if the
disk is full, the thread dies silently and the training waits for it forever.
"""

from __future__ import annotations

import importlib.util
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.training.losses import PairLoss
from cfr_jax.training.reporting.charts import scalars
from cfr_jax.training.reporting.log import writing
from cfr_jax.viewer.picture import write_picture
from cfr_jax.viewer.scene import Scene

_BINS = 30  # of a histogram
MISSING = 'no TensorBoard files: to get them, pip install "cfr_jax[train]"'
NO_PICTURES = 'no pictures in the TensorBoard files: to get them, pip install "cfr_jax[viz]"'


class Board:
    """Event files in `folder`.

    Without tensorboardX there are none, and without matplotlib they have no pictures; `missing`
    then says so. Every method raises an OSError that names the folder if it cannot be written.
    """

    def __init__(self, folder: Path, step: int):
        self.missing: str | None = None
        self._folder = folder
        self._events: Any = None
        if importlib.util.find_spec("tensorboardX") is None:
            self.missing = MISSING
            return
        self._draws = importlib.util.find_spec("matplotlib") is not None
        if not self._draws:
            self.missing = NO_PICTURES
        from tensorboardX import summary
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._summary, self._event = summary, Event
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._events = EventsWriter(str(folder / "events"))
            # this hides what an interrupted run wrote after its last checkpoint
            self._add(step + 1, session_log=SessionLog(status=SessionLog.START))

    def training(self, line: dict[str, Any], measured: list[PairLoss]) -> None:
        """Writes a line of the journal, and the distributions of alpha and beta over the pairs."""
        if self._events is None:
            return
        step = line["step"]
        with writing(self._folder):
            self._scalars(line, step)
            for name in ("alpha", "beta"):
                spread = np.concatenate([np.asarray(getattr(each, name)) for each in measured])
                for i, values in enumerate(spread.T, start=1):
                    if np.isfinite(values).all():
                        drawn = self._summary.histogram(f"{name}/{i}", values, _BINS)
                        self._add(step, summary=drawn)
            self._events.flush()

    def validation(
        self, step: int, found: dict[str, Any], pictures: list[tuple[str, Scene]]
    ) -> None:
        """Writes the errors, and pictures of pairs as the network registered them."""
        if self._events is None:
            return
        drawn = [
            self._summary.image(f"validation/{name}", _pixels(scene), dataformats="HWC")
            for name, scene in pictures
            if self._draws
        ]
        with writing(self._folder):
            self._scalars({"validation": found}, step)
            for picture in drawn:
                self._add(step, summary=picture)
            self._events.flush()

    def close(self) -> None:
        """Closes the file."""
        if self._events is not None:
            with writing(self._folder):
                self._events.close()

    def _scalars(self, line: dict[str, Any], step: int) -> None:
        for tag, value in scalars(line).items():
            self._add(step, summary=self._summary.scalar(tag, value))

    def _add(self, step: int, **content: Any) -> None:
        self._events.write_event(self._event(step=step, wall_time=time.time(), **content))


def _pixels(scene: Scene) -> np.ndarray:
    from matplotlib.image import imread

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pair.png"
        write_picture(path, scene)
        image = imread(path)
    return (image[..., :3] * 255).astype(np.uint8)

"""The registration as a recording for the Rerun viewer, with the motion on its own timeline."""

import os

import numpy as np

from cfr_jax.geometry import motions
from cfr_jax.runtime.atomic import unfinished
from cfr_jax.viewer.camera import best_view
from cfr_jax.viewer.picture import SOURCE, TARGET
from cfr_jax.viewer.scene import Scene

PIXELS = 2.5  # diameter of a point


def write_recording(path: str | os.PathLike[str], scene: Scene) -> None:
    """Writes `scene` as an `.rrd` file for `rerun FILE`, replacing any existing file.

    Entities: `target`, `source` (a transform for each station of the timeline "station"),
    `source/points`, and the texts `result` and `station`. Rerun computes in float32, so positions
    are relative to the middle of the aligned clouds; `result` says where that is.

    Raises ModuleNotFoundError if rerun (the `rerun` extra) is missing, and OSError if `path` cannot
    be written.
    """
    try:
        import rerun as rr
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'recordings need rerun: pip install "cfr_jax[rerun]"', name="rerun"
        ) from error

    def points(positions: np.ndarray, color: np.ndarray) -> rr.Points3D:
        return rr.Points3D(
            positions.astype(np.float32),
            colors=np.rint(255 * color).astype(np.uint8),
            radii=rr.Radius.ui_points(PIXELS / 2),
        )

    center, middle = best_view(scene).center, scene.source.mean(axis=0)
    with unfinished(path) as beside:
        stream = rr.RecordingStream("cfr_jax")
        stream.save(beside)
        stream.log("result", rr.TextDocument(_text(scene, center)), static=True)
        stream.log("target", points(scene.target - center, TARGET), static=True)
        stream.log("source/points", points(scene.source - middle, SOURCE), static=True)
        for k, (label, transform) in enumerate(zip(scene.labels, scene.transforms, strict=True)):
            # position of the source's middle; the offset is subtracted in float64
            position = motions.apply(transform, middle) - center
            stream.set_time("station", sequence=k)
            stream.log("station", rr.TextDocument(label))
            stream.log("source", rr.Transform3D(mat3x3=transform[:3, :3], translation=position))
        stream.flush()
        stream.disconnect()


def _text(scene: Scene, center: np.ndarray) -> str:
    lines = [f"source: {scene.source_name}", f"target: {scene.target_name}"]
    lines += [f"{name}: {text}" for name, text in scene.facts.items()]
    lines += [f"warning: {text}" for text in scene.warnings]
    lines.append(f"positions are relative to {center.tolist()} in the target's frame")
    return "\n".join(lines).encode("utf-8", "replace").decode("utf-8")

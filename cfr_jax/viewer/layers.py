"""Many clouds in one frame as one HTML page: each on or off, each in its own color."""

from __future__ import annotations

import colorsys
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.viewer.camera import best_view
from cfr_jax.viewer.page import filled, quantized
from cfr_jax.viewer.scene import Scene

_GOLDEN = 0.618034  # of a turn of the color wheel from one layer to the next: no two are alike


@dataclass(frozen=True, eq=False)
class CloudLayer:
    """A cloud in the frame that all layers share."""

    name: str
    points: Float[np.ndarray, "n 3"]


def write_layers(
    path: str | os.PathLike[str],
    layers: Sequence[CloudLayer],
    *,
    title: str = "model",
    max_points: int = 120_000,
) -> None:
    """Writes an interactive page of all layers to `path`, replacing any existing file.

    Of more than `max_points` points, a random choice is shown, always the same one. Names are shown
    as text, never as HTML. Raises ValueError without a point to show, and OSError if `path` cannot
    be written.
    """
    layers = [layer for layer in layers if len(layer.points)]
    total = sum(len(layer.points) for layer in layers)
    if not total:
        raise ValueError("layers: got no points, wanted at least one")
    share = min(1.0, max_points / total)
    together = np.concatenate([layer.points for layer in layers])
    camera = best_view(
        Scene(source=together, target=together, transforms=[np.eye(4)] * 2, labels=["", ""])
    )
    scale = float(camera.radii[-1])
    shown = []
    for number, layer in enumerate(layers):
        count = max(1, int(share * len(layer.points)))
        rows = np.sort(np.random.default_rng(0).permutation(len(layer.points))[:count])
        center, cloud = quantized(layer.points[rows], scale)
        shown.append(
            {
                **cloud,
                "name": layer.name,
                "total": len(layer.points),
                "position": ((center - camera.center) / scale).tolist(),
                "color": color(number),
            }
        )
    view = motions.to_xyzw(camera.rotation).tolist()
    page = filled("layers.html", title, "layers", {"layers": shown, "view": view})
    write_atomically(path, page.encode())


def color(number: int) -> list[int]:
    """Red, green and blue of the layer of that number, 0 to 255."""
    hue = (0.08 + number * _GOLDEN) % 1.0
    parts = colorsys.hls_to_rgb(hue, 0.5 if number % 2 else 0.42, 0.75)
    return [round(255 * part) for part in parts]

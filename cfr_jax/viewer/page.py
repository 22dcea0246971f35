"""The registration as one HTML page that opens from a file, without a network or dependencies."""

import base64
import hashlib
import html
import json
import os
import re
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float64, Int, UInt8

from cfr_jax.geometry import motions
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.viewer.camera import Camera, best_view
from cfr_jax.viewer.scene import Scene

INT16 = 32767
UNUSED = 255  # weight byte of a point that the network did not use; used points have 0 … 254


def write_page(path: str | os.PathLike[str], scene: Scene, *, max_points: int = 20_000) -> None:
    """Writes an interactive page of `scene` to `path`, replacing any existing file.

    Clouds with more than `max_points` points are thinned at random, always in the same way, and
    points with a weight are kept first. Coordinates are rounded to 1/65534 of each cloud's extent,
    because the page shows the registration and is not meant to store the data. Text from the scene
    is only ever shown as text, never as HTML.

    Raises ValueError if `max_points` is not a positive integer, and OSError if `path` cannot be
    written.
    """
    if isinstance(max_points, bool) or not isinstance(max_points, int) or max_points < 1:
        raise ValueError(f"max_points: got {max_points!r}, wanted an integer >= 1")
    title = f"{scene.source_name} → {scene.target_name}"
    shown = _payload(scene, best_view(scene), max_points)
    write_atomically(path, filled("page.html", title, "scene", shown).encode())


def filled(name: str, title: str, place: str, shown: dict[str, Any]) -> str:
    """The page that template `name` becomes with its title, its policy, and what it shows as JSON
    in the place of that name."""
    template = resources.files("cfr_jax.viewer").joinpath(name).read_text("utf-8")
    fills = {
        "csp": _content_security_policy(template),
        "title": _text_for_html(title),
        place: _json_for_html(shown),
    }
    # In one pass, so that a name that looks like a placeholder is not replaced.
    return re.sub(rf"\{{\{{({'|'.join(fills)})\}}\}}", lambda match: fills[match[1]], template)


def _content_security_policy(template: str) -> str:
    """A policy that allows only the template's own script and style, by their hashes."""
    allowed = {
        tag: " ".join(
            f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
            for text in re.findall(rf"<{tag}>(.*?)</{tag}>", template, flags=re.DOTALL)
        )
        for tag in ("script", "style")
    }
    return (
        f"default-src 'none'; script-src {allowed['script']}; style-src {allowed['style']}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def _text_for_html(text: str) -> str:
    """Escapes to plain ASCII, because a file name may hold bytes that no encoding can write."""
    return html.escape(text).encode("ascii", "xmlcharrefreplace").decode("ascii")


def _json_for_html(value: dict[str, Any]) -> str:
    """JSON that cannot close the script element around it or open another one."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _payload(scene: Scene, camera: Camera, max_points: int) -> dict[str, Any]:
    """The data for page.html: lengths in units of `scale`, positions relative to the view's center.

    Large offsets (map coordinates) are removed here in float64, so that the page can compute in
    float32.
    """
    scale = float(camera.radii[-1])
    kept_source = _thin(len(scene.source), max_points, scene.weights)
    kept_target = _thin(len(scene.target), max_points, None)
    source_center, source = quantized(scene.source[kept_source], scale)
    target_center, target = quantized(scene.target[kept_target], scale)
    return {
        "source": {
            **source,
            "name": scene.source_name,
            "total": len(scene.source),
            "weights": None if scene.weights is None else _weights(scene.weights[kept_source]),
        },
        "target": {
            **target,
            "name": scene.target_name,
            "total": len(scene.target),
            "position": ((target_center - camera.center) / scale).tolist(),
        },
        "stations": [
            {
                "label": label,
                "matrix": transform.tolist(),
                "rotation": motions.to_xyzw(transform[:3, :3]).tolist(),
                # Position of the middle of the source. It moves evenly between two stations, no
                # matter how far the cloud is from its origin.
                "position": (
                    (motions.apply(transform, source_center) - camera.center) / scale
                ).tolist(),
                "radius": float(radius) / scale,
            }
            for label, transform, radius in zip(
                scene.labels, scene.transforms, camera.radii, strict=True
            )
        ],
        "view": motions.to_xyzw(camera.rotation).tolist(),
        "facts": list(scene.facts.items()),
        "warnings": list(scene.warnings),
    }


def _thin(
    count: int, max_points: int, weights: Float64[np.ndarray, " n"] | None
) -> Int[np.ndarray, " k"]:
    """Ascending indices of at most `max_points` points; those with a weight are chosen first."""
    if count <= max_points:
        return np.arange(count)
    order = np.random.default_rng(0).permutation(count)
    if weights is not None:
        order = order[np.argsort(np.isnan(weights[order]), kind="stable")]
    return np.sort(order[:max_points])


def quantized(
    points: Float64[np.ndarray, "n 3"], scale: float
) -> tuple[Float64[np.ndarray, " 3"], dict[str, Any]]:
    """The middle of the points, and their offsets from it as int16.

    In the caller's units, an offset is int16 · size / 32767 · scale.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    center = (low + high) / 2
    extent = float((high - low).max()) / 2
    steps = np.rint((points - center) * (INT16 / extent if extent > 0 else 0.0))
    return center, {
        "count": len(points),
        "size": extent / scale,
        "points": _base64(steps.astype("<i2")),
    }


def _weights(weights: Float64[np.ndarray, " n"]) -> str:
    levels = np.rint(np.clip(weights, 0.0, 1.0) * (UNUSED - 1))
    return _base64(np.where(np.isnan(weights), UNUSED, levels).astype(np.uint8))


def _base64(array: Int[np.ndarray, "..."] | UInt8[np.ndarray, "..."]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")

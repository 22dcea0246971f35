"""What a merge found, in its forms: text, JSON document, files of poses, layers of a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cfr_jax import __version__
from cfr_jax.multiway import pose_files
from cfr_jax.multiway.answers import Merged
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.viewer import CloudLayer

FORMAT = "cfr_jax/poses/1"


def as_layers(found: Merged) -> list[CloudLayer]:
    """The points of the largest model, one layer for each scan, under its name."""
    if not found.clouds:
        return []
    model = found.clouds[0]
    return [
        CloudLayer(found.names[scan], model.points[model.scan == scan])
        for scan in sorted(set(model.scan.tolist()))
    ]


def as_text(found: Merged) -> str:
    """The summary for people."""
    kept = [edge for edge in found.edges if edge.kept]
    lines = [
        f"registered  {len(found.edges)} pairs, of these {len(kept)} agree with the poses",
        f"placed      {len(found.placed)} of {len(found.names)} scans",
    ]
    for number, rows in found.by_component():
        reference = found.names[found.references[number]]
        size = f", {len(found.clouds[number].points):,} points" if found.clouds else ""
        name = "model" if not number else f"model {number + 1}"
        lines.append(f"{name:<11} {len(rows)} scans in the frame of {reference}{size}")
    lines += [f"left out    {each.name}: {each.reason}" for each in found.left_out]
    lines += [f"note        {note}" for note in found.notes]
    lines.append(f"time        {found.seconds['total']:.1f} s")
    return "\n".join(lines)


def as_document(found: Merged) -> dict[str, Any]:
    """Everything that is known, in the form of `poses.schema.json`."""

    def number(value: float) -> float | None:
        return value if value == value else None

    return {
        "format": FORMAT,
        "version": __version__,
        "poses": {
            found.names[index]: pose.tolist()
            for index, pose in zip(found.placed.tolist(), found.poses, strict=True)
        },
        "covariances": {
            found.names[index]: spread.tolist()
            for index, spread in zip(found.placed.tolist(), found.covariances, strict=True)
        },
        "models": [
            {
                "reference": found.names[found.references[number_]],
                "scans": [found.names[index] for index in found.placed[rows].tolist()],
            }
            for number_, rows in found.by_component()
        ],
        "left_out": {each.name: each.reason for each in found.left_out},
        "notes": list(found.notes),
        "edges": [
            {
                "source": found.names[edge.source],
                "target": found.names[edge.target],
                "transform": edge.transform.tolist(),
                "confidence": edge.confidence,
                "kept": edge.kept,
                "reason": edge.reason,
                "residual": number(edge.residual),
                "distance": number(edge.distance),
            }
            for edge in found.edges
        ],
        "seconds": found.seconds,
    }


def write_poses(path: Path, found: Merged) -> None:
    """Writes the poses in the format that the name asks for; into .json, the whole document."""
    if path.suffix.lower() == ".json":
        text = json.dumps(as_document(found), indent=1, allow_nan=False)
        write_atomically(path, (text + "\n").encode())
        return
    # such files know one frame, so they get the poses of the largest model
    poses = {
        found.names[index]: pose
        for index, pose, component in zip(
            found.placed.tolist(), found.poses, found.component.tolist(), strict=True
        )
        if component == 0
    }
    pose_files.write_poses(path, poses, found.names)

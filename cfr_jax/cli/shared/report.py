"""A registration with its inputs, and its three forms: text, JSON document, scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from cfr_jax import __version__
from cfr_jax.alignment.align import align
from cfr_jax.alignment.answers import Alignment
from cfr_jax.alignment.planning import Initial
from cfr_jax.alignment.scaling import ratios
from cfr_jax.alignment.scaling.planning import Scale
from cfr_jax.cli.shared.flags import weights_of
from cfr_jax.geometry import motions
from cfr_jax.io import PointCloud
from cfr_jax.viewer import Scene
from cfr_jax.weights.files import Weights

FORMAT = "cfr_jax/register/1"


@dataclass(frozen=True, eq=False)
class Result:
    """The inputs of a registration and its result."""

    source: PointCloud
    target: PointCloud
    initial: Float64[np.ndarray, "4 4"] | None
    seed: int
    weights: Weights
    alignment: Alignment

    def moved_source(self) -> PointCloud:
        """The whole source, scaled and moved onto the target, with all columns of its file."""
        transform, source = self.alignment.similarity, self.source

        def turned(normals: np.ndarray | None) -> np.ndarray | None:
            rigid = self.alignment.transform
            return None if normals is None else motions.rotate(rigid, normals)

        table = source.table
        if table is not None:
            with np.errstate(invalid="ignore"):  # rows without a point are infinite or NaN
                table = table.moved(
                    motions.apply(transform, table.points()), turned(table.normals())
                )
        points = motions.apply(transform, source.points)
        return PointCloud(points, turned(source.normals), source.name, table=table)


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    weights: str | None = None,
    refine: bool | str = True,
    initial: Initial = None,
    max_points: int | None = None,
    all_points: bool = True,
    second_look: bool = True,
    scale: Scale = 1.0,
    seed: int = 0,
) -> Result:
    """`align` with weights by name or path; raises ValueError like `align` and `read_weights`."""
    chosen = weights_of(weights)
    alignment = align(
        source,
        target,
        params=chosen.params,
        refine=refine,
        initial=initial,
        max_points=max_points,
        all_points=all_points,
        second_look=second_look,
        scale=scale,
        seed=seed,
    )
    return Result(source, target, alignment.initial, seed, chosen, alignment)


def as_document(result: Result, source_path: str, target_path: str) -> dict[str, Any]:
    """Everything that is known about a result, in the form of `register.schema.json`."""
    found = result.alignment
    return {
        "format": FORMAT,
        "version": __version__,
        "source": _cloud(result.source, source_path, len(found.source_rows)),
        "target": _cloud(result.target, target_path, len(found.target_rows)),
        "transform": found.transform.tolist(),
        "scale": found.scale,
        "scale_confidence": found.scale_confidence,
        "similarity": found.similarity.tolist(),
        "transforms": found.transforms.tolist(),
        "initial": None if result.initial is None else result.initial.tolist(),
        "starts": found.starts,
        "alternatives": found.alternatives.tolist(),
        "refined": found.refined,
        "converged": found.converged,
        "steps": found.steps,
        "trusted": found.trusted,
        "determined": found.determined,
        "confidence": found.confidence,
        "fitness": found.fitness,
        "inlier_rmse": found.inlier_rmse,
        "inlier_distance": found.inlier_distance,
        "overlap": found.overlap,
        "information": found.information.tolist(),
        "warnings": list(found.warnings),
        "neighbors": found.neighbors,
        "seed": result.seed,
        "weights": {"name": result.weights.name, "sha256": result.weights.sha256},
        "seconds": found.seconds,
    }


def as_text(result: Result) -> str:
    """The transform and its quality, for people."""
    found = result.alignment
    angle = motions.angle_between(found.transform, np.eye(4))
    translation = found.transform[:3, 3]
    verdict = "trusted" if found.trusted else "not trusted"
    if not found.determined:
        verdict += ", not determined"
    lines = [
        f"source      {result.source.name}: {_counts(result.source, len(found.source_rows))}",
        f"target      {result.target.name}: {_counts(result.target, len(found.target_rows))}",
        f"transform   {_scaled(found)}source onto target, T @ [x; 1]:",
        *("    " + _row(row) for row in found.transform),
        *_scale(found),
        f"motion      {angle:.3f}° about one axis, translation {np.linalg.norm(translation):.6g}",
        *(f"{name:<11} {text}" for name, text in quality(found).items()),
        f"verdict     {verdict}",
        *(f"warning     {text}" for text in found.warnings),
        "time        {run:.3f} s, and {compile:.1f} s to compile".format(**found.seconds),
    ]
    return "\n".join(lines)


def quality(found: Any) -> dict[str, str]:
    """The figures by which a reader judges a result, in words.

    `found` is an `Alignment`, or anything with the same attributes.
    """
    return {
        "confidence": "unknown" if found.confidence is None else f"{found.confidence:.2f}",
        "fitness": f"{found.fitness:.3f} of the source within {found.inlier_distance:.4g}",
        "inlier RMSE": f"{found.inlier_rmse:.4g}",
        "refined": "yes" if found.refined else "no",
    }


def as_scene(result: Result, facts: Mapping[str, str] | None = None) -> Scene:
    """The motion from the file's own pose to the answer, with `facts` shown before the quality."""
    found = result.alignment
    stations, labels = way(
        result.initial, found.transforms, found.transform if found.refined else None
    )
    weights = np.full(len(result.source), np.nan)  # NaN: a point the network did not see
    weights[found.source_rows] = found.weights
    return Scene(
        source=found.scale * result.source.points,
        target=result.target.points,
        transforms=stations,
        labels=labels,
        weights=weights,
        facts={**(facts or {}), **quality(found)},
        source_name=result.source.name,
        target_name=result.target.name,
        warnings=found.warnings,
    )


def way(
    initial: ArrayLike | None, transforms: Iterable[ArrayLike], refined: ArrayLike | None
) -> tuple[list[Any], list[str]]:
    """The stations of the motion, each (4, 4), and their labels.

    The first is where the source's file has it. The start may be far from there: a second look or a
    search may have chosen it, and then it is nearly the answer."""
    stations: list[ArrayLike] = [np.eye(4)]
    labels = ["start"]
    if initial is not None:
        stations, labels = [np.eye(4), initial], ["as given", "start"]
    for number, transform in enumerate(transforms, start=1):
        stations.append(transform)
        labels.append(f"iteration {number}")
    if refined is not None:
        stations.append(refined)
        labels.append("refined")
    return stations, labels


def _scaled(found: Alignment) -> str:
    return "" if found.scale == 1 else "scaled "


def _scale(found: Alignment) -> list[str]:
    """The line about the factor of scale, if one was asked for."""
    if found.scale == 1 and found.scale_confidence is None:
        return []
    sure = found.scale_confidence
    told = [f"{found.scale:.7g}", ratios.in_words(found.scale)]
    told.append("" if sure is None else f"estimated, confidence {sure:.2f}")
    return [f"scale       {', '.join(filter(None, told))}"]


def _cloud(cloud: PointCloud, path: str, used: int) -> dict[str, Any]:
    return {"name": cloud.name, "path": path, "points": len(cloud), "used": used}


def _counts(cloud: PointCloud, used: int) -> str:
    empty = f", {cloud.left_out:,} rows without a point left out" if cloud.left_out else ""
    return f"{len(cloud):,} points, {used:,} used{empty}"


def _row(row: Float64[np.ndarray, " 4"]) -> str:
    # Twelve digits resolve a millimeter at map coordinates, and are more than a rotation needs.
    return " ".join(f"{value:17.12g}" for value in row)

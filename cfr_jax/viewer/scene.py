"""The content of a picture of one registration: two clouds, the stations of the motion, facts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from cfr_jax.geometry import motions


@dataclass(frozen=True, eq=False, init=False)
class Scene:
    """One registration, ready to be drawn; every array is copied to read-only float64.

    `source` (n, 3) and `target` (m, 3) are in the caller's own frames and units. `transforms`
    (S, 4, 4) are the stations of the motion in order. Each maps the *original* source onto the
    target (`T @ [x; 1]`): first the start (the identity or the initial transform), then one per
    iteration, and last the answer. `labels` has the name of each station.

    `weights` (n,) is the correspondence weight of each source point, about 0 to 1. NaN marks a
    point that the network did not use; None means that no weights are known. `facts` are short
    label → text pairs, shown in their order. `warnings` are sentences.

    Raises ValueError, naming the argument, for a wrong shape, an empty cloud, a coordinate that is
    not finite, fewer than two stations, a transform that is not a rigid motion, weights that are
    negative or infinite, or facts that are not text.
    """

    source: Float64[np.ndarray, "n 3"]
    target: Float64[np.ndarray, "m 3"]
    transforms: Float64[np.ndarray, "s 4 4"]
    labels: tuple[str, ...]
    weights: Float64[np.ndarray, " n"] | None
    facts: Mapping[str, str]
    source_name: str
    target_name: str
    warnings: tuple[str, ...]

    # Written by hand because it accepts anything like an array.
    def __init__(
        self,
        source: ArrayLike,
        target: ArrayLike,
        transforms: ArrayLike,
        labels: Sequence[str],
        weights: ArrayLike | None = None,
        facts: Mapping[str, Any] = MappingProxyType({}),
        source_name: str = "source",
        target_name: str = "target",
        warnings: Sequence[str] = (),
    ) -> None:
        cloud = _cloud("source", source)
        stations = _stations(transforms)
        names = _texts("labels", labels)
        checked = {
            "source": cloud,
            "target": _cloud("target", target),
            "transforms": stations,
            "labels": names,
            "weights": None if weights is None else _weights(weights, len(cloud)),
            "facts": _facts(facts),
            "source_name": source_name,
            "target_name": target_name,
            "warnings": _texts("warnings", warnings),
        }
        if len(names) != len(stations):
            raise ValueError(
                f"labels: got {len(names)} for {len(stations)} transforms, wanted one per transform"
            )
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def moved(self, station: int) -> Float64[np.ndarray, "n 3"]:
        """The source points at one station, in the target's frame."""
        transform = self.transforms[station]
        return motions.apply(transform, self.source)


def _array(name: str, value: ArrayLike) -> Float64[np.ndarray, "..."]:
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name}: got {type(value).__name__}, wanted an array of real numbers"
        ) from error
    array.flags.writeable = False
    return array


def _cloud(name: str, value: ArrayLike) -> Float64[np.ndarray, "n 3"]:
    cloud = _array(name, value)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0:
        raise ValueError(f"{name}: got shape {cloud.shape}, wanted (n, 3) with n >= 1")
    if not np.isfinite(cloud).all():
        bad = int((~np.isfinite(cloud).all(axis=1)).sum())
        raise ValueError(f"{name}: {bad} of {len(cloud)} points are not finite")
    return cloud


def _stations(value: ArrayLike) -> Float64[np.ndarray, "s 4 4"]:
    transforms = _array("transforms", value)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or len(transforms) < 2:
        raise ValueError(f"transforms: got shape {transforms.shape}, wanted (S, 4, 4) with S >= 2")
    # interpolating between stations needs rotations
    return motions.check_rigid("transforms", transforms, several=True)


def _weights(value: ArrayLike, count: int) -> Float64[np.ndarray, " n"]:
    weights = _array("weights", value)
    if weights.shape != (count,):
        raise ValueError(
            f"weights: got shape {weights.shape}, wanted ({count},), one per source point"
        )
    if (weights < 0).any() or np.isinf(weights).any():
        raise ValueError(
            f"weights: got values from {np.nanmin(weights)} to {np.nanmax(weights)}, "
            "wanted finite weights >= 0 (NaN for a point that was not used)"
        )
    return weights


def _texts(name: str, value: Sequence[str]) -> tuple[str, ...]:
    # A single string is a sequence, too, and would silently become one text per letter.
    if isinstance(value, str):
        raise ValueError(f"{name}: got the string {value!r}, wanted a sequence of strings")
    return tuple(value)


def _facts(value: Mapping[str, Any]) -> Mapping[str, str]:
    # Only the caller knows how many digits a number deserves, so numbers are not converted here.
    for name, text in value.items():
        if not isinstance(text, str):
            raise ValueError(f"facts[{name!r}]: got {text!r}, wanted text")
    return MappingProxyType(dict(value))

"""A pair of clouds to register, and the files that hold such pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds and what is known about them; None stands for what is not.

    `transform` is the truth, and maps source onto target: `transform @ [x; 1]`. `overlap` is the
    share of the source that the target saw too. `clean_source` and `clean_target` are the whole
    shapes without noise or crop, each in the frame of its cloud. Units are the file's.
    """

    name: str
    source: Float32[np.ndarray, "n 3"]
    target: Float32[np.ndarray, "m 3"]
    source_normals: Float32[np.ndarray, "n 3"] | None = None
    target_normals: Float32[np.ndarray, "m 3"] | None = None
    transform: Float[np.ndarray, "4 4"] | None = None
    overlap: float | None = None
    clean_source: Float32[np.ndarray, "p 3"] | None = None
    clean_target: Float32[np.ndarray, "p 3"] | None = None

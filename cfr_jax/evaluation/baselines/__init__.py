"""Other methods to compare with: one file each, and the same signature for all.

    register(source: PointCloud, target: PointCloud, **options) -> (4, 4) float64

The answer maps source onto target. Lengths among the options are in the unit of the clouds, and
have no defaults: what suits a chair does not suit a street. A method that finds no motion raises
`NoMotion`. A method whose library is missing raises a `ModuleNotFoundError` that says how to
install it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np

# Functions by name; a file is imported when one of its functions is asked for.
_HOMES = {
    "identity": "identity:register",
    "icp": "icp:point_to_point",
    "icp_plane": "icp:point_to_plane",
    "gicp": "gicp:register",
    "gicp_jax": "gicp_jax:register",
    "fgr": "fgr:register",
    "fgr_icp": "fgr:then_icp",
    "ransac": "ransac:register",
    "kiss_matcher": "kiss:register",
}

NAMES = tuple(_HOMES)


class NoMotion(RuntimeError):
    """The method gives up on this pair."""


def baseline(name: str) -> Callable[..., np.ndarray]:
    """The method of that name (`NAMES` lists them); raises ValueError for an unknown name."""
    if name not in _HOMES:
        raise ValueError(f"name is {name!r}, wanted one of {', '.join(NAMES)}")
    module, function = _HOMES[name].split(":")
    return getattr(importlib.import_module(f"{__name__}.{module}"), function)

"""Formats that corpora are made of: all surfaces of the table, and those of two games.

The games' files are read for corpora alone: their parsers trust what the packages hold.
"""

from __future__ import annotations

from cfr_jax.io import formats
from cfr_jax.io.formats import Format, later

_MESHES = "cfr_jax.data.making.meshes"
_GAMES = (
    Format("PMD", (".pmd",), "surface", later(_MESHES, "parse_pmd")),
    Format("AC3D", (".ac",), "surface", later(_MESHES, "parse_ac3d")),
)


def mesh_formats() -> tuple[Format, ...]:
    """What `read_mesh` reads, in the order in which help texts list it."""
    return (*formats.of_surfaces(), *_GAMES)

"""Formats that corpora are made from: all surface formats of the table, and two formats of games,
which are read only to build corpora."""

from __future__ import annotations

from cfr_jax.io import formats
from cfr_jax.io.formats import Format, later

_HERE = "cfr_jax.data.making"
_GAMES = (
    Format("PMD", (".pmd",), "surface", later(f"{_HERE}.meshes", "parse_pmd")),
    Format("AC3D", (".ac",), "surface", later(f"{_HERE}.ac3d", "parse_ac3d")),
)


def mesh_formats() -> tuple[Format, ...]:
    """The formats that `read_mesh` reads, in the order in which help texts list them."""
    return (*formats.of_surfaces(), *_GAMES)

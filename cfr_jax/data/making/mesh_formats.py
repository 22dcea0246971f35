"""Formats that corpora are made from: all surface formats of the table, and two formats of games.

These two are read only to build corpora: their parsers refuse damaged files, but keep no budget of
memory and time, as `cfr_jax.io` does.
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
    """The formats that `read_mesh` reads, in the order in which help texts list them."""
    return (*formats.of_surfaces(), *_GAMES)

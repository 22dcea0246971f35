"""The map of the house: which room stands on which. CONTRIBUTING shows the same list."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "cfr_jax"

# From the ground up. A room imports itself and what stands before it, nothing else.
ROOMS = (
    "runtime",  # atomic files, progress, the cache of programs, optional libraries
    "io",  # point clouds from files and from other libraries' objects
    "geometry",  # rigid motions, eigenvectors, neighbors, normals, units
    "data",  # corpora, protocols, pairs
    "networks",  # one record per network, and the parts they are made of
    "weights",  # files, cards, conversion, export
    "refine",  # local refinement, one file per way
    "alignment",  # two clouds in, a motion and what it is worth out
    "viewer",  # the page, the picture, recordings
    "batch",  # many pairs
    "multiway",  # many scans of one thing: pairs chosen, poses solved, one cloud
    "evaluation",  # methods side by side; metrics, baselines
    "training",  # step, loop, checkpoints, reports
    "cli",  # one file per command
)
MOST_FILES = 15  # of a folder
MOST_LINES = 250  # of a file
FILES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def imported_rooms(text: str) -> set[str]:
    """Rooms of the package that a file imports, at its top or inside a function."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = [name.split(".") for name in names]
    return {name[1] for name in parts if name[0] == "cfr_jax" and len(name) > 1} - {"__version__"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_only_go_down(path):
    if path.parent == PACKAGE:
        return  # the face of the package, which loads on demand
    place = ROOMS.index(room_of(path))
    assert imported_rooms(path.read_text("utf-8")) <= set(ROOMS[: place + 1])


def test_the_top_level_holds_rooms_and_no_folder_is_crowded():
    top = {path.name for path in PACKAGE.iterdir()} - {"__pycache__"}
    assert top == {*ROOMS, "__init__.py", "__main__.py", "py.typed"}
    for folder in {path.parent for path in FILES}:
        files = [path for path in folder.iterdir() if path.is_file()]
        assert len(files) <= MOST_FILES, f"{folder.name} has {len(files)} files"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_file_is_too_long_to_read_at_once(path):
    assert len(path.read_text("utf-8").splitlines()) <= MOST_LINES


def test_contributing_shows_this_map():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    shown = [line.split("/")[0].strip() for line in text.splitlines() if line.startswith("  ")]
    assert [name for name in shown if name in ROOMS] == list(reversed(ROOMS))


def test_only_entry_points_touch_the_configuration_of_jax():
    touching = {
        room_of(path)
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "jax.config"
    }
    assert touching == {"cli"}


def test_the_reader_of_imports_sees_every_way_to_import():
    text = """
import cfr_jax.geometry.rigid
from cfr_jax import networks
from cfr_jax.data.corpus import Corpus
def inside():
    from cfr_jax.evaluation import metrics as t
"""
    assert imported_rooms(text) == {"geometry", "networks", "data", "evaluation"}

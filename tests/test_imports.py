"""The rooms of the package and the one direction of imports between them."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cfr_jax"

# A file knows what stands on the lines above its own, and the files of its own folder. A new file
# is put in here first.
LAYERS = (
    ("eigen", "batching", "selection"),
    ("layers",),
    ("rigid", "neighbors", "normals", "features", "sinkhorn", "extraction", "pooling"),
    ("network",),
    ("refinement", "calibration"),
    ("quality",),
    ("confidence",),
    ("prepared",),
    ("iterations",),
    ("registration",),
    ("rpmnet",),
    ("atomic",),
    ("losses", "metrics", "weights", "progress", "cards", "export", "programs"),
    ("convert",),
    ("io",),
    ("data", "viewer"),
    ("baselines",),
    ("preparation", "rotations"),
    ("training",),
    ("planning",),
    ("solving", "doubts"),
    ("search", "pyramid"),
    ("second_look", "answers"),
    ("alignment",),
    ("batch",),
    ("reproduction",),
    ("evaluation",),
    ("cli",),
    ("__main__",),
)
# Rooms that know less than their place would let them.
KNOWS_ONLY = {
    "io": set(),
    "viewer": {"io", "atomic"},
    "data": {"io", "neighbors", "atomic", "progress"},
    "metrics": set(),
}
NUMERICAL_CORE = {name for layer in LAYERS[:11] for name in layer} | {"losses"}
# Arrays in, arrays out: no files, no configuration, no host program around it.
CORE_MAY_USE = {
    "__future__", "collections", "dataclasses", "functools", "math", "typing",
    "jax", "flax", "jaxtyping", "numpy", "scipy", "cfr_jax",
}  # fmt: skip

FILES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules_in(text: str, package: tuple[str, ...]) -> set[str]:
    """Full names of all that is imported, at the top or inside a function, by a file of a
    package."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from cfr_jax import rigid` names a module in the second part
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def imported_modules(path: Path) -> set[str]:
    package = ("cfr_jax", *path.relative_to(PACKAGE).parent.parts)
    return modules_in(path.read_text("utf-8"), package)


def imported_rooms(path: Path) -> set[str]:
    ours = [name.split(".") for name in imported_modules(path) if name.startswith("cfr_jax.")]
    return {parts[1] for parts in ours} - {"__version__", room_of(path)}


def identifier(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


def test_every_file_has_a_place_in_the_layers():
    placed = {name for layer in LAYERS for name in layer}
    assert {room_of(path) for path in FILES} - {"__init__"} <= placed


@pytest.mark.parametrize("path", FILES, ids=identifier)
def test_a_file_imports_only_from_layers_above_its_own(path):
    # given
    room = room_of(path)
    height = {name: level for level, layer in enumerate(LAYERS) for name in layer}
    above = {name for name, level in height.items() if level < height.get(room, 0)}

    # when
    rooms = imported_rooms(path)

    # then
    assert rooms <= KNOWS_ONLY.get(room, above)


@pytest.mark.parametrize(
    "path", [path for path in FILES if room_of(path) in NUMERICAL_CORE], ids=identifier
)
def test_the_numerical_core_needs_nothing_but_arrays(path):
    assert {name.split(".")[0] for name in imported_modules(path)} <= CORE_MAY_USE


def test_only_entry_points_touch_the_configuration_of_jax():
    touching = {
        room_of(path)
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "jax.config"
    }
    assert touching == {"cli"}


def test_the_reader_of_imports_sees_every_way_to_import():
    # given
    text = """
import cfr_jax.rigid
from cfr_jax import network
from cfr_jax.data.corpus import Corpus
from .cloud import PointCloud
from .. import losses
def inside():
    from cfr_jax import metrics as t
"""

    # when
    modules = modules_in(text, ("cfr_jax", "io"))

    # then
    assert modules == {
        "cfr_jax.rigid",
        "cfr_jax.network",
        "cfr_jax.data.corpus.Corpus",
        "cfr_jax.io.cloud.PointCloud",
        "cfr_jax.losses",
        "cfr_jax.metrics",
    }


def test_importing_the_package_imports_neither_jax_nor_numpy():
    code = "import sys, cfr_jax; print(sorted({'jax', 'numpy', 'flax'} & set(sys.modules)))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert child.stdout.strip() == "[]", child.stderr


def test_every_public_name_of_the_package_can_be_imported():
    import cfr_jax

    for name in cfr_jax.__all__:
        assert getattr(cfr_jax, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = cfr_jax.nothing

"""The public names: what loads them, and what type checkers know of them."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import cfr_jax
import cfr_jax.io

ROOT = Path(__file__).parents[2]
LAZY = (cfr_jax, cfr_jax.io)
USE = """
import numpy as np
import cfr_jax as cfr
reveal_type(cfr.align)
reveal_type(cfr.register)
reveal_type(cfr.align("a.ply", "b.ply").transform)
reveal_type(cfr.load_params())
for outcome in cfr.align_many([("a.ply", "b.ply")]):
    reveal_type(outcome)
cfr.algin("a")
cfr.align("a.ply")
"""


def test_importing_the_package_imports_neither_jax_nor_numpy():
    code = "import sys, cfr_jax; print(sorted({'jax', 'numpy', 'flax'} & set(sys.modules)))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert child.stdout.strip() == "[]", child.stderr


@pytest.mark.parametrize("package", LAZY)
def test_every_public_name_can_be_imported(package):
    for name in package.__all__:
        assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match=f"'{package.__name__}' has no attribute 'nothing'"):
        _ = package.nothing


@pytest.mark.parametrize("package", LAZY)
def test_type_checkers_see_the_names_that_load(package):
    tree = ast.parse(Path(package.__file__).read_text("utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: node.module.removeprefix(f"{package.__name__}.")
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == package._HOMES
    assert sorted({*package.__all__} - {"__version__"}) == sorted(seen)


def test_a_type_checker_knows_the_public_functions_and_finds_mistakes(tmp_path):
    pytest.importorskip("mypy")
    (tmp_path / "use.py").write_text(USE)

    child = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file=", "--follow-imports=silent",
         "--ignore-missing-imports", "--cache-dir", str(tmp_path), str(tmp_path / "use.py")],
        capture_output=True, text=True, cwd=ROOT, timeout=600,
    )  # fmt: skip

    lines = [line.partition("use.py:")[2] for line in child.stdout.splitlines()]
    told = {int(line.split(":")[0]): line for line in lines if line}
    assert child.returncode == 1, child.stdout + child.stderr
    assert "def (source: Any, target: Any" in told[4] and "Alignment" in told[4]
    assert "Registration" in told[5]
    assert "ndarray" in told[6]
    assert "dict" in told[7]
    assert "Outcome" in told[9]
    assert 'no attribute "algin"' in told[10]
    assert 'Missing positional argument "target"' in told[11]


def test_every_public_name_has_a_type(tmp_path):
    pytest.importorskip("pyright")
    found = Path(sys.executable).parent  # pyright asks the first python there for the libraries
    env = os.environ | {"PATH": f"{found}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}

    child = subprocess.run(
        [sys.executable, "-m", "pyright", "--verifytypes", "cfr_jax", "--ignoreexternal",
         "--outputjson"],
        capture_output=True, text=True, cwd=tmp_path, env=env, timeout=600,
    )  # fmt: skip

    told = json.loads(child.stdout)["typeCompleteness"]
    assert Path(told["packageRootDirectory"]) == ROOT / "cfr_jax"
    lacking = [symbol["name"] for symbol in told["symbols"] if not symbol["isTypeKnown"]]
    assert told["exportedSymbolCounts"]["withKnownType"] > 1000 and not lacking
    assert told["completenessScore"] == 1 and child.returncode == 0

"""Mutation testing of the numerical core: do the tests notice a changed operator or number?

    pip install cosmic-ray
    python tools/mutation.py [MODULE ...] [--count 30] [--seed 0] [--only LINE ...]

Prints the mutants that survive, and the score of each module; docs/notes/mutation.md judges them.

cosmic-ray says what can be changed and how. Its own runner starts Python for each mutant, which
takes longer here than most tests. So this process imports the large libraries once, and forks for
each mutant a child that loads the changed source instead of the file and runs the tests of this
module until one fails. The files stay as they are, and what a child compiles goes with it. Of the
ways to change one place, one is drawn; then so many places of each module.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import gc
import importlib
import importlib.machinery
import os
import random
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parents[1]
# Each module with the tests that concern it, as pytest takes them.
CORE = {
    "geometry/rigid": "geometry/test_rigid.py",
    "geometry/eigen": "geometry/test_eigen.py",
    "geometry/neighbors": "geometry/test_neighbors.py",
    "geometry/selection": "geometry/test_neighbors.py",
    "geometry/closest": "geometry/test_closest.py",
    "geometry/motions": "geometry/test_motions.py geometry/test_motions_cover.py",
    "geometry/normals": "geometry/test_normals.py",
    "geometry/units": "geometry/test_units.py geometry/test_frames.py",
    "networks/sinkhorn/__init__": "networks/test_sinkhorn.py",
    "networks/sinkhorn/affinity": "networks/test_sinkhorn.py -k 'not fused'",
    "networks/sinkhorn/by_hand": "networks/test_sinkhorn.py -k 'not fused'",
    "networks/sinkhorn/dense": "networks/test_sinkhorn.py -k dense",
    "networks/sinkhorn/fused": "networks/test_sinkhorn.py -k fused",
    "networks/sinkhorn/log_space": "networks/test_sinkhorn.py -k log",
    "networks/sinkhorn/scaling": "networks/test_sinkhorn.py -k stored",
    "networks/sinkhorn/streamed": "networks/test_sinkhorn.py -k streamed",
    "networks/features": "networks/test_features.py",
    "networks/annealing": "networks/test_modules.py",
    "networks/layers": "networks/test_modules.py networks/test_pooling.py",
    "networks/probability": "networks/test_probability.py",
    "evaluation/metrics": "evaluation/test_metrics.py evaluation/test_metrics_table.py",
    "alignment/quality": "alignment/test_quality.py",
}
# Not drawn: a decorator is speed (jit) or its loss breaks the import (custom_jvp).
_LEFT_OUT = ("RemoveDecorator", "VariableInserter", "VariableReplacer", "NoOp")
_LARGE = (
    *("jax", "flax.linen", "optax", "orbax.checkpoint", "h5py", "pytest", "beartype", "jaxtyping"),
    *("scipy.spatial.transform", "scipy.linalg", "scipy.special", "jax.experimental.pallas.triton"),
)
_SLOWER = 3.0  # times the unchanged tests, and then a mutant hangs


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    line: int
    column: int
    operator: str
    occurrence: int


def mutants(source: str) -> Iterator[Mutant]:
    """All of them but those in annotations, which say nothing at run time."""
    skipped = list(_annotations(ast.parse(source)))
    nodes = list(ast_nodes(get_ast(source)))
    for name in operator_names():
        if any(part in name for part in _LEFT_OUT):
            continue
        operator = get_operator(name)()
        places = (place for node in nodes for place in operator.mutation_positions(node))
        for occurrence, (start, _) in enumerate(places):
            if not any(first <= start < last for first, last in skipped):
                yield Mutant(*start, name.rpartition("/")[2], occurrence)


def _annotations(tree: ast.AST) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    for node in ast.walk(tree):
        for field in ("annotation", "returns"):
            if (found := getattr(node, field, None)) is not None:
                last = found.end_lineno, found.end_col_offset
                yield (found.lineno, found.col_offset), last


def drawn(source: str, count: int, seed: int) -> list[Mutant]:
    """One way to change each of `count` places at most."""
    rng = random.Random(seed)
    places: dict[tuple[int, int, bool], list[Mutant]] = {}
    for mutant in mutants(source):
        # a loop's "never entered" stands where its first word does
        loop = mutant.operator.startswith("Zero")
        places.setdefault((mutant.line, mutant.column, loop), []).append(mutant)
    each = [rng.choice(ways) for _, ways in sorted(places.items())]
    kept = rng.sample(each, min(count, len(each)))
    return sorted(kept, key=lambda mutant: (mutant.line, mutant.column))


def run(path: Path, source: str, tests: list[str], limit: float) -> tuple[str, float]:
    """What became of the tests with this source: passed, failed, or too slow; and the seconds."""
    start = time.monotonic()
    child = os.fork()
    if not child:
        os.setpgid(0, 0)
        os._exit(_tests_pass(path, source, tests))
    while time.monotonic() - start < limit:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            outcome = "passed" if os.waitstatus_to_exitcode(status) == 0 else "failed"
            return outcome, time.monotonic() - start
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "too slow", time.monotonic() - start


def _tests_pass(path: Path, source: str, tests: list[str]) -> int:
    import pytest

    loader = importlib.machinery.SourceFileLoader
    usual = loader.get_code

    def get_code(self: importlib.machinery.SourceFileLoader, name: str) -> object:
        if Path(self.get_filename(name)) == path:  # past the cache of compiled modules
            return self.source_to_code(source.encode(), str(path))
        return usual(self, name)

    loader.get_code = get_code  # type: ignore[method-assign,assignment]
    if not os.environ.get("MUTATION_SHOW"):
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    try:
        return int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests]))
    except BaseException:
        return 1


def main() -> None:
    """Runs the modules that are named, or all of the core."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("modules", nargs="*", metavar="MODULE", help="such as geometry/rigid")
    parser.add_argument("--count", type=int, default=30, help="places changed in each module")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--only", type=int, nargs="+", metavar="LINE", help="of those drawn")
    given = parser.parse_args()
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for library in _LARGE:
        importlib.import_module(library)  # before any fork; nothing of it is used here
    gc.freeze()  # what is here by now need not be searched for garbage by every child
    with tempfile.TemporaryDirectory() as folder:
        # compiled modules and tests, for the children; a mutant's never lands there
        sys.dont_write_bytecode, sys.pycache_prefix = False, folder
        _measure(given)


def _measure(given: argparse.Namespace) -> None:
    os.chdir(ROOT / "tests")
    for module in given.modules or CORE:
        tests = shlex.split(CORE[module])
        path = ROOT / "cfr_jax" / f"{module}.py"
        source = path.read_text()
        outcome, needed = run(path, source, tests, limit=600)
        if outcome != "passed":
            sys.exit(f"{module}: {outcome} unchanged: {' '.join(tests)}")
        chosen = drawn(source, given.count, given.seed)
        if given.only:
            chosen = [mutant for mutant in chosen if mutant.line in given.only]
        killed = 0
        for mutant in chosen:
            operator = get_operator(f"core/{mutant.operator}")()
            changed = mutate_code(source, operator, mutant.occurrence)
            outcome, _ = run(path, changed, tests, limit=10 + _SLOWER * needed)
            killed += outcome != "passed"
            if outcome == "passed":
                _show(module, mutant, changed)
        sites = len({(mutant.line, mutant.column) for mutant in mutants(source)})
        score = 100 * killed / max(1, len(chosen))
        print(
            f"{module}: {killed} of {len(chosen)} killed ({score:.0f} %); {sites} places, "
            f"{needed:.1f} s unchanged",
            flush=True,
        )


def _show(module: str, mutant: Mutant, changed: str) -> None:
    line = changed.splitlines()[mutant.line - 1].strip()
    print(f"{module}:{mutant.line}:{mutant.column} {mutant.operator}: {line}", flush=True)


if __name__ == "__main__":
    main()

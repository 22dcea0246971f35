"""Turns the methods of a configuration into objects that another process can build and run."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.baselines import NAMES, baseline
from cfr_jax.evaluation.config import EvaluationConfig
from cfr_jax.evaluation.options import check_baseline, check_network, check_none
from cfr_jax.evaluation.solvers.solver import Answer, Solver, clouds_of
from cfr_jax.evaluation.store import code_digest
from cfr_jax.networks import table

OWN = "cfr"
TRUTH = "truth"
# Methods whose answer depends on the seed.
_DRAWING = {"fgr", "fgr_icp", "ransac"}
# Files that decide the answers of the peers, and of the methods that use our own code.
_PEERS = ("evaluation/baselines/*.py", "data/scans.py")
_OURS = (
    *_PEERS,
    "alignment/**/*.py",
    "geometry/*.py",
    "io/cloud.py",
    "networks/**/*.py",
    "refine/*.py",
    "runtime/**/*.py",
    "weights/*.py",
    "evaluation/solvers/*.py",
)


@dataclasses.dataclass(frozen=True)
class Method:
    """A row of the table."""

    name: str
    make: Callable[[], Solver]
    """Called in the method's own process, so it must be picklable."""
    about: dict[str, Any]
    """Everything that decides the answers, as JSON. Stored answers are used only if they were made
    with the same."""
    batch: int = 1
    threads: int = 0
    """How many cores its process may use; 0 for all."""
    missing: str | None = None
    """Why it cannot run at all."""
    modules: Callable[[], Callable[[Sequence[Pair]], list[dict[str, float]]]] | None = None
    """Makes a function that times the parts of the method, in seconds per pair."""


def methods_of(config: EvaluationConfig, names: Sequence[str], seed: int) -> list[Method]:
    """The methods called `names` in `config.methods`, in this order; if empty, all, sorted by name.

    A network uses the `weights` of its entry. If the entry names none, CFR uses `config.weights`
    and RPM-Net `config.rpmnet_weights`. If weights are not found, the method is left out, unless
    they are those of `config.weights`. Raises ValueError for unknown methods, for options that a
    method does not take or lacks, for a network without weights, and for damaged weights.
    """
    known = sorted(config.methods)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(
            f"methods: {', '.join(unknown)} not in the config, which has {', '.join(known)}"
        )
    return [_method(name, config, seed) for name in names or known]


def _method(name: str, config: EvaluationConfig, seed: int) -> Method:
    entry = config.methods[name]
    use, options = entry.use, dict(sorted(entry.options.items()))
    estimated, batch = entry.estimated_normals, entry.batch
    threads = config.threads if entry.threads is None else entry.threads
    about: dict[str, Any] = {
        "use": use,
        "options": dict(options),
        "estimated_normals": estimated,
        "batch": batch,
        "threads": threads,
        "code": code_digest(*(_OURS if use in (*table.names(), "gicp_jax") else _PEERS)),
    }
    make: Callable[[], Solver]
    modules = None
    where = f"methods.{name}.options"
    if use in table.names():
        check_network(where, use, options)
        from cfr_jax.weights.files import NoWeights, read_weights

        own = entry.weights or (None if use == OWN else getattr(config, f"{use}_weights", ""))
        if own == "":
            title = table.named(use).title
            raise ValueError(f"methods.{name}.weights: got none, wanted weights of {title}")
        chosen = own or config.weights
        try:
            weights = read_weights(chosen, use)
        except NoWeights as error:
            if own is None:
                raise
            return Method(name, _make_truth, about, missing=str(error))
        about |= {"weights": weights.name, "sha256": weights.sha256, "seed": seed}
        make = functools.partial(
            _make_own,
            network=table.named(use),
            weights=chosen,
            estimated=estimated,
            batch=batch,
            seed=seed,
            **options,
        )
        if entry.modules:
            modules = functools.partial(
                _make_modules, table.named(use), chosen, options.get("settings"), estimated
            )
    elif use == TRUTH:
        check_none(where, use, options)
        make = _make_truth
    elif use in NAMES:
        check_baseline(where, use, options)
        if use in _DRAWING:
            options["seed"] = about["seed"] = seed
        make = functools.partial(make_baseline, use, options, estimated)
    else:
        known = ", ".join((*table.names(), TRUTH))
        raise ValueError(f"methods.{name}.use is {use!r}, wanted {known}, or one of {NAMES}")
    return Method(name, make, about, batch, threads, modules=modules)


def make_baseline(use: str, options: dict[str, Any], estimated: bool) -> Solver:
    """A baseline as a solver; it runs pair by pair."""
    register = baseline(use)

    def solve(pairs: Sequence[Pair]) -> list[Answer]:
        answers = []
        for pair in pairs:
            source, target = clouds_of(pair, estimated)
            began = time.perf_counter()
            transform = register(source, target, **options)
            answers.append(Answer(transform[None], time.perf_counter() - began))
        return answers

    return solve


def _make_truth() -> Solver:
    """Answers with the truth: what the table must show for a perfect method."""
    return lambda pairs: [Answer(np.array(pair.transform)[None], 0.0) for pair in pairs]


def _make_own(**options: Any) -> Solver:
    from cfr_jax.evaluation.solvers.network_solver import make_network

    return make_network(**options)


def _make_modules(*arguments: Any) -> Callable[[Sequence[Pair]], list[dict[str, float]]]:
    from cfr_jax.evaluation.solvers.module_times import make_modules

    return make_modules(*arguments)

"""Checks the options of a method against what it takes, before anything runs."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Collection, Mapping
from inspect import Parameter
from typing import Any

from cfr_jax.evaluation.baselines import baseline
from cfr_jax.networks import table

# What `methods` passes itself, from other fields of the config.
_OF_BASELINES = {"source", "target", "seed"}
_OF_NETWORKS = {"network", "weights", "estimated", "batch", "seed"}


def check_baseline(where: str, use: str, options: Mapping[str, Any]) -> None:
    """Raises ValueError, naming the field `where`, if a baseline does not take these options."""
    from cfr_jax.evaluation.baselines.open3d_clouds import FeatureOptions

    taken = _parameters(baseline(use))
    if any(each.kind is Parameter.VAR_KEYWORD for each in taken.values()):
        taken |= _parameters(FeatureOptions)  # those that it passes on
    _check(where, use, options, taken, _OF_BASELINES)


def check_network(where: str, use: str, options: Mapping[str, Any]) -> None:
    """The same for a network; `settings` among its options are checked against its own."""
    from cfr_jax.evaluation.solvers.network_solver import make_network

    _check(where, use, options, _parameters(make_network), _OF_NETWORKS)
    settings = options.get("settings") or {}
    known = [field.name for field in dataclasses.fields(table.named(use).settings)]
    if unknown := sorted(set(settings) - set(known)):
        raise ValueError(
            f"{where}.settings: got {', '.join(unknown)}, wanted some of {', '.join(known)}"
        )


def check_none(where: str, use: str, options: Mapping[str, Any]) -> None:
    """The same for what takes no options."""
    _check(where, use, options, {}, ())


def _parameters(function: Callable[..., Any]) -> dict[str, Parameter]:
    return dict(inspect.signature(function).parameters)


def _check(
    where: str,
    use: str,
    options: Mapping[str, Any],
    parameters: Mapping[str, Parameter],
    apart: Collection[str],
) -> None:
    taken = {
        name: each
        for name, each in parameters.items()
        if name not in apart and each.kind is not Parameter.VAR_KEYWORD
    }
    if unknown := sorted(set(options) - set(taken)):
        wanted = f"some of {', '.join(taken)}" if taken else "none"
        raise ValueError(f"{where}: {use} got {', '.join(unknown)}, wanted {wanted}")
    needed = {name for name, each in taken.items() if each.default is Parameter.empty}
    if missing := sorted(needed - set(options)):
        raise ValueError(f"{where}: {use} got no {', '.join(missing)}, which it needs")

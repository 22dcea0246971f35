"""What a checkpoint says about its training, and whether a command may resume it."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cfr_jax import __version__
from cfr_jax.training.config import TrainingConfig
from cfr_jax.weights.files import read_weights

_NAMED = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")
WEIGHTS = "weights.safetensors"  # the best so far
_KEPT = ("step", "steps", "best", "validation", "position", "clock", "skipped", "pending")


def begin(config: TrainingConfig, stamps: dict[str, str]) -> dict[str, Any]:
    """The `about` of a checkpoint, before the first step."""
    versions = {name: importlib.metadata.version(name) for name in _NAMED}
    versions |= {"cfr_jax": __version__, "python": platform.python_version()}
    return {
        "step": 0,
        "steps": None,  # of the whole training, if train.minutes decided them
        "best": {},
        "validation": {},  # the last one
        "position": 0,  # pairs of the stream used so far; with the seed, it decides all later ones
        # for the initial weights; steps draw no random numbers
        "random_key": np.asarray(jax.random.key_data(jax.random.key(config.seed))).tolist(),
        "skipped": 0,
        "clock": {"seconds": 0.0, "processor_seconds": 0.0},
        "pending": {},  # measurements of the last steps that no line tells of yet
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "data": stamps,
        "versions": versions,
        "started": time.strftime("%Y-%m-%d %H:%M:%S %z"),
    }


def go_on(before: dict[str, Any], now: dict[str, Any], total: int, workdir: Path) -> list[str]:
    """Copies the state of a checkpoint into `now`; returns messages about what resumes and changed.

    If the validation pairs have changed, the best validation so far is forgotten, because results
    on different pairs do not compare. Raises ValueError if the checkpoint was trained on other
    data, because its position in the stream of pairs means nothing here.
    """
    if before["data"]["data.train"] != now["data"]["data.train"]:
        raise ValueError(
            f"{workdir} holds a training on other data.train (then {before['data']['data.train']}, "
            f"now {now['data']['data.train']}); wanted another --workdir. To start there from the "
            f"weights of this one: --config.train.start_from={workdir / WEIGHTS}"
        )
    now |= {key: before[key] for key in _KEPT if key in before}
    done = now["step"]
    changed = list(_changes(before["config"], now["config"]))
    told = [f"resuming at step {done}"] if done < total else []
    if changed:
        told.append(f"the config differs from the checkpoint's: {'; '.join(changed)}")
    if done < total and before["data"]["data.validation"] != now["data"]["data.validation"]:
        now["best"] = {}
        told.append("data.validation holds other pairs than before: the best so far is forgotten")
    if done >= total:
        told.append(
            f"{workdir} has finished its {done} steps; for more, raise the steps of a phase"
        )
    return told


def notes(config: TrainingConfig, best: dict[str, Any]) -> dict[str, str]:
    """The notes in a weights file that say how it was made."""
    return {
        "config": json.dumps(dataclasses.asdict(config), sort_keys=True),
        "validation": json.dumps(best),
        "made_by": f"cfr_jax {__version__} train.py",
    }


def holds(file: Path, best: dict[str, Any]) -> bool:
    """Whether this weights file exists, is sound, and belongs to the validation `best`."""
    try:
        return read_weights(file).notes.get("validation") == json.dumps(best)
    except ValueError:
        return False


def _changes(before: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    then, here = dict(_flat(before)), dict(_flat(now))
    for name in sorted(then.keys() | here.keys()):
        if then.get(name) != here.get(name):
            yield f"{name} {then.get(name)} → {here.get(name)}"


def _flat(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(tree, dict):  # an empty dict yields nothing
        for key, value in tree.items():
            yield from _flat(value, f"{name}.{key}" if name else key)
    elif isinstance(tree, list) and any(isinstance(value, dict) for value in tree):
        for place, value in enumerate(tree):
            yield from _flat(value, f"{name}[{place}]")
    else:
        yield name, tree

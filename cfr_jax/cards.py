"""Cards of the weights that ship: where they come from, and how well they were measured.

A card is `models/NAME.json` beside `models/NAME.safetensors`; `cli/models.schema.json` describes
it. Reading one needs no JAX.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "models"
FORMAT = "cfr_jax/model/1"


def names() -> tuple[str, ...]:
    """Weights that have a card."""
    weights = sorted(FOLDER.glob("*.safetensors"))
    return tuple(path.stem for path in weights if path.with_suffix(".json").exists())


def read_card(name: str) -> dict[str, Any]:
    """The card of shipped weights, with the digest, size and count of numbers of their file.

    Raises ValueError where there are no such weights, and where the card was written for others.
    """
    if name not in names():
        raise ValueError(f"no weights called {name!r}; shipped are {', '.join(names())}")
    card = json.loads((FOLDER / f"{name}.json").read_text("utf-8"))
    file = file_facts(FOLDER / f"{name}.safetensors")
    if card["sha256"] != file["sha256"]:
        raise ValueError(
            f"the card of {name!r} is of other weights ({card['sha256'][:12]}) than those that "
            f"are there ({file['sha256'][:12]})\n"
            f"`python benchmarks/model_card.py {name}` measures and writes it anew"
        )
    return {**card, **file}


def file_facts(path: Path) -> dict[str, Any]:
    """Digest, parameters and bytes of a safetensors file, from its header alone."""
    with open(path, "rb") as stream:
        header = json.loads(stream.read(int.from_bytes(stream.read(8), "little")))
    told = header.pop("__metadata__", {})
    return {
        "sha256": told.get("sha256", ""),
        "parameters": sum(math.prod(tensor["shape"]) for tensor in header.values()),
        "bytes": path.stat().st_size,
    }

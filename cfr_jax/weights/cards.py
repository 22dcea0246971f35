"""Cards of the weights that ship: where they come from, and how well they were measured.

A card is `shipped/NAME.json` beside `shipped/NAME.safetensors`; `models.schema.json` describes it.
Reading one needs no JAX.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "shipped"
FORMAT = "cfr_jax/model/1"


def names() -> tuple[str, ...]:
    """Weights that have a card."""
    weights = sorted(FOLDER.glob("*.safetensors"))
    return tuple(path.stem for path in weights if path.with_suffix(".json").exists())


def read_card(name: str) -> dict[str, Any]:
    """The card of shipped weights, with the digest, size and count of numbers of their file.

    Raises ValueError where there are no such weights, where one of the two files is damaged, and
    where the card was written for others.
    """
    if name not in names():
        raise ValueError(f"no weights called {name!r}; shipped are {', '.join(names())}")
    path = FOLDER / f"{name}.json"
    try:
        card = json.loads(path.read_text("utf-8"))
        sha256 = card["sha256"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: no card of weights ({error!r})") from error
    file = file_facts(FOLDER / f"{name}.safetensors")
    if sha256 != file["sha256"]:
        raise ValueError(
            f"the card of {name!r} is of other weights ({sha256[:12]}) than those that "
            f"are there ({file['sha256'][:12]})\n"
            f"`python tools/model_card.py {name}` measures and writes it anew"
        )
    return {**card, **file}


def file_facts(path: Path) -> dict[str, Any]:
    """Digest, parameters and bytes of a safetensors file, from its header alone.

    Raises ValueError, naming the file, where that cannot be read; what it says is not checked.
    """
    size = path.stat().st_size
    try:
        with open(path, "rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            header = json.loads(stream.read(min(length, size)))
        told = header.pop("__metadata__", {})
        return {
            "sha256": str(told.get("sha256", "")),
            "parameters": sum(math.prod(tensor["shape"]) for tensor in header.values()),
            "bytes": size,
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged: no header of safetensors ({error!r})") from error

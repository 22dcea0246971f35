"""Cards of the shipped weights: where they come from, and how well they do.

A card is `shipped/NAME.json`, next to `shipped/NAME.safetensors`. `models.schema.json` describes
its format. Reading a card does not need JAX.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "shipped"
FORMAT = "cfr_jax/model/1"


def names() -> tuple[str, ...]:
    """Names of the weights that have a card."""
    weights = sorted(FOLDER.glob("*.safetensors"))
    return tuple(path.stem for path in weights if path.with_suffix(".json").exists())


def read_card(name: str) -> dict[str, Any]:
    """The card of shipped weights, with the digest, size and number of parameters of their file.

    Raises ValueError if there are no such weights, if the card or the weights file is damaged, or
    if the card belongs to other weights.
    """
    if name not in names():
        raise ValueError(
            f"there are no shipped weights called {name!r}; shipped are {', '.join(names())}"
        )
    path = FOLDER / f"{name}.json"
    try:
        card = json.loads(path.read_text("utf-8"))
        sha256 = card["sha256"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: it is not a card of weights ({error!r})") from error
    file = file_facts(FOLDER / f"{name}.safetensors")
    if sha256 != file["sha256"]:
        raise ValueError(
            f"the card of {name!r} belongs to other weights ({sha256[:12]}) than the file that "
            f"is there ({file['sha256'][:12]})\n"
            f"`python tools/model_card.py {name}` measures these and updates the card"
        )
    return {**card, **file}


def file_facts(path: Path) -> dict[str, Any]:
    """Digest, number of parameters and bytes of a safetensors file, from its header alone.

    The header's content is not checked. Raises ValueError, naming the file, if the header cannot be
    read.
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
        raise ValueError(f"{path} is damaged: it has no safetensors header ({error!r})") from error

"""Measures shipped weights on the shipped shapes, and writes the results into their card.

    python tools/model_card.py object

`cfr reproduce` compares later measurements with them. The other parts of the card (what the weights
are, their data, the scores of `evaluate.py`) are written by hand and kept. For new weights, check
them.
"""

from __future__ import annotations

import argparse
import datetime
import json

from cfr_jax import __version__
from cfr_jax.evaluation import machine, reproduction
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.progress import Progress
from cfr_jax.weights import cards
from cfr_jax.weights.files import load_params


def main() -> None:
    """Updates `cfr_jax/weights/shipped/NAME.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="name of the weights and their card")
    path = cards.FOLDER / f"{parser.parse_args().name}.json"
    card = json.loads(path.read_text("utf-8"))
    sha256 = cards.file_facts(path.with_suffix(".safetensors"))["sha256"]
    if card["sha256"] != sha256:
        print(f"the weights have changed: check `about`, `data` and `measured` in {path}")
    with Progress(total=reproduction.PAIRS, desc="registering", unit=" pairs") as bar:
        scores = reproduction.measure(load_params(card["name"]), bar.update)
    card["sha256"] = sha256
    card["reproduce"] = {
        "on": reproduction.WHAT,
        "expected": {
            stage: {name: round(value, 4) for name, value in measured.items()}
            for stage, measured in scores.items()
        },
        "tolerance": reproduction.TOLERANCE,
        "measured_with": f"cfr_jax {__version__} ({machine.commit()}), "
        f"{datetime.date.today()}, {machine.describe()}",
    }
    write_atomically(path, (json.dumps(card, indent=1, ensure_ascii=False) + "\n").encode())
    print(json.dumps(card["reproduce"], indent=1))


if __name__ == "__main__":
    main()

"""Fits the confidence of shipped weights in place, and updates the digest on their card.

    python -m tools.fit_confidence object --data ../shared/data/open_cad/val.h5 --pairs 500
    python -m tools.fit_confidence scan --data scan_val.h5 --pairs 200   # tools/make_scan_pairs.py

This is `cfr calibrate` for the files in cfr_jax/weights/shipped. It has the same options, except
--out. `cfr calibrate NAME --data DATA --check` measures how well the result holds on other data.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from cfr_jax.cli import main as cfr
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.weights import cards
from cfr_jax.weights.files import SHIPPED, read_weights


def main() -> int:
    """Rewrites `NAME.safetensors`, and the digest in its card and its description."""
    name, *options = sys.argv[1:]
    before = read_weights(name).sha256
    with tempfile.TemporaryDirectory(dir=SHIPPED) as folder:
        made = Path(folder) / f"{name}.safetensors"
        if code := cfr(["calibrate", name, "--out", str(made), *options]):
            return code
        after = read_weights(made).sha256
        shutil.move(made, SHIPPED / f"{name}.safetensors")
    for path in (cards.FOLDER / f"{name}.json", cards.FOLDER / f"{name}.md"):
        if path.exists():
            text = path.read_text("utf-8").replace(before, after).replace(before[:12], after[:12])
            write_atomically(path, text.encode())
            print(f"wrote       {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

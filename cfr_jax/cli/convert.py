"""`cfr convert`: converts the authors' PyTorch weights of a known network into ours."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cfr_jax.cli.shared import outputs
from cfr_jax.cli.shared.commands import Commands

if TYPE_CHECKING:
    from cfr_jax.networks.record import Params

_DESCRIPTION = """\
Converts a checkpoint of the CFR authors' PyTorch program into weights for this one:

  cfr convert authors.pth --out weights.safetensors
  cfr register a.ply b.ply --weights weights.safetensors

Checkpoints of the programs of RPM-Net, DCP (v1 and v2), FMR and RGM are recognized by the names
of their tensors, and converted for evaluate.py, which compares these networks.

A .pth, .pt or .t7 file is read by PyTorch (pip install "cfr_jax[torch]"), tensors only: no code in
it is run. A .safetensors or .npz file of the same tensors under the same names needs no PyTorch.

--float16 halves the file: large tensors are rounded to float16, and read back as float32. It also
takes weights of this program:

  cfr convert runs/dcp/weights.safetensors --out dcp.safetensors --float16
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr convert`."""
    parser = commands.add_parser(
        "convert",
        help="convert the authors' PyTorch weights into ours",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("checkpoint", metavar="CHECKPOINT", type=Path, help="what to convert")
    parser.add_argument(
        "--out",
        metavar="FILE.safetensors",
        type=Path,
        required=True,
        help="where to write the weights (required)",
    )
    parser.add_argument(
        "--float16", action="store_true", help="store large tensors in float16: half the size"
    )


def run(args: argparse.Namespace) -> int:
    """Converts a checkpoint; notes in the new file say what it was made from."""
    outputs.check_output("--out", args.out, (".safetensors",))
    outputs.check_apart([args.checkpoint], [args.out])

    from cfr_jax.networks import table
    from cfr_jax.weights.files import network_of, read_weights, save_params

    params, notes = _weights(args.checkpoint)
    save_params(args.out, params, notes, float16=args.float16)
    record = table.named(network_of(params))
    trained = f", {record.iterations(params)} iterations" if record.iterations else ""
    print(f"wrote       {args.out}: {record.title}{trained}")
    print(f"sha256      {read_weights(args.out).sha256}")
    return 0


def _weights(checkpoint: Path) -> tuple[Params, dict[str, str]]:
    """Parameters, and notes that say what they were made from; our own weights keep their notes."""
    from hashlib import sha256

    from cfr_jax import __version__
    from cfr_jax.runtime.reading import contents
    from cfr_jax.weights.conversion import convert
    from cfr_jax.weights.files import is_ours, read_weights

    if is_ours(checkpoint):
        weights = read_weights(checkpoint)
        return weights.params, {**weights.notes, "stored_again_from_sha256": weights.sha256}
    return convert(checkpoint), {
        "converted_from": checkpoint.name,
        "converted_from_sha256": sha256(contents(checkpoint)).hexdigest(),
        "converted_by": f"cfr_jax {__version__}",
    }

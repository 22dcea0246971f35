"""`cfr export`: writes the network as one StableHLO program, for hosts without this package."""

from __future__ import annotations

import argparse
from pathlib import Path

from cfr_jax.cli.shared import flags, outputs
from cfr_jax.cli.shared.commands import Commands

_DESCRIPTION = """\
Writes the network, with its weights inside, as one program that runs wherever JAX runs:

  cfr export --points 1024 --platforms cpu,cuda,tpu --out model.stablehlo
  python examples/run_exported.py model.stablehlo source.npy target.npy

The host needs jax and flatbuffers, but not this package. The program is `register`: the
network alone, without refinement and confidence. Its arguments are source, source_count, target,
target_count: float32 clouds of exactly --points rows, padded, of unit size, and how many of the
rows count. It returns transform (source onto target), transforms, weights and covered.

The file is 32 bytes, the SHA-256 of the rest, and then the program: jax.export.deserialize reads
it from byte 32 on. The example checks the digest first, since JAX does not notice a flipped bit.
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr export`."""
    parser = commands.add_parser(
        "export",
        help="write the network as one program, for hosts without this package",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--out",
        metavar="FILE.stablehlo",
        type=Path,
        required=True,
        help="the program (required)",
    )
    parser.add_argument(
        "--points",
        metavar="N",
        type=int,
        default=1024,
        help="most points of a cloud, at least 65; smaller clouds are padded (default: 1024)",
    )
    parser.add_argument(
        "--platforms",
        metavar="P,…",
        default="cpu",
        help="where it will run: some of cpu, cuda, rocm, tpu (default: cpu)",
    )
    parser.add_argument(
        "--normals",
        action="store_true",
        help="clouds come with unit normals, (N, 6); without it, the program estimates them",
    )
    parser.add_argument(
        "--batch",
        action="store_true",
        help="many pairs per call: adds a leading axis of any length",
    )
    flags.add(parser, "--weights")


def run(args: argparse.Namespace) -> int:
    """Traces the program for each platform, and writes it."""
    outputs.check_output("--out", args.out, (".stablehlo",))
    from cfr_jax.weights.stablehlo import export_register, save_exported

    weights = flags.weights_of(args.weights)
    platforms = [name.strip() for name in args.platforms.split(",")]
    exported = export_register(
        weights.params,
        points=args.points,
        platforms=platforms,
        normals=args.normals,
        batch=args.batch,
    )
    save_exported(args.out, exported)
    print(f"wrote       {args.out}: {args.out.stat().st_size / 1e6:.1f} MB")
    print(f"platforms   {', '.join(exported.platforms)}")
    print(f"weights     {weights.name}, sha256 {weights.sha256}")
    for name, aval in zip(
        ("source", "source_count", "target", "target_count"), exported.in_avals, strict=True
    ):
        print(f"{name:<15} {aval.str_short()}")
    return 0

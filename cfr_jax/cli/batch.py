"""`cfr batch PAIRS --out results.csv`: registers many pairs, and loses no answer on the way."""

from __future__ import annotations

import argparse
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfr_jax.cli.shared import clouds, flags, numbers, outputs, resuming
from cfr_jax.cli.shared.commands import Commands
from cfr_jax.data import kinds

if TYPE_CHECKING:
    from cfr_jax.batch.jobs import Jobs
    from cfr_jax.batch.journal import Journal
    from cfr_jax.networks.record import Params

_DESCRIPTION = """\
Registers many pairs. PAIRS is recognized by its layout, which is printed first:

{kinds}

Paths in a list are relative to its folder; a line may also hold 16 numbers, the known truth,
which is not used here. A pair in HDF5 is a group with source (N, 3) and target (M, 3). The files of
a folder are registered onto --target, or a_source.ply onto a_target.ply, or each file onto the
one before it.

This writes two files. results.jsonl holds the full report, one line per pair, written as soon as
the pair is done. results.csv is a table in the order of the pairs, written when all are done. After
a crash, a kill or Ctrl-C, run the same command again, and it continues where it stopped. A pair
that cannot be read becomes a row with the reason, and does not stop the others. Each line has a
checksum: a changed one is refused. In the table, names that a spreadsheet would run as a formula
get an apostrophe in front.
"""

_EPILOG = """\
examples:
  cfr batch pairs.csv --out results.csv
  cfr batch scans/ --target model.ply --out results.csv   the target is encoded once
  cfr batch pairs.csv --out results.csv --retry-failed    after fixing the bad files
  cfr batch pairs.csv --out results.csv --shard 2/4       on the second of four machines; without
                                                          --shard, the table of all of them
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr batch`."""
    parser = commands.add_parser(
        "batch",
        help="register many pairs of a list or a folder into one table",
        description=_DESCRIPTION.format(kinds=_kinds()),
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("pairs", metavar="PAIRS", type=Path, help="a list, a file or a folder")
    parser.add_argument(
        "--out",
        metavar="FILE.csv",
        type=Path,
        required=True,
        help="the table (required)",
    )
    parser.add_argument(
        "--layout",
        metavar="KIND",
        help="which of these PAIRS is (default: recognized)",
    )
    parser.add_argument(
        "--target", metavar="FILE", type=Path, help="the target of every cloud in a folder"
    )
    flags.add(parser, "--retry-failed", "--shard")
    flags.add_strict(parser, "a pair failed or is not to be trusted")
    how = parser.add_argument_group("how to register")
    clouds.add_columns(how)
    flags.add(how, "--no-refine", "--no-second-look", "--weights", "--max-points", "--thinned")
    flags.add(how, "--scale", "--seed")
    how.add_argument(
        "--batch-size",
        metavar="N",
        type=numbers.positive,
        help="pairs solved at once (default: 1 on a CPU, 16 on an accelerator)",
    )
    flags.add(how, "--workers")


def _kinds() -> str:
    """The kinds of data that have pairs, or clouds to pair, one line each."""
    return "\n".join(
        f"  {kind.name:11s} {kind.words}"
        for kind in kinds.entries()
        if kind.list_pairs is not None or kind.list_scans is not None
    )


@clouds.telling("cfr batch")
def run(args: argparse.Namespace) -> int:
    """Checks the arguments, registers the pairs that are not done yet, and writes the table."""
    outputs.check_output("--out", args.out, (".csv",))
    outputs.check_apart([args.pairs, *filter(None, [args.target])], [args.out])
    clouds.columns_of(args)

    from cfr_jax.batch.jobs import jobs_of
    from cfr_jax.data.layout import recognize

    layout = recognize(args.pairs, args.layout)
    jobs, how = jobs_of(layout, args.target)
    shard = resuming.asked_share(args.shard)
    print(f"recognized  {layout}")
    print(f"pairs       {len(jobs)}: {how}")
    out, rows = args.out, range(len(jobs))
    if shard is not None:
        rows, out = rows[shard.rows()], shard.beside(args.out)
        print(f"shard       {shard.number} of {shard.count}: {len(rows)} pairs")

    from cfr_jax.cli.shared.cache import keep_compiled_programs

    keep_compiled_programs()
    weights = flags.weights_of(args.weights)
    made_with = {"weights": weights.sha256, **flags.solving(args), "columns": args.columns}
    kept = out.with_suffix(".jsonl")
    outputs.check_output("--out", kept)
    with resuming.journal(kept, made_with, shard, args) as journal:
        left = array("Q", (row for row in rows if jobs.key(row) not in journal))
        if len(left) < len(rows):
            print(f"done before {len(rows) - len(left)}")
        _register(jobs, left, journal, weights.params, args)
        return _tell((journal[jobs.key(row)] for row in rows), out, kept, args.strict)


def _register(
    jobs: Jobs, left: Sequence[int], journal: Journal, params: Params, args: argparse.Namespace
) -> None:
    from cfr_jax.batch.records import as_record
    from cfr_jax.batch.stream import align_many
    from cfr_jax.runtime.progress import Progress

    if not left:
        return
    outcomes = align_many(
        clouds.with_columns((jobs[row].pair for row in left), args),
        params=params,
        **flags.solving(args),
        batch=args.batch_size,
        workers=args.workers,
        ordered=False,
    )
    failed = 0
    with Progress(total=len(left), desc="registering", unit=" pairs") as bar:
        for outcome in outcomes:
            journal.write(as_record(jobs[left[outcome.index]], outcome))
            failed += outcome.error is not None
            if failed:
                bar.set_postfix_str(f"{failed} failed", refresh=False)
            bar.update()


def _tell(records: Iterable[dict[str, Any]], out: Path, kept: Path, strict: bool) -> int:
    """Writes the table, and says what became of the pairs; each record is in memory by itself."""
    from cfr_jax.batch.records import write_table
    from cfr_jax.runtime.atomic import unfinished
    from cfr_jax.runtime.messages import shown

    count = failed = trusted = 0
    reasons: list[tuple[str, str]] = []

    def counted() -> Iterator[dict[str, Any]]:
        nonlocal count, failed, trusted
        for record in records:
            count += 1
            trusted += bool(record["trusted"])
            if record["error"] is not None:
                failed += 1
                if len(reasons) < 3:
                    pair = f"{shown(record['source'])} -> {shown(record['target'])}"
                    reasons.append((pair, shown(record["error"], 600)))
            yield record

    with unfinished(out) as beside, open(beside, "w", encoding="utf-8", newline="") as stream:
        write_table(stream, counted())
    print(f"registered  {count - failed}, of these {trusted} trusted")
    for pair, reason in reasons:
        print(f"failed      {pair}: {reason}")
    if failed > len(reasons):
        print(f"failed      {failed - len(reasons)} more, see {out}")
    print(f"wrote       {out}")
    print(f"wrote       {kept}")
    if count and failed == count:
        raise ValueError(
            f"none of the {count} pairs could be registered: {reasons[0][1]}\n"
            f"fix the files and add --retry-failed; every reason is in {out}"
        )
    return flags.UNSURE if strict and trusted < count else 0

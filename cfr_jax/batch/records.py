"""What is written about a pair: a JSON record (`cli/schemas`) and a row of the table."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from typing import Any, TextIO

from cfr_jax.batch.jobs import Job
from cfr_jax.batch.stream import Outcome
from cfr_jax.runtime.messages import escaped

_FIGURES = ("trusted", "confidence", "determined", "fitness", "inlier_rmse", "inlier_distance",
            "scale", "scale_confidence")  # fmt: skip
_CELLS = tuple(f"t{row}{column}" for row in range(4) for column in range(4))
# The wide forms count as the others where texts are Chinese or Japanese.
_RUN_BY_SPREADSHEETS = ("=", "+", "-", "@", "\n", "＝", "＋", "－", "＠")
COLUMNS = ("source", "target", "status", *_FIGURES, *_CELLS, "remarks")


def as_record(job: Job, outcome: Outcome) -> dict[str, Any]:
    """Everything that is known about a pair; if it failed, all figures are null."""
    found = outcome.alignment
    figures = dict.fromkeys(
        (*_FIGURES, "transform", "transforms", "refined", "neighbors", "used", "seconds")
    )
    if found is not None:
        figures |= {name: getattr(found, name) for name in _FIGURES}
        figures |= {
            "transform": found.transform.tolist(),
            "transforms": found.transforms.tolist(),
            "refined": found.refined,
            "neighbors": found.neighbors,
            "used": {"source": len(found.source_rows), "target": len(found.target_rows)},
            "seconds": found.seconds,
        }
    return {
        "source": job.source,
        "target": job.target,
        "repeat": job.repeat,
        "error": outcome.error,
        "warnings": [] if found is None else list(found.warnings),
        **figures,
    }


def write_table(stream: TextIO, records: Iterable[dict[str, Any]]) -> None:
    """CSV with a header; numbers keep all their digits, and failed pairs have the reason alone.

    Spreadsheets run a cell that starts with one of `= + - @`, so names and remarks that do get an
    apostrophe in front, and control characters are escaped.
    """
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(map(_row, records))


def _row(record: dict[str, Any]) -> list[Any]:
    names = [_text(record["source"]), _text(record["target"])]
    if record["error"] is not None:
        empty = [""] * (len(_FIGURES) + len(_CELLS))
        return [*names, "failed", *empty, _text(record["error"])]
    figures = [_cell(record[name]) for name in _FIGURES]
    cells = [value for row in record["transform"] for value in row]
    return [*names, "ok", *figures, *cells, _text("; ".join(record["warnings"]))]


def _cell(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value


def _text(value: str) -> str:
    value = escaped(value)  # a bare carriage return, which `csv` does not quote, begins a row
    return f"'{value}" if value.startswith(_RUN_BY_SPREADSHEETS) else value

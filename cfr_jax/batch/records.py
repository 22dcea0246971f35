"""What is written about a pair: a JSON record (`cli/schemas`) and a row of the table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import Any

from cfr_jax.batch.jobs import Job
from cfr_jax.batch.stream import Outcome

_FIGURES = ("trusted", "confidence", "determined", "fitness", "inlier_rmse", "inlier_distance")
_CELLS = tuple(f"t{row}{column}" for row in range(4) for column in range(4))
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


def as_table(records: Iterable[dict[str, Any]]) -> str:
    """CSV with a header. Numbers keep all their digits; failed pairs have only the reason."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for record in records:
        names = [record["source"], record["target"]]
        if record["error"] is not None:
            empty = [""] * (len(_FIGURES) + len(_CELLS))
            writer.writerow([*names, "failed", *empty, record["error"]])
            continue
        figures = [_cell(record[name]) for name in _FIGURES]
        cells = [value for row in record["transform"] for value in row]
        writer.writerow([*names, "ok", *figures, *cells, "; ".join(record["warnings"])])
    return text.getvalue()


def _cell(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value

"""Registers a list of pairs on many machines, with Apache Beam (`pip install "cfr_jax[beam]"`).

    python examples/beam_batch.py pairs.csv --out results --bundle 64
    python examples/beam_batch.py gs://... --runner DataflowRunner ...   any options of the runner

The list is split into bundles of pairs, with the sources of one target next to each other. Each
worker loads the weights once, and runs `cfr_jax.align_many` on a bundle: it reads ahead, works in
batches, and encodes each target once. The output is lines of JSON, as from `cfr batch`; for a pair
that cannot be read, the line gives the reason. The runner retries bundles if a machine is lost.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import apache_beam as beam
from apache_beam.options.pipeline_options import PipelineOptions

from cfr_jax.batch.jobs import Job, jobs_of
from cfr_jax.data.layout import recognize


class Register(beam.DoFn):
    """Takes bundles of pairs, and returns one line of JSON per pair."""

    def __init__(self, weights: str, refine: bool):
        self._weights, self._refine = weights, refine

    def setup(self) -> None:
        """Loads JAX and the weights, once per worker."""
        from cfr_jax import load_params

        self._params = load_params(self._weights)

    def process(self, bundle: list[Job]) -> Iterator[str]:
        """Registers the pairs of one bundle."""
        from cfr_jax import align_many
        from cfr_jax.batch.checked_lines import line_of
        from cfr_jax.batch.records import as_record

        pairs = [job.pair for job in bundle]
        for outcome in align_many(pairs, params=self._params, refine=self._refine):
            yield line_of(as_record(bundle[outcome.index], outcome)).decode().rstrip("\n")


def bundles(jobs: list[Job], size: int) -> Iterator[list[Job]]:
    """Yields bundles of at most `size` pairs, with the sources of one target next to each other."""
    by_target = [list(group) for _, group in groupby(sorted(jobs, key=_target), key=_target)]
    bundle: list[Job] = []
    for group in by_target:
        for job in group:
            bundle.append(job)
            if len(bundle) == size:
                yield bundle
                bundle = []
    if bundle:
        yield bundle


def _target(job: Job) -> str:
    return job.target


def main(argv: list[str] | None = None) -> None:
    """Runs the pipeline; passes unknown options on to the runner."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", type=Path, help="what `cfr batch` takes, except an HDF5 file")
    parser.add_argument("--out", required=True, help="how the names of the output files start")
    parser.add_argument("--bundle", type=int, default=64, help="most pairs in a bundle")
    parser.add_argument("--weights", default="object")
    parser.add_argument("--no-refine", action="store_true")
    args, options = parser.parse_known_args(argv)

    jobs, how = jobs_of(recognize(args.pairs))
    print(f"{len(jobs)} pairs: {how}")
    with beam.Pipeline(options=PipelineOptions(options)) as pipeline:
        _ = (
            pipeline
            | "bundles" >> beam.Create(list(bundles(jobs, args.bundle)))
            | "spread" >> beam.Reshuffle()
            | "register" >> beam.ParDo(Register(args.weights, not args.no_refine))
            | "write" >> beam.io.WriteToText(args.out, file_name_suffix=".jsonl")
        )


if __name__ == "__main__":
    main()

"""A list of pairs over many machines, by Apache Beam (`pip install "cfr_jax[beam]"`).

    python examples/beam_batch.py pairs.csv --out results --bundle 64
    python examples/beam_batch.py gs://... --runner DataflowRunner ...   any runner's own options

The list is cut into bundles of pairs, the sources of one target together; each worker loads the
weights once and answers a bundle with `cfr_jax.align_many`, so that it reads ahead, batches, and
encodes a target once. Out come lines of JSON, as `cfr batch` writes them; a pair that cannot be
read is a line with the reason. The runner retries bundles whose machine went away.
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
    """Bundles of pairs in, a JSON line a pair out."""

    def __init__(self, weights: str, refine: bool):
        self._weights, self._refine = weights, refine

    def setup(self) -> None:
        """Once a worker: JAX and the weights."""
        from cfr_jax import load_params

        self._params = load_params(self._weights)

    def process(self, bundle: list[Job]) -> Iterator[str]:
        """Answers one bundle."""
        from cfr_jax import align_many
        from cfr_jax.batch.journal import line_of
        from cfr_jax.batch.records import as_record

        pairs = [job.pair for job in bundle]
        for outcome in align_many(pairs, params=self._params, refine=self._refine):
            yield line_of(as_record(bundle[outcome.index], outcome)).decode().rstrip("\n")


def bundles(jobs: list[Job], size: int) -> Iterator[list[Job]]:
    """At most `size` pairs each, the sources of one target next to each other."""
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
    """Runs the pipeline; options it does not know are the runner's."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", type=Path, help="what `cfr batch` takes, but no HDF5 file")
    parser.add_argument("--out", required=True, help="start of the names of the files written")
    parser.add_argument("--bundle", type=int, default=64, help="pairs a worker takes at a time")
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

"""`examples/beam_batch.py`, on Beam's local runner."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import batch_samples
import jsonschema
import pytest

from cfr_jax.batch import stream

pytest.importorskip("apache_beam", reason='needs Beam: pip install "cfr_jax[beam]"')
ROOT = Path(__file__).parents[2]


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import beam_batch

    yield beam_batch
    sys.modules.pop("beam_batch")


@pytest.mark.filterwarnings("ignore")  # Beam's own
def test_a_list_runs_on_the_local_runner(example, tmp_path, monkeypatch):
    # given: answers that cost nothing, and a file that cannot be read
    monkeypatch.setattr("cfr_jax.align_many", batch_samples.quick, raising=False)
    monkeypatch.setattr(stream, "align_many", batch_samples.quick)
    listed = batch_samples.write_pairs(tmp_path, 5)
    (tmp_path / "s3.ply").write_bytes(b"")

    # when
    example.main(
        [str(listed), "--out", str(tmp_path / "results"), "--bundle", "2",
         "--runner", "DirectRunner", "--direct_running_mode", "in_memory"]
    )  # fmt: skip

    # then
    parts = sorted(tmp_path.glob("results-*.jsonl"))
    found = [json.loads(line) for path in parts for line in path.read_text().splitlines()]
    schema = json.loads((ROOT / "cfr_jax/cli/schemas/batch.schema.json").read_text())
    for record in found:
        jsonschema.validate(record, schema)
    assert sorted(record["source"] for record in found) == [f"s{i}.ply" for i in range(5)]
    assert [record["source"] for record in found if record["error"]] == ["s3.ply"]


def test_bundles_keep_the_sources_of_a_target_together(example, tmp_path):
    from cfr_jax.batch.jobs import jobs_of
    from cfr_jax.data.layout import recognize

    listed = batch_samples.write_pairs(tmp_path, 2)
    listed.write_text("".join(f"s{i % 2}.ply,t{i % 2}.xyz\n" for i in range(7)))
    jobs, _ = jobs_of(recognize(listed))
    bundled = list(example.bundles(jobs, 4))
    assert [len(bundle) for bundle in bundled] == [4, 3]
    assert {job.target for job in bundled[0]} == {"t0.xyz"}
    assert sorted(job.key for bundle in bundled for job in bundle) == sorted(j.key for j in jobs)

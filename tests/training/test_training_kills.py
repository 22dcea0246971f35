"""A training killed without warning, again and again, ends as one that nothing disturbed."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest
import training_samples as samples
from training_samples import assert_same

from cfr_jax.training.checkpoints import Checkpoints
from cfr_jax.training.config import Phase
from cfr_jax.weights.files import load_params

HERE = Path(__file__).parent
KILLS = 15
STEPS = 150  # twice as many as the kills leave time for


def start(given, workdir):
    """A process that trains; see `main`."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)]),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    order = samples.in_text(given), str(workdir)
    return subprocess.Popen(
        [sys.executable, __file__, *order],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_bit_equal(tmp_path):
    given = samples.config(samples.write_corpus(tmp_path / "ellipsoids.h5"))
    given.phases = (Phase(steps=STEPS, points=24, neighbors=6, batch=2),)
    given.checkpoint_every, given.validate_every = 3, 9
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    process = start(given, whole)
    wait_for_checkpoint(process, whole, after=0)
    began = time.monotonic()
    output, _ = process.communicate(timeout=1800)
    assert process.returncode == 0, output
    stepping = time.monotonic() - began

    chance = random.Random(0)
    reached = [0]
    for _ in range(KILLS):
        process = start(given, killed)
        # a moment among the steps, not while it still starts and compiles
        wait_for_checkpoint(process, killed, after=reached[-1])
        time.sleep(chance.uniform(0, stepping / (2 * KILLS)))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        reached.append(newest(killed))
    assert reached[-1] < STEPS, "killed too late to tell"
    process = start(given, killed)
    output, _ = process.communicate(timeout=1800)
    assert process.returncode == 0, output

    (first, about), (second, told) = (state_of(folder) for folder in (whole, killed))
    assert int(first.step) == STEPS
    assert_same(first, second)
    assert about["best"] == told["best"] and about["position"] == told["position"]
    assert_same(*(load_params(f / "weights.safetensors") for f in (whole, killed)))
    assert steps_told(killed) == steps_told(whole)


def wait_for_checkpoint(process, workdir, after):
    deadline = time.monotonic() + 600
    while newest(workdir) <= after:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)


def steps_told(workdir):
    return [
        json.loads(line)["step"] for line in (workdir / "metrics.jsonl").read_text().splitlines()
    ]


def newest(workdir):
    made = (path.name for path in workdir.glob("checkpoints/*"))
    return max((int(name) for name in made if name.isdigit()), default=0)


def state_of(workdir):
    with Checkpoints(workdir / "checkpoints", keep=2) as checkpoints:
        return checkpoints.restore(samples.fresh())


def main(given: str, workdir: str) -> None:
    """Trains by a config, with the validation that needs no compiling."""
    from cfr_jax.training import loop, validation

    validation.validate = samples.cheap_validation
    loop.run(samples.from_text(given), Path(workdir))


if __name__ == "__main__":
    main(*sys.argv[1:])

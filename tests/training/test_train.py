"""`train.py` as a program: what it says to mistakes, and that Ctrl-C loses nothing."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import training_samples as samples

ROOT = Path(__file__).parents[2]


def command(folder, *more):
    corpus = samples.write_corpus(folder / "ellipsoids.h5")
    return [
        sys.executable, "train.py", "--config=configs/open_cad.py", f"--workdir={folder / 'run'}",
        f"--config.data.train={corpus}", f"--config.data.validation={corpus}",
        "--config.iterations=1", "--config.validation_pairs=2", "--config.train.start_from=",
        "--config.phases[0].steps=4000", "--config.phases[0].points=24",
        "--config.phases[0].neighbors=6", "--config.phases[0].batch=2",
        "--config.phases[1].steps=0", "--config.phases[1].batch=2", *more,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("flag", "wanted"),
    [
        ("--config.train.peek_rate=1", 'Did you mean "peak_rate"'),
        ("--config.phases.0.steps=20", "'--config.phases[0].steps=20'"),
        ("--config.phases[4].steps=20", "out of range"),
        ("--config.dta.train=a.h5", 'TrainingConfig has no field "dta". Did you mean "data"'),
        ("--config.zz=1", 'has no field "zz". It has seed, network'),
        ("--config.sampling.keep=0.5", "keep: got (0.5,), wanted two numbers"),
        ("--config.data.train=nowhere.h5", "nowhere.h5"),
    ],
)
def test_mistakes_are_told_in_a_few_lines(tmp_path, flag, wanted):
    done = subprocess.run(
        command(tmp_path, flag), cwd=ROOT, capture_output=True, text=True, timeout=300
    )

    assert done.returncode == 1
    lines = done.stderr.strip().splitlines()
    assert lines[0].startswith("train.py: error: ") and len(lines) <= 3, done.stderr
    assert wanted in done.stderr


@pytest.mark.slow
def test_ctrl_c_saves_and_the_same_command_goes_on(tmp_path):
    def started():
        return subprocess.Popen(
            command(tmp_path, "--config.checkpoint_every=1000", "--config.validate_every=1000"),
            cwd=ROOT, env=os.environ | {"PYTHONUNBUFFERED": "1"}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    process = started()
    for line in process.stderr:
        if line.startswith("training: ") and not line.startswith("training: 0 of"):
            break
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "of 4000, all saved; run the same command again to resume" in error
    assert "Traceback" not in error
    saved = max(int(path.name) for path in (tmp_path / "run/checkpoints").glob("[0-9]*"))

    process = started()
    for line in process.stdout:
        if line.startswith("resuming"):
            break
    process.kill()
    process.communicate()
    assert line == f"resuming at step {saved}\n"

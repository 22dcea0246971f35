"""Many devices and many processes train as one: real ones, in processes of their own."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import training_samples as samples

from cfr_jax.training import devices
from cfr_jax.training.config import Phase

HERE = Path(__file__).parent


def config(folder, draw="host"):
    """Four steps of eight pairs, small enough to compile quickly."""
    given = samples.config(samples.write_corpus(folder / "ellipsoids.h5"))
    given.phases = (Phase(steps=4, points=24, neighbors=6, batch=8),)
    given.log_every = given.checkpoint_every = 1
    given.validate_every = 4
    given.train.draw = draw
    return given


def start(folder, workdir, devices=1, *, draw="host", stop_after=0, **group):
    """A process that trains by `config`; see `main` below."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)]),
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    given = samples.in_text(config(folder, draw))
    order = json.dumps({"workdir": str(workdir), "stop_after": stop_after, "group": group})
    return subprocess.Popen(
        [sys.executable, __file__, given, order],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def finish(*processes, timeout=1800):
    for process in processes:
        output, _ = process.communicate(timeout=timeout)
        assert process.returncode == 0, output


def losses(workdir):
    lines = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines if "loss" in line}


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def pair_of_processes(folder, workdir, stop_after=0, **more):
    coordinator = f"127.0.0.1:{free_port()}"
    return [
        start(
            folder, workdir, stop_after=stop_after,
            coordinator=coordinator, processes=2, process=number, **more,
        )
        for number in range(2)
    ]  # fmt: skip


def assert_close(curve, other):
    assert curve.keys() == other.keys() and len(curve) == 4
    np.testing.assert_allclose(list(curve.values()), list(other.values()), atol=1e-4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The loss curve of one device, and the folder it was made in."""
    folder = tmp_path_factory.mktemp("alone")
    finish(start(folder, folder / "run"))
    return folder, losses(folder / "run")


@pytest.mark.slow
def test_eight_devices_give_the_curve_of_one(alone):
    folder, curve = alone

    finish(start(folder, folder / "eight", devices=8))

    assert_close(losses(folder / "eight"), curve)


@pytest.mark.slow
def test_two_processes_train_together_and_each_goes_on_from_the_others_checkpoint(alone):
    folder, curve = alone

    # two processes, stopped after two steps
    finish(*pair_of_processes(folder, folder / "two", stop_after=2))
    assert list(losses(folder / "two")) == [1, 2]
    # both go on, the second from what the first wrote
    finish(*pair_of_processes(folder, folder / "two"))
    assert_close(losses(folder / "two"), curve)

    # and what two began, one finishes alone
    finish(*pair_of_processes(folder, folder / "handed", stop_after=2))
    finish(start(folder, folder / "handed"))
    assert_close(losses(folder / "handed"), curve)


@pytest.mark.slow
def test_any_number_of_devices_and_processes_draws_the_same_pairs(alone):
    folder, _ = alone
    finish(start(folder, folder / "drawn", draw="device"))
    curve = losses(folder / "drawn")

    finish(start(folder, folder / "drawn by eight", devices=8, draw="device"))
    finish(*pair_of_processes(folder, folder / "drawn by two", draw="device"))

    assert_close(losses(folder / "drawn by eight"), curve)
    assert_close(losses(folder / "drawn by two"), curve)


def test_a_batch_that_the_devices_cannot_share_is_refused():
    mesh = devices.make_mesh()

    devices.check_batch(4 * mesh.size, 2, mesh)
    with pytest.raises(ValueError, match="pairs_at_once: got 3"):
        devices.check_batch(4 * mesh.size, 3, mesh)
    with pytest.raises(ValueError, match="batch: got 0"):
        devices.check_batch(0, 1, mesh)


def test_processes_of_unequal_devices_are_refused(monkeypatch):
    mesh = devices.make_mesh()
    monkeypatch.setattr(jax, "process_count", lambda: 2)  # the other one would have none

    with pytest.raises(ValueError, match="processes: .*wanted equally many in each process"):
        devices.check_batch(4 * mesh.size, 1, mesh)


@pytest.mark.parametrize(
    ("cores", "batches", "wanted"), [(2, [8, 8], 2), (16, [8], 8), (6, [8, 12], 4), (4, [7], 1)]
)
def test_cores_become_devices_that_share_every_batch(monkeypatch, cores, batches, wanted):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)

    assert devices.of_cores(*batches) == wanted


def test_a_number_of_devices_that_was_asked_for_stands(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=3")

    assert devices.of_cores(8) is None


def test_several_processes_need_a_place_to_meet():
    with pytest.raises(ValueError, match="coordinator"):
        devices.join("", 2, 0)
    with pytest.raises(ValueError, match="process: got 2, wanted 0 to 1"):
        devices.join("localhost:1", 2, 2)


def test_what_is_spread_comes_back_in_its_order():
    mesh = devices.make_mesh()
    rows = np.arange(6 * mesh.size, dtype=np.float32).reshape(-1, 3)

    placed = devices.spread({"a": rows[devices.share_of(len(rows))]}, mesh)

    np.testing.assert_array_equal(devices.gather(placed["a"]), rows)
    np.testing.assert_array_equal(devices.replicate({"b": rows}, mesh)["b"], rows)
    assert devices.agree(7) == 7


def main(given: str, order: str) -> None:
    """Trains; stops without a word after so many steps."""
    from cfr_jax.training import loop, step, validation

    given, order = samples.from_text(given), json.loads(order)
    if order["group"]:
        devices.join(**order["group"])
    validation.validate = samples.cheap_validation
    train_step, begun = step.train_step, []

    def stopping(*arguments, **named):
        if len(begun) == order["stop_after"] > 0:
            raise KeyboardInterrupt
        begun.append(None)
        return train_step(*arguments, **named)

    step.train_step = stopping
    try:
        loop.run(given, Path(order["workdir"]))
    except KeyboardInterrupt:
        # stopped between two steps, with the checkpoint before it finished
        jax.distributed.shutdown() if order["group"] else None


if __name__ == "__main__":
    main(*sys.argv[1:])

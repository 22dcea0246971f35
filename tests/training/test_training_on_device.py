"""Training on pairs that the device draws: the steps are those of `train_step`, a run resumes bit
for bit, and a budget of minutes becomes a number of steps."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import training_samples as samples
from training_samples import BATCH, NEIGHBORS, POINTS, assert_same, fresh, recipe

from cfr_jax.data.augmentation.pairs_on_device import Shapes, draw_pairs
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.data.loader import items_at
from cfr_jax.data.mixture import Mixture
from cfr_jax.data.sources import ShapeSource
from cfr_jax.training import devices, learner, loop, optimizers, step, validation
from cfr_jax.training.checkpoints import Checkpoints
from cfr_jax.training.config import Phase, TrainSection
from cfr_jax.training.reporting.reporter import Reporter
from cfr_jax.training.sampling import Leg
from cfr_jax.training.sampling.device import DeviceDrawing
from cfr_jax.weights.files import read_weights

STEPS_AT_ONCE = 4
SAMPLING = Sampling(points=POINTS, neighbors=NEIGHBORS, estimated_normals=0.5)


@pytest.fixture(autouse=True)
def promotion_as_optax_needs_it():
    """Its schedules and moments mix integers with floats."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def corpus_file(tmp_path_factory):
    return samples.write_corpus(tmp_path_factory.mktemp("corpus") / "ellipsoids.h5")


def config(corpus_file, **train):
    given = samples.config(corpus_file)
    changed = {"draw": "device", "steps_at_once": STEPS_AT_ONCE, **train}
    return dataclasses.replace(
        given,
        phases=(Phase(16, POINTS, NEIGHBORS, BATCH),),
        train=TrainSection(**dataclasses.asdict(given.train) | changed),
    )


def run(given, folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation, "validate", samples.cheap_validation)
        # the same optimizer compiles once
        patch.setattr(optimizers, "make_optimizer", lambda *_, **__: samples.optimizer())
        return loop.run(given, folder)


@pytest.fixture(scope="module")
def whole(corpus_file, tmp_path_factory):
    """A run that nothing disturbed: its folder and its best validation."""
    folder = tmp_path_factory.mktemp("whole")
    with jax.numpy_dtype_promotion("standard"):
        return folder, run(config(corpus_file), folder)


def lines_of(workdir):
    lines = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines if "loss" in line}


def state_of(workdir):
    with Checkpoints(workdir / "checkpoints", keep=2) as checkpoints:
        return checkpoints.restore(fresh())[0]


def placed(corpus_file):
    """Shapes, seed, and the items and places of three steps, on the devices."""
    mesh = devices.make_mesh()
    places = np.arange(6, 6 + 3 * BATCH)
    items = items_at(4, 6, 3 * BATCH, 0).astype(np.int32).reshape(3, BATCH)
    shapes, seed = devices.replicate((Shapes.of(read_corpus(corpus_file)), np.uint32(0)), mesh)
    rows = [items, places.astype(np.uint32).reshape(3, BATCH)]
    return shapes, seed, *(devices.spread_steps(each, mesh) for each in rows)


def test_several_steps_at_once_are_the_same_steps_one_by_one(corpus_file):
    shapes, seed, items, positions = placed(corpus_file)
    draw = jax.jit(draw_pairs, static_argnames=("sampling",))

    after, measured = step.train_on_drawn(
        fresh(), shapes, seed, items, positions, recipe=recipe(), sampling=SAMPLING
    )

    state, losses = fresh(), []
    for row in range(3):
        batch = draw(shapes, seed, items[row], positions[row], sampling=SAMPLING)
        batch = devices.spread(jax.tree.map(np.asarray, batch), devices.make_mesh())
        state, one = step.train_step(state, batch, recipe=recipe())
        losses.append(np.asarray(one.total))
    assert measured.total.shape == (3 * BATCH,)
    np.testing.assert_allclose(measured.total, np.concatenate(losses), atol=1e-4)
    assert int(after.step) == 3 and int(after.skipped) == 0


def test_nothing_is_copied_to_or_from_the_host_during_steps(corpus_file):
    arguments = placed(corpus_file)
    state, _ = step.train_on_drawn(fresh(), *arguments, recipe=recipe(), sampling=SAMPLING)

    with jax.transfer_guard("disallow"):
        state, measured = step.train_on_drawn(state, *arguments, recipe=recipe(), sampling=SAMPLING)
        jax.block_until_ready(measured)

    assert int(state.step) == 6


def test_a_run_logs_validates_and_saves_at_the_steps_asked_for(whole):
    folder, best = whole

    assert list(lines_of(folder)) == [4, 8, 12, 16]
    assert best["step"] in (4, 8, 12, 16)
    assert int(state_of(folder).step) == 16
    about = json.loads((folder / "checkpoints/16/about.json").read_text())
    assert about["position"] == 16 * BATCH
    made = read_weights(folder / "weights.safetensors")
    assert json.loads(made.notes["validation"]) == best


def test_an_interrupted_run_draws_the_same_pairs_and_resumes_bit_for_bit(
    corpus_file, tmp_path, whole, monkeypatch
):
    class Killed(Exception):
        pass

    noted = Reporter.step

    def killed(self, done, *rest):
        if done == 12:
            raise Killed
        noted(self, done, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Reporter, "step", killed)
        with pytest.raises(Killed):
            run(config(corpus_file), tmp_path)
    assert max(int(path.name) for path in (tmp_path / "checkpoints").glob("[0-9]*")) == 8

    assert run(config(corpus_file), tmp_path) == whole[1]

    assert_same(state_of(tmp_path), state_of(whole[0]))
    assert lines_of(tmp_path) == lines_of(whole[0])


def test_logs_come_with_the_first_steps_at_or_after_those_asked_for(corpus_file, tmp_path):
    given = config(corpus_file)
    given.log_every, given.checkpoint_every, given.validate_every = 6, 100, 100

    run(given, tmp_path)

    assert list(lines_of(tmp_path)) == [8, 12, 16]


def test_minutes_become_as_many_steps_as_fit_and_stay_so(corpus_file, tmp_path, monkeypatch):
    monkeypatch.setattr(loop.time, "monotonic", lambda: 0.0)
    monkeypatch.setattr(DeviceDrawing, "speed", lambda *_: 12.0)
    given = config(corpus_file, minutes=0.02, schedule="trapezoid")  # 0.97 * 1.2 s * 12 steps/s

    run(given, tmp_path)

    assert list(lines_of(tmp_path)) == [4, 8, 12]
    about = json.loads((tmp_path / "checkpoints/12/about.json").read_text())
    assert about["steps"] == about["step"] == 12
    monkeypatch.setattr(DeviceDrawing, "speed", pytest.fail)  # all is decided
    run(given, tmp_path)


def test_too_few_minutes_are_told(corpus_file, tmp_path, monkeypatch):
    monkeypatch.setattr(DeviceDrawing, "speed", lambda *_: 2.0)
    given = config(corpus_file, minutes=1e-6, schedule="trapezoid")

    with pytest.raises(ValueError, match="minutes: got 1e-06, wanted more: .* 4 steps take 2.0"):
        run(given, tmp_path)


def test_the_speed_is_taken_of_a_copy(corpus_file):
    sources = Mixture([ShapeSource(read_corpus(corpus_file))], [1])
    drawing = DeviceDrawing(config(corpus_file), sources, devices.make_mesh())
    state = fresh()
    leg = Leg(Phase(16, POINTS, NEIGHBORS, BATCH), SAMPLING, recipe())

    assert 0 < drawing.speed(leg, state) < 1e6

    assert_same(state, fresh())  # and nothing of it was given away


def corpus(count, points):
    cloud = np.zeros((count, points, 3), np.float32)
    names = tuple(str(i) for i in range(count))
    return Corpus(
        cloud + np.arange(count)[:, None, None], cloud, np.zeros(count, int), names, ("a",)
    )


def drawing_of(sources, repeats, corpus_file):
    mixture = Mixture(sources, repeats)
    return DeviceDrawing(config(corpus_file), mixture, devices.make_mesh())


def test_sources_of_shapes_become_one_corpus_in_which_repeats_cost_nothing(corpus_file, unchecked):
    found = drawing_of([ShapeSource(corpus(2, 5)), ShapeSource(corpus(3, 5))], [2, 1], corpus_file)

    shapes, rows = found._on_device[0], found._rows
    assert shapes.points.shape == (5, 5, 3) and rows.tolist() == [0, 1, 0, 1, 2, 3, 4]
    np.testing.assert_array_equal(shapes.points[:, 0, 0], [0, 1, 0, 1, 2])


def test_what_the_device_cannot_draw_is_refused(corpus_file, unchecked):
    with pytest.raises(ValueError, match=r"shapes of data.train have \[5, 6\] points"):
        drawing_of([ShapeSource(corpus(2, 5)), ShapeSource(corpus(2, 6))], [1, 1], corpus_file)
    with pytest.raises(ValueError, match="data.train holds scans"):
        drawing_of([jnp.zeros(3)], [1], corpus_file)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"draw": "moon"}, "draw: got 'moon', wanted one of host, device"),
        ({"draw": "host"}, "steps_at_once, minutes: got 4 and 0.0, wanted 1 and 0"),
        ({"steps_at_once": 5}, "steps_at_once: got 5, wanted a divisor of the 16 steps"),
        ({"steps_at_once": 0}, "steps_at_once: got 0"),
        ({"minutes": 1.0}, "minutes: got 1.0 for 1 phases and schedule 'cosine'"),
        ({"minutes": -1.0}, "minutes: got -1.0"),
    ],
)
def test_what_does_not_fit_together_is_named(corpus_file, change, wanted):
    with pytest.raises(ValueError, match=wanted):
        config(corpus_file, **change)


def test_bfloat16_is_of_cfr_alone(corpus_file, tmp_path):
    given = config(corpus_file, precision="bfloat16")
    given.network = "rpmnet"

    wanted = "precision: got 'bfloat16', which rpmnet does not support"
    with pytest.raises(ValueError, match=wanted):
        run(given, tmp_path)


def test_a_precision_is_that_of_the_training_and_not_of_the_validation(corpus_file):
    chosen = learner.learner(config(corpus_file, precision="bfloat16"))

    assert chosen.trained(5).activations == "bfloat16"
    assert chosen.validated.activations == "float32"

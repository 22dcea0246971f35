"""The training step: it learns, it skips what is not finite, and a run resumes bit for bit."""

import functools
import json

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from cfr_jax import network, registration, trainer, training, weights
from cfr_jax.checkpoints import Checkpoints
from cfr_jax.data.batches import Sampling, batch_at
from cfr_jax.data.corpus import read_corpus

POINTS, NEIGHBORS, BATCH = 24, 6, 2
SETTINGS = registration.Settings(neighbors=NEIGHBORS, detach_motion=True)
make_optimizer = functools.cache(training.make_optimizer)  # the same one compiles once
OPTIMIZER = make_optimizer(peak_rate=5e-3, steps=16, warmup=0.1, clip=1.0, weight_decay=1e-5)


@pytest.fixture(autouse=True)
def promotion_as_optax_needs_it():
    """Its schedules and moments mix integers with floats."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def corpus_file(tmp_path_factory):
    """Four ellipsoids, large enough for the protocol."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4, 1100, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    path = tmp_path_factory.mktemp("corpus") / "ellipsoids.h5"
    with h5py.File(path, "w") as file:
        file["data"] = directions * rng.uniform(0.4, 1, size=(4, 1, 3))
        file["normal"] = directions
        file["label"] = np.zeros(4, np.int64)
    return path


@pytest.fixture(scope="module")
def batch(corpus_file):
    sampling = Sampling(points=POINTS, neighbors=NEIGHBORS, estimated_normals=0.5)
    return batch_at(read_corpus(corpus_file), 0, BATCH, sampling, seed=0)


def step(state, batch, pairs_at_once=1):
    return training.train_step(
        state,
        batch,
        optimizer=OPTIMIZER,
        unroll=registration.unroll,
        settings=SETTINGS,
        correspondence_weight=0.05,
        decay=0.9,
        pairs_at_once=pairs_at_once,
    )


def fresh():
    return training.init_state(network.init_params(jax.random.key(0), 1), OPTIMIZER)


def assert_same(tree, other):
    for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_loss_of_a_batch_falls(batch):
    state, losses = fresh(), []

    for _ in range(16):
        state, measured = step(state, batch)
        losses.append(float(measured.total))

    assert losses[-1] < 0.7 * losses[0]
    assert int(state.step) == 16 and int(state.skipped) == 0


def test_a_batch_that_is_not_finite_changes_nothing_but_the_count(batch):
    before, _ = step(fresh(), batch)
    kept = jax.tree.map(np.array, before)
    broken = batch | {"source": np.where(np.arange(3) == 1, np.nan, batch["source"])}
    broken["source"] = broken["source"].astype(np.float32)

    after, _ = step(before, broken)

    assert_same(after.params, kept.params)
    assert_same(after.average, kept.average)
    assert_same(after.optimizer, kept.optimizer)
    assert int(after.skipped) == 1 and int(after.step) == int(kept.step) + 1


def test_pairs_one_by_one_or_together_make_the_same_step(batch):
    alone, _ = step(fresh(), batch)
    together, _ = step(fresh(), batch, pairs_at_once=BATCH)

    # Adam's first step is the sign of the gradient where it is not tiny: hold the moments instead
    first, second = (
        jax.tree.leaves(state.optimizer)[: len(jax.tree.leaves(state.params)) + 1]
        for state in (alone, together)
    )
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_the_average_follows_the_parameters(batch):
    start = jax.tree.map(np.array, fresh().params)
    state, _ = step(fresh(), batch)

    kernel = [tree["features"]["kernel_1"] for tree in (start, state.params, state.average)]
    decay = 0.1  # (1 + step) / (10 + step) at step 0, as long as it is below the 0.9 asked for
    wanted = decay * kernel[0] + (1 - decay) * kernel[1]
    np.testing.assert_allclose(kernel[2], wanted, atol=1e-6)


def config(corpus_file):
    """A run of 16 steps, compiled to the same program as the steps above."""
    given = ConfigDict()
    given.seed, given.network, given.iterations = 0, "cfr", 1
    given.data = {"train": str(corpus_file), "validation": str(corpus_file)}
    given.phases = (
        {"steps": 2, "points": POINTS, "neighbors": NEIGHBORS, "batch": BATCH},
        {"steps": 14, "points": POINTS, "neighbors": NEIGHBORS, "batch": BATCH},
    )
    given.sampling = {"keep": (0.7, 0.7), "estimated_normals": 0.5}
    given.train = {
        "peak_rate": 5e-3, "warmup": 0.1, "clip": 1.0, "weight_decay": 1e-5, "start_from": "",
        "correspondence_weight": 0.05, "average_decay": 0.9, "pairs_at_once": 1, "workers": 2,
    }  # fmt: skip
    given.log_every, given.validate_every, given.validation_pairs = 4, 4, 2
    given.keep_checkpoints = 2
    return given


class Killed(Exception):
    """Stands for the power going off."""


def run(corpus_file, folder):
    """A whole training, but for the validation: compiling that takes longer than all the rest."""

    def validate(chosen, params, batch):
        change = np.sum(np.asarray(params["features"]["kernel_1"]) ** 2)
        return {"rotation_mean": float(change), "rotation_median": 0.0, "recall_5deg_0.1": 0.0}

    with pytest.MonkeyPatch.context() as patch, jax.numpy_dtype_promotion("standard"):
        patch.setattr(trainer, "validate", validate)
        patch.setattr(training, "make_optimizer", make_optimizer)
        return trainer.run(config(corpus_file), folder)


@pytest.fixture(scope="module")
def whole(corpus_file, tmp_path_factory):
    """A run that nothing disturbed: its folder and its best validation."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(corpus_file, folder)


def state_of(workdir):
    like = training.init_state(network.init_params(jax.random.key(0), 1), OPTIMIZER)
    with Checkpoints(workdir / "checkpoints", keep=2) as checkpoints:
        return checkpoints.restore(like)[0]


def test_an_interrupted_run_resumes_bit_for_bit(corpus_file, tmp_path, monkeypatch, whole):
    steps, train_step = [], training.train_step

    def killed_in_step_11(*arguments, **named):
        steps.append(None)
        if len(steps) == 11:
            raise Killed
        return train_step(*arguments, **named)

    monkeypatch.setattr(training, "train_step", killed_in_step_11)
    with pytest.raises(Killed):
        run(corpus_file, tmp_path)
    best = run(corpus_file, tmp_path)

    assert len(steps) == 11 + 8  # it went on after the checkpoint of step 8
    assert best == whole[1]
    first, second = (state_of(folder) for folder in (whole[0], tmp_path))
    assert int(first.step) == 16
    assert_same(first, second)
    files = (folder / "weights.safetensors" for folder in (whole[0], tmp_path))
    assert_same(*(weights.load_params(file) for file in files))


def test_a_finished_run_has_nothing_left_to_do(corpus_file, whole, monkeypatch):
    monkeypatch.delattr(training, "train_step")

    assert run(corpus_file, whole[0]) == whole[1]


def test_a_run_leaves_its_measurements_and_its_weights(whole):
    folder, best = whole

    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == [4, 8, 12, 16]
    assert all(np.isfinite(line["loss"]) for line in lines if "loss" in line)
    measured = {line["step"]: line["validation"] for line in lines if "validation" in line}
    assert list(measured) == [4, 8, 12, 16]
    assert best["rotation_mean"] == min(found["rotation_mean"] for found in measured.values())
    made = weights.read_weights(folder / "weights.safetensors")
    assert json.loads(made.notes["validation"]) == best
    assert json.loads(made.notes["config"])["validate_every"] == 4


def test_validation_measures_the_last_transform(corpus_file, monkeypatch):
    corpus = read_corpus(corpus_file)
    held_out = trainer.validation_batch(corpus, 3)
    assert held_out["source"].shape == (3, 717, 3)
    assert held_out["source_neighbors"].shape == (3, 717, 64)
    off = np.array(held_out["transform"], np.float32)[:, None].repeat(2, axis=1)
    off[:, 0, 0, 3] += 5
    off[0, 1, 0, 3] += 0.5
    monkeypatch.setattr(training, "predict", lambda *_, **__: jnp.asarray(off))

    found = trainer.validate(trainer.learner(config("")), {}, held_out)

    np.testing.assert_allclose(found["translation_mean"], 0.5 / 3, rtol=1e-4)
    np.testing.assert_allclose(found["recall_5deg_0.1"], 2 / 3)
    assert found["rotation_mean"] < 0.1 and len(found["rotation_by_iteration"]) == 2


def test_prediction_answers_pair_after_pair(batch):
    params = network.init_params(jax.random.key(0), 1)
    predict = functools.partial(
        training.predict, params, unroll=registration.unroll, settings=SETTINGS
    )

    found = predict(batch)

    assert found.shape == (BATCH, 1, 4, 4)
    backwards = jax.tree.map(lambda leaf: leaf[::-1], batch)
    swapped = predict(backwards)
    np.testing.assert_allclose(swapped[::-1], found, atol=1e-6)


@pytest.mark.parametrize(
    ("step", "left", "used"),
    [(0, [(3, 0), (5, 0)], 0), (2, [(3, 2), (5, 0)], 8), (3, [(5, 0)], 12), (7, [(5, 4)], 20),
     (8, [], 22)],
)  # fmt: skip
def test_the_curriculum_goes_on_within_its_phases(step, left, used):
    phases = [trainer.Phase(3, 24, 6, 4), trainer.Phase(5, 24, 6, 2)]

    assert [(phase.steps, done) for phase, done in trainer.remaining(phases, step)] == left
    assert trainer.pairs_before(phases, step) == used

"""The training step: it learns, it skips what is not finite, and a run resumes bit for bit."""

import json

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from cfr_jax import trainer, training, weights
from cfr_jax.data.batches import Sampling, batch_at
from cfr_jax.data.corpus import read_corpus
from cfr_jax.registration import Settings

POINTS, NEIGHBORS, BATCH = 24, 6, 2
OPTIMIZER = training.make_optimizer(
    peak_rate=3e-3, steps=30, warmup=0.1, clip=1.0, weight_decay=1e-5
)


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
        settings=Settings(neighbors=NEIGHBORS, detach_motion=True),
        correspondence_weight=0.05,
        decay=0.9,
        pairs_at_once=pairs_at_once,
    )


def fresh():
    return training.init_state(training.fresh_params(0, 1), OPTIMIZER)


def assert_same(tree, other):
    for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_loss_of_a_batch_falls(batch):
    state, losses = fresh(), []

    for _ in range(30):
        state, measured = step(state, batch)
        losses.append(float(measured.total))

    assert losses[-1] < 0.7 * losses[0]
    assert int(state.step) == 30 and int(state.skipped) == 0


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


def config(corpus_file, steps):
    given = ConfigDict()
    given.seed, given.iterations = 0, 1
    given.data = {"train": str(corpus_file), "validation": str(corpus_file)}
    given.phases = (
        {"steps": 2, "points": POINTS, "neighbors": NEIGHBORS, "batch": BATCH},
        {"steps": steps - 2, "points": POINTS, "neighbors": NEIGHBORS, "batch": BATCH},
    )
    given.sampling = {"keep": (0.7, 0.7), "estimated_normals": 0.5}
    given.train = {
        "peak_rate": 1e-3, "warmup": 0.1, "clip": 1.0, "weight_decay": 1e-5, "start_from": "",
        "correspondence_weight": 0.05, "average_decay": 0.9, "pairs_at_once": 1, "workers": 2,
    }  # fmt: skip
    given.log_every, given.validate_every, given.validation_pairs = 2, 2, 2
    given.keep_checkpoints = 2
    return given


class Killed(Exception):
    """Stands for the power going off."""


@pytest.fixture
def quick_validation(monkeypatch):
    """The compiled validation at full size takes longer than all the rest here."""

    def validate(params, batch):
        kernel = np.asarray(params["features"]["kernel_1"])
        return {"rotation_mean": float(np.sum(kernel**2)), "rotation_median": 0.0,
                "recall_5deg_0.1": 0.0}  # fmt: skip

    monkeypatch.setattr(trainer, "validate", validate)


def test_an_interrupted_run_resumes_bit_for_bit(
    corpus_file, tmp_path, monkeypatch, quick_validation
):
    whole = trainer.run(config(corpus_file, 6), tmp_path / "whole")

    steps, train_step = [], training.train_step

    def killed_in_its_fourth(*arguments, **named):
        steps.append(None)
        if len(steps) == 4:
            raise Killed
        return train_step(*arguments, **named)

    monkeypatch.setattr(training, "train_step", killed_in_its_fourth)
    with pytest.raises(Killed):
        trainer.run(config(corpus_file, 6), tmp_path / "parts")
    resumed = trainer.run(config(corpus_file, 6), tmp_path / "parts")

    assert len(steps) == 4 + 4  # killed in step 4, gone on after the checkpoint of step 2
    assert resumed == whole
    restored = [state_of(tmp_path / name) for name in ("whole", "parts")]
    assert int(restored[0].step) == 6
    assert_same(*restored)
    assert_same(*(weights.load_params(tmp_path / n / "weights.safetensors")
                  for n in ("whole", "parts")))  # fmt: skip


def state_of(workdir):
    from cfr_jax.checkpoints import Checkpoints

    optimizer = training.make_optimizer(
        peak_rate=1e-3, steps=6, warmup=0.1, clip=1.0, weight_decay=1e-5
    )
    like = training.init_state(training.fresh_params(0, 1), optimizer)
    with Checkpoints(workdir / "checkpoints", keep=2) as checkpoints:
        return checkpoints.restore(like)[0]


def test_a_run_leaves_its_measurements_and_its_weights(corpus_file, tmp_path, quick_validation):
    best = trainer.run(config(corpus_file, 4), tmp_path)

    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 2, 4, 4]
    assert all(np.isfinite(line["loss"]) for line in lines if "loss" in line)
    made = weights.read_weights(tmp_path / "weights.safetensors")
    assert json.loads(made.notes["validation"]) == json.loads(json.dumps(best))
    assert json.loads(made.notes["config"])["validate_every"] == 2


def test_validation_measures_the_last_transform(corpus_file, monkeypatch):
    corpus = read_corpus(corpus_file)
    held_out = trainer.validation_batch(corpus, 3, Settings())
    assert held_out["source"].shape == (3, 717, 3)
    assert held_out["source_neighbors"].shape == (3, 717, 64)
    off = np.array(held_out["transform"], np.float32)[:, None].repeat(2, axis=1)
    off[:, 0, 0, 3] += 5
    off[0, 1, 0, 3] += 0.5
    monkeypatch.setattr(training, "predict", lambda *_, **__: jnp.asarray(off))

    found = trainer.validate({}, held_out)

    np.testing.assert_allclose(found["translation_mean"], 0.5 / 3, rtol=1e-4)
    np.testing.assert_allclose(found["recall_5deg_0.1"], 2 / 3)
    assert found["rotation_mean"] < 0.1 and len(found["rotation_by_iteration"]) == 2


def test_prediction_answers_pair_after_pair(batch):
    params = training.fresh_params(0, 1)

    found = training.predict(params, batch, settings=Settings(neighbors=NEIGHBORS))

    assert found.shape == (BATCH, 1, 4, 4)
    backwards = jax.tree.map(lambda leaf: leaf[::-1], batch)
    swapped = training.predict(params, backwards, settings=Settings(neighbors=NEIGHBORS))
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

"""What the tests of training share: a tiny corpus, a tiny recipe, and one compiled step."""

import ast
import dataclasses
import functools

import h5py
import jax
import numpy as np

from cfr_jax.networks import inputs
from cfr_jax.networks.cfr import iterations
from cfr_jax.networks.cfr import modules as network
from cfr_jax.training import devices, step
from cfr_jax.training.config import (
    DataSection,
    Phase,
    SamplingSection,
    TrainingConfig,
    TrainSection,
)
from cfr_jax.training.optimizers import make_optimizer, make_schedule

POINTS, NEIGHBORS, BATCH, STEPS, MAX_SKIPPED = 24, 6, 2, 16, 3
SETTINGS = inputs.Settings(neighbors=NEIGHBORS, detach_motion=True)


@functools.cache
def optimizer():
    schedule = make_schedule("cosine", peak_rate=5e-3, steps=STEPS, warmup=0.1)
    return make_optimizer("adamw", schedule, clip=1.0, weight_decay=1e-5)


def recipe(**changes):
    """The one recipe of all tests, so that it compiles once."""
    given = {
        "unroll": iterations.unroll,
        "settings": SETTINGS,
        "optimizer": optimizer(),
        "mesh": devices.make_mesh(),
        "correspondence_weight": 0.05,
        "average_decay": 0.9,
        "pairs_at_once": 1,
        "precision": "float32",
        "max_skipped": MAX_SKIPPED,
    }
    return step.Recipe(**given | changes)


def fresh():
    """Placed as in a run: another placement would be compiled anew."""
    state = step.init_state(network.init_params(jax.random.key(0), 1), optimizer())
    return devices.replicate(state, devices.make_mesh())


def write_corpus(path, shapes=4):
    """Ellipsoids, large enough for the protocol."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(shapes, 1100, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    with h5py.File(path, "w") as file:
        file["data"] = directions * rng.uniform(0.4, 1, size=(shapes, 1, 3))
        file["normal"] = directions
        file["label"] = np.zeros(shapes, np.int64)
    return path


def config(corpus_file):
    """A run of 16 steps that compiles to the recipe above."""
    return TrainingConfig(
        iterations=1,
        data=DataSection(train=str(corpus_file), validation=str(corpus_file)),
        phases=(Phase(2, POINTS, NEIGHBORS, BATCH), Phase(STEPS - 2, POINTS, NEIGHBORS, BATCH)),
        sampling=SamplingSection(
            keep=(0.7, 0.7), both_ways=0.0, near=0.0, centered=0.0, any_orientation=0.0,
            scale=(1.0, 1.0), estimated_normals=0.5,
        ),
        train=TrainSection(
            peak_rate=5e-3, average_decay=0.9, workers=2, max_skipped=MAX_SKIPPED
        ),
        log_every=4, checkpoint_every=4, validate_every=4, validation_pairs=2,
    )  # fmt: skip


def in_text(config):
    """A config for another process; `from_text` reads it."""
    return repr(dataclasses.asdict(config))


def from_text(text):
    return TrainingConfig(**ast.literal_eval(text))


def cheap_validation(chosen, params, placed, truth, mesh, pairs_at_once):
    """Instead of the network: compiling that takes longer than all the rest of a test."""
    change = np.sum(np.asarray(params["features"]["kernel_1"]) ** 2)
    return {
        "rotation_mean": float(change), "rotation_median": 0.0, "translation_mean": 0.0,
        "recall_5deg_0.1": 0.0, "rotation_by_iteration": [float(change)],
        "transforms": np.tile(np.eye(4), (len(truth), 1, 1, 1)),
    }  # fmt: skip


def assert_same(tree, other):
    for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)

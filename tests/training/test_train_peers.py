"""Trainings of DCP, FMR and RGM: by their configs, and what their pairs and schedules are."""

from __future__ import annotations

import dataclasses
import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import training_samples

from cfr_jax.data.augmentation.pairs_on_device import Shapes, draw_pairs
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.sources import ShapeSource
from cfr_jax.geometry import rigid
from cfr_jax.training import learner, loop
from cfr_jax.training.config import Phase, checked
from cfr_jax.training.optimizers import keep_running, make_optimizer, make_schedule
from cfr_jax.weights.files import read_weights

CONFIGS = Path(__file__).parents[2] / "configs"


def config_of(name, *chosen):
    return runpy.run_path(str(CONFIGS / f"{name}.py"))["get_config"](*chosen)


@pytest.mark.parametrize(
    "name, chosen",
    [("dcp", "v1"), ("dcp", "v2"), ("fmr", "unsupervised"), ("fmr", "supervised"), ("rgm", "128")],
)
def test_a_config_is_of_samples_of_their_own_or_of_copied_points(name, chosen):
    for more, copied in (("", False), (",copied", True)):
        config = checked(config_of(name, chosen + more))
        sampling = config.sampling_of(config.phases[0], 0.3)
        chosen_learner = learner.learner(config)

        assert sampling.copied is copied
        assert config.train.pairs_at_once == config.phases[0].batch
        assert chosen_learner.objective is not None
    made = jax.eval_shape(chosen_learner.fresh, jax.random.key(0))
    if name == "dcp":
        assert ("pointer" in made) is (chosen == "v2")
    if name == "rgm":
        assert made["edges"]["point"]["norm"]["scale"].shape == (128,)


def test_it_trains_where_pairs_are_drawn_on_the_device(tmp_path):
    # given the published config, made small
    corpus = training_samples.write_corpus(tmp_path / "corpus.h5")
    config = config_of("dcp", "v1")
    config.width = 8
    config.data.train = config.data.validation = str(corpus)
    config.phases = (Phase(steps=4, points=24, neighbors=6, batch=2),)
    config.train = dataclasses.replace(
        config.train, draw="device", steps_at_once=2, pairs_at_once=2
    )
    config.log_every = config.validate_every = 4
    config.validation_pairs = 2

    # when
    with jax.numpy_dtype_promotion("standard"):  # optax mixes
        best = loop.run(config, tmp_path / "run")

    # then
    held = read_weights(tmp_path / "run" / "weights.safetensors")
    assert best["step"] == 4 and held.network == "dcp" and "pointer" not in held.params
    norm = held.params["embedding"]["edge_0"]["norm"]
    # the variance of points in the unit sphere, away from where it started
    assert np.all(np.abs(norm["running_variance"] - 1) > 0.1)
    assert np.all(norm["running_variance"] > 0)


def test_a_rate_falls_at_its_shares_of_however_many_steps():
    schedule = make_schedule("stairs", peak_rate=1.0, steps=10, warmup=0.0, drops=(0.3, 0.6))

    found = [float(schedule(step)) for step in range(10)]
    longer = [float(schedule.at(step, 20)) for step in (5, 6, 11, 12)]

    np.testing.assert_allclose(found, [1] * 3 + [0.1] * 3 + [0.01] * 4, rtol=1e-5)
    np.testing.assert_allclose(longer, [1, 0.1, 0.1, 0.01], rtol=1e-5)
    with pytest.raises(ValueError, match="schedule: got drops"):
        make_schedule("stairs", peak_rate=1.0, steps=10, warmup=0.0, drops=(1.5,))


def test_running_statistics_move_by_their_own_rate_and_by_no_decay():
    params = {"norm": {"scale": jnp.ones(2), "running_mean": jnp.full(2, 3.0)}}
    schedule = make_schedule("stairs", peak_rate=1e-3, steps=10, warmup=0.0)
    optimizer = keep_running(make_optimizer("adam", schedule, clip=1e6, weight_decay=0.5))
    gradient = jax.tree.map(jnp.ones_like, params)

    with jax.numpy_dtype_promotion("standard"):
        updates, _ = optimizer.update(gradient, optimizer.init(params), params)

    np.testing.assert_allclose(updates["norm"]["running_mean"], -0.1, rtol=1e-6)
    np.testing.assert_allclose(updates["norm"]["scale"], -1e-3, rtol=1e-4)


# --- copied points ---

EXACT = {"noise": (0.0, 0.0), "neighbors": 4, "copied": True}


def drawn(corpus, sampling, where):
    """Pairs of the first shape."""
    if where == "host":
        source = ShapeSource(corpus)
        return [source.draw(0, sampling, np.random.default_rng(seed)) for seed in range(3)]
    with jax.numpy_dtype_promotion("standard"):
        rows = jnp.zeros(3, jnp.int32), jnp.arange(3, dtype=jnp.uint32)
        shapes = jax.device_put(Shapes.of(corpus))
        batch = jax.jit(draw_pairs, static_argnums=4)(shapes, jnp.uint32(0), *rows, sampling)
    return [jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), batch) for i in range(3)]


@pytest.mark.parametrize("where, keep", [("host", 1.0), ("host", 0.7), ("device", 1.0)])
def test_copied_points_lie_on_each_other_under_the_truth(tmp_path, where, keep):
    corpus = read_corpus(training_samples.write_corpus(tmp_path / "corpus.h5"))
    sampling = Sampling(points=200, keep=(keep, keep), **EXACT)

    for pair in drawn(corpus, sampling, where):
        there = rigid.apply(jnp.asarray(pair["transform"]), jnp.asarray(pair["source"]))
        apart = np.linalg.norm(np.asarray(there)[:, None] - pair["target"], axis=-1).min(axis=1)
        same = apart < 1e-4
        assert len(pair["source"]) == 200
        if keep == 1:
            assert same.all()
            # each cloud is shuffled by itself
            assert np.abs(there - pair["target"]).max() > 0.1
        else:
            # two half-spaces that keep 0.7 share at least 0.4 of the whole
            assert 0.4 / 0.7 - 0.02 <= same.mean() < 1


def test_otherwise_each_cloud_has_points_of_its_own(tmp_path):
    corpus = read_corpus(training_samples.write_corpus(tmp_path / "corpus.h5"))
    sampling = Sampling(points=200, keep=(1.0, 1.0), **EXACT | {"copied": False})

    for pair in drawn(corpus, sampling, "host"):
        there = rigid.apply(jnp.asarray(pair["transform"]), jnp.asarray(pair["source"]))
        apart = np.linalg.norm(np.asarray(there)[:, None] - pair["target"], axis=-1).min(axis=1)
        assert np.mean(apart < 1e-4) < 0.5  # 200 of 1,100 points, drawn twice

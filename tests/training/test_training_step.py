"""The training step: it learns, skips what is not finite, and keeps geometry in float32."""

import functools
import re

import jax
import numpy as np
import pytest
import training_samples as samples
from jax.extend.core import jaxprs_in_params
from training_samples import BATCH, NEIGHBORS, POINTS, assert_same, fresh, recipe

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.loader import batch_at
from cfr_jax.data.sources import ShapeSource
from cfr_jax.networks.cfr import iterations
from cfr_jax.networks.cfr import modules as network
from cfr_jax.training import devices
from cfr_jax.training.step import predict, train_step


@pytest.fixture(autouse=True)
def promotion_as_optax_needs_it():
    """Its schedules and moments mix integers with floats."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    path = samples.write_corpus(tmp_path_factory.mktemp("corpus") / "ellipsoids.h5")
    sampling = Sampling(points=POINTS, neighbors=NEIGHBORS, estimated_normals=0.5)
    return batch_at(ShapeSource(read_corpus(path)), 0, BATCH, sampling, seed=0)


def step(state, batch, **changes):
    return train_step(state, devices.spread(batch, devices.make_mesh()), recipe=recipe(**changes))


def test_the_loss_of_a_batch_falls(batch):
    state, losses = fresh(), []

    for _ in range(16):
        state, measured = step(state, batch)
        assert measured.total.shape == (BATCH,) and measured.alpha.shape == (BATCH, 1)
        losses.append(float(measured.total.mean()))

    assert losses[-1] < 0.7 * losses[0]
    assert int(state.step) == 16 and int(state.skipped) == 0


def test_a_batch_that_is_not_finite_changes_nothing_but_the_counts(batch):
    before, _ = step(fresh(), batch)
    kept = jax.tree.map(np.array, before)
    broken = batch | {"source": np.where(np.arange(3) == 1, np.nan, batch["source"])}
    broken["source"] = broken["source"].astype(np.float32)

    after, _ = step(before, broken)

    assert_same(after.params, kept.params)
    assert_same(after.average, kept.average)
    assert_same(after.optimizer, kept.optimizer)
    assert int(after.skipped) == int(after.skipped_in_row) == 1
    assert int(after.step) == int(kept.step) + 1
    after, _ = step(after, broken)
    assert int(after.skipped) == int(after.skipped_in_row) == 2
    after, _ = step(after, batch)
    assert int(after.skipped) == 2 and int(after.skipped_in_row) == 0


def test_after_too_many_of_them_in_a_row_nothing_changes_until_somebody_looks(batch):
    broken = batch | {"source": np.full_like(batch["source"], np.nan)}
    state = fresh()
    for _ in range(samples.MAX_SKIPPED):
        state, _ = step(state, broken)
    state, _ = step(state, batch)
    assert int(state.skipped_in_row) == 0  # as many as allowed
    kept = jax.tree.map(np.array, state.params)

    for _ in range(samples.MAX_SKIPPED + 1):
        state, _ = step(state, broken)
    state, _ = step(state, batch)

    assert_same(state.params, kept)
    assert int(state.skipped_in_row) == samples.MAX_SKIPPED + 2


def test_the_pose_alone_can_be_trained_on(batch):
    advance = functools.partial(train_step.__wrapped__, recipe=recipe(correspondence_weight=0.0))

    _, measured = jax.eval_shape(advance, fresh(), batch)

    assert measured.correspondence.shape == measured.total.shape == (BATCH,)


def test_pairs_one_by_one_or_together_make_the_same_step(batch):
    alone, first_losses = step(fresh(), batch)
    together, losses = step(fresh(), batch, pairs_at_once=BATCH)

    # Adam's first step is the sign of the gradient where it is not tiny: hold the moments instead
    first, second = (
        jax.tree.leaves(state.optimizer)[: len(jax.tree.leaves(state.params)) + 1]
        for state in (alone, together)
    )
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(first_losses.total, losses.total, rtol=1e-4)


def test_the_average_follows_the_parameters(batch):
    start = jax.tree.map(np.array, fresh().params)
    state, _ = step(fresh(), batch)

    kernel = [tree["features"]["kernel_1"] for tree in (start, state.params, state.average)]
    decay = 0.1  # (1 + step) / (10 + step) at step 0, as long as it is below the 0.9 asked for
    wanted = decay * kernel[0] + (1 - decay) * kernel[1]
    np.testing.assert_allclose(kernel[2], wanted, atol=1e-6)


def test_prediction_answers_pair_after_pair(batch):
    params = network.init_params(jax.random.key(0), 1)
    predicted = functools.partial(
        predict,
        params,
        unroll=iterations.unroll,
        settings=samples.SETTINGS,
        mesh=devices.make_mesh(),
    )

    found = predicted(batch)

    assert found.shape == (BATCH, 1, 4, 4)
    backwards = jax.tree.map(lambda leaf: leaf[::-1], batch)
    np.testing.assert_allclose(predicted(backwards)[::-1], found, atol=1e-6)


# The rooms whose products are those of the MLPs; all others are geometry, affinities, transport.
MLPS = {"extraction", "layers.py", "pooling.py", "cfr", "linear.py"}


def products(jaxpr):
    """Each matrix product in a program and what it calls: the room that asked for it, and how
    precise."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            frames = equation.source_info.traceback.frames
            # what a GPU multiplies in halves is not rounded: test_sinkhorn
            if "by_halves" in {frame.function_name for frame in frames}:
                continue
            files = [frame.file_name for frame in frames]
            here = next(file for file in files if "/cfr_jax/" in file or "/flax/linen/" in file)
            room = (
                re.split("/cfr_jax/|/flax/linen/", here)[-1].removeprefix("networks/").split("/")[0]
            )
            yield room, equation.params["precision"]
        for inner in jaxprs_in_params(equation.params):
            yield from products(inner)


def test_only_the_products_of_the_mlps_are_less_precise(batch):
    def traced(precision):
        advance = functools.partial(train_step.__wrapped__, recipe=recipe(precision=precision))
        return list(products(jax.make_jaxpr(advance)(fresh(), batch).jaxpr))

    highest, high = (
        (precision,) * 2 for precision in (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGH)
    )
    assert {precision for _, precision in traced("float32")} == {highest}
    mixed = traced("tensorfloat32")
    assert {room for room, _ in mixed} & MLPS and {room for room, _ in mixed} - MLPS
    # what becomes a variance there stays at full precision
    less = {room for room, precision in mixed if precision == high}
    assert less == {room for room, _ in mixed} & MLPS
    assert all(precision in (high, highest) for _, precision in mixed)
    assert traced("bfloat16") == mixed  # its activations are settings of the network

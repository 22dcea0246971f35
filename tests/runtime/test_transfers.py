"""Nothing is transferred between host and device without being asked for."""

import contextlib
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import training_samples as samples
from oracle import clouds

from cfr_jax.alignment.solving import DeviceCloud, solve_pair
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.loader import batch_at
from cfr_jax.data.sources import ShapeSource
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks.cfr.registration import Settings, encode, register
from cfr_jax.refine import find
from cfr_jax.training import devices
from cfr_jax.training.step import train_step

SMALL = Settings(neighbors=8)
FETCHING = [(np, "asarray"), (np, "array"), (jax, "device_get")]


class HiddenTransferError(Exception):
    """More than a flag was fetched."""


@contextlib.contextmanager
def no_transfers():
    """Refuses implicit transfers to the device, and fetches of arrays with more than one number.

    JAX's own guard does the second only if host and device have separate memories.
    """

    def refusing(fetch):
        def guarded(value, *args, **kwargs):
            for leaf in jax.tree.leaves(value):
                if isinstance(leaf, jax.Array) and leaf.size > 1:
                    raise HiddenTransferError(f"{leaf.shape}")
            return fetch(value, *args, **kwargs)

        return guarded

    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.transfer_guard("disallow"))
        for module, name in FETCHING:
            fetch = refusing(getattr(module, name))
            stack.enter_context(mock.patch.object(module, name, fetch))
        yield


def on_device(pair):
    sides = ((pair.x, pair.nx), (pair.y, pair.ny))
    return [jax.device_put(np.concatenate(side, axis=1)) for side in sides]


@pytest.fixture
def pair():
    return on_device(clouds.random_pair(0, 40, 44))


def test_what_the_guard_refuses(pair):
    host = np.ones((4, 3), np.float32)
    double = jax.jit(lambda x: 2 * x)
    with no_transfers():
        assert jax.device_get(double(pair[0]).sum()).shape == ()
        for fetch in (np.asarray, np.array, jax.device_get):
            with pytest.raises(HiddenTransferError):
                fetch(pair[0])
        with pytest.raises(Exception, match="Disallowed host-to-device"):
            double(host)


@pytest.mark.parametrize("call", [1, 2], ids=["compiled in the call", "compiled before"])
def test_registering_clouds_on_the_device_transfers_nothing(params, pair, call):
    for _ in range(call - 1):
        register(params, *pair, settings=SMALL)

    with no_transfers():
        found = register(params, *pair, settings=SMALL)
        encoded = encode(params, pair[1], settings=SMALL)

    assert np.isfinite(found.transforms).all() and np.isfinite(encoded.features).all()


def test_points_that_are_not_finite_are_still_refused_by_row(params, pair):
    broken = pair[1].at[jnp.array([5, 7]), 2].set(jnp.inf)

    with pytest.raises(ValueError, match="target: row 5 is not finite, and 1 more"):
        register(params, pair[0], broken, settings=SMALL)
    with pytest.raises(ValueError, match="target: row 5 is not finite, and 1 more"):
        jax.jit(lambda source: register(params, source, broken, settings=SMALL))(pair[0])


def test_solving_on_the_device_transfers_nothing(params, pair):
    sides = [
        DeviceCloud(
            cloud[:, :3],
            jax.device_put(nearest_on_host(np.asarray(cloud[:, :3]), 8)),
            jax.device_put(np.ones(len(cloud), bool)),
        )
        for cloud in pair
    ]

    with no_transfers():
        found = solve_pair(params, *sides, refine=find(True))

    assert np.isfinite(found.transform).all()


def test_a_training_step_transfers_nothing(tmp_path):
    path = samples.write_corpus(tmp_path / "ellipsoids.h5")
    sampling = Sampling(points=samples.POINTS, neighbors=samples.NEIGHBORS)
    batch = batch_at(ShapeSource(read_corpus(path)), 0, samples.BATCH, sampling, seed=0)
    batch = devices.spread(batch, devices.make_mesh())
    with jax.numpy_dtype_promotion("standard"):
        # a callback, as of `jax.debug`, would fetch without the guard's notice
        program = train_step.lower(samples.fresh(), batch, recipe=samples.recipe()).as_text()
        assert "stablehlo" in program and "callback" not in program
        state, _ = train_step(samples.fresh(), batch, recipe=samples.recipe())

        with no_transfers():
            state, measured = train_step(state, batch, recipe=samples.recipe())

    assert int(state.step) == 2 and np.isfinite(measured.total).all()

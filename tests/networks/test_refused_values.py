"""What `register` refuses or does not believe: values, places and sizes it cannot work with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import solids

from cfr_jax.networks.cfr.registration import encode, register
from cfr_jax.networks.clues import root_mean_square
from cfr_jax.weights.files import load_params

pytestmark = pytest.mark.usefixtures("unchecked")  # numpy, too, is taken
CLOUD = solids.lopsided(128, 0).points
CLOUD = ((CLOUD - CLOUD.mean(axis=0)) / 0.75).astype(np.float32)
OTHER = solids.move(solids.motion(20, translation=(0, 0, 0)), CLOUD).astype(np.float32)
BAD = {
    "beyond float32": (1e300 * CLOUD.astype(np.float64), "reaches"),
    "whose squares leave float32": (1e25 * CLOUD, "reaches"),
    "far from the origin": (1e-2 * CLOUD + 1e3, "times its extent from the origin"),
    "masked": (np.ma.masked_greater(CLOUD, 0.5), "masked values"),
}


@pytest.fixture(scope="module")
def shipped():
    return load_params()


@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize("bad", BAD)
def test_what_float32_cannot_work_with_is_refused_by_name(shipped, bad, name):
    clouds = {"source": CLOUD, "target": OTHER} | {name: BAD[bad][0]}

    with pytest.raises(ValueError, match=f"^{name}: .*{BAD[bad][1]}"):
        register(shipped, **clouds)


@pytest.mark.parametrize("bad", ["whose squares leave float32", "far from the origin"])
def test_it_is_refused_on_the_device_too(shipped, bad):
    with pytest.raises(ValueError, match=f"^target: .*{BAD[bad][1]}"):
        encode(shipped, jnp.asarray(BAD[bad][0]))


@pytest.mark.parametrize("scale", [1e-3, 1e-2, 5e-2, 5.0, 100.0])
def test_clouds_of_another_size_are_not_believed(shipped, scale):
    believed = register(shipped, CLOUD, OTHER).confidence

    eager = register(shipped, scale * CLOUD, scale * OTHER).confidence
    traced = jax.jit(lambda x, y: register(shipped, x, y).confidence)(scale * CLOUD, scale * OTHER)

    assert believed > 0.5 > eager
    np.testing.assert_allclose(traced, eager, atol=1e-4)


def test_the_size_is_the_spread_of_the_valid_points():
    mask = np.arange(128) < 100

    found = root_mean_square(jnp.asarray(CLOUD), jnp.asarray(mask))

    wanted = np.sqrt(CLOUD[mask].astype(np.float64).var(axis=0).sum())
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_points_in_one_place_have_a_finite_slope():
    slope = jax.grad(lambda points: root_mean_square(points))(jnp.ones((9, 3)))

    assert np.isfinite(slope).all()


def test_bfloat16_is_taken_and_computed_in_float32(shipped):
    coarse = [jnp.asarray(cloud, jnp.bfloat16) for cloud in (CLOUD, OTHER)]

    found = register(shipped, *coarse)

    wanted = register(shipped, *(cloud.astype(jnp.float32) for cloud in coarse))
    assert found.transform.dtype == jnp.float32
    np.testing.assert_array_equal(found.transform, wanted.transform)

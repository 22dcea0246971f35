"""RPM-Net against its float64 reference, with random weights under the authors' names."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import authors, clouds
from oracle import rpmnet as oracle

from cfr_jax.networks import rpmnet
from cfr_jax.networks.cfr.registration import Cloud
from cfr_jax.weights.conversion import from_state_dict


@pytest.mark.parametrize("optimized", [True, False])
def test_it_answers_as_the_reference_in_both_forms(optimized):
    state = authors.random_rpmnet_state_dict(0)
    pair = clouds.random_pair(3, 60, 55)
    wanted = oracle.register(
        state, pair.x, pair.y, pair.nx, pair.ny, iterations=2, neighbors=20, drop_self=True
    )
    source, target = (
        Cloud(jnp.float32(points), jnp.float32(normals), jnp.zeros((len(points), 1), jnp.int32))
        for points, normals in ((pair.x, pair.nx), (pair.y, pair.ny))
    )

    settings = rpmnet.RPMNetSettings(neighbors=20, iterations=2, optimized=optimized)
    steps = rpmnet.unroll(from_state_dict(state), source, target, settings)
    found = np.stack([step.transform for step in steps])

    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_fresh_parameters_have_the_shapes_of_the_authors():
    fresh = jax.eval_shape(lambda: rpmnet.init_params(jax.random.key(0)))
    theirs = from_state_dict(authors.random_rpmnet_state_dict(0))

    assert jax.tree.map(jnp.shape, theirs) == jax.tree.map(lambda leaf: leaf.shape, fresh)

"""RPM-Net against its float64 reference, with random weights under the authors' names."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import unflatten_dict
from oracle import authors, clouds
from oracle import rpmnet as oracle

from cfr_jax import rpmnet
from cfr_jax.registration import Cloud

# our name of each Linear, the authors', and whether a GroupNorm follows (as the next module)
_LAYERS = (
    [(f"annealing/point_{i}", f"weights_net.prepool.{3 * i}") for i in range(5)]
    + [(f"annealing/pair_{i}", f"weights_net.postpool.{3 * i}") for i in range(2)]
    + [(f"features/neighbor_{i}", f"feat_extractor.prepool.{3 * i}") for i in range(3)]
    + [(f"features/point_{i}", f"feat_extractor.postpool.{3 * i}") for i in range(2)]
)
_LAST = {"annealing/out": "weights_net.postpool.6", "features/out": "feat_extractor.postpool.6"}


def parameters(state):
    found = {}

    def linear(ours, theirs):
        weight = state[f"{theirs}.weight"]
        found[f"{ours}/kernel"] = weight.reshape(weight.shape[:2]).T
        found[f"{ours}/bias"] = state[f"{theirs}.bias"]

    for ours, theirs in _LAYERS:
        linear(f"{ours}_dense", theirs)
        stem, number = theirs.rsplit(".", 1)
        norm = f"{stem}.{int(number) + 1}"
        found[f"{ours}_scale"], found[f"{ours}_shift"] = (
            state[f"{norm}.weight"],
            state[f"{norm}.bias"],
        )
    for ours, theirs in _LAST.items():
        linear(ours, theirs)
    return jax.tree.map(jnp.asarray, unflatten_dict(found, sep="/"))


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

    settings = rpmnet.Settings(neighbors=20, iterations=2, optimized=optimized)
    steps = rpmnet.unroll(parameters(state), source, target, settings)
    found = np.stack([step.transform for step in steps])

    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_fresh_parameters_have_the_shapes_of_the_authors():
    fresh = jax.eval_shape(lambda: rpmnet.init_params(jax.random.key(0)))
    theirs = parameters(authors.random_rpmnet_state_dict(0))

    assert jax.tree.map(jnp.shape, theirs) == jax.tree.map(lambda leaf: leaf.shape, fresh)

"""Raw channels against the reference, and their gradients where a norm or an angle has none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces

from cfr_jax.networks.features import raw_features

features = jax.jit(raw_features, static_argnames="ppf")


def cloud(seed=0, n=12):
    rng = np.random.default_rng(seed)
    points, normals = rng.normal(size=(2, n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    neighbors = pieces.nearest_neighbors(points, 4)
    return points, normals, neighbors.astype(np.int32)


@pytest.mark.parametrize(("ppf", "wanted"), [("dot", "inner_product"), ("angle", "angle")])
def test_offsets_come_before_the_point_pair_feature(ppf, wanted):
    points, normals, neighbors = cloud()

    found = features(*(jnp.asarray(a.astype(a.dtype.char.replace("d", "f"))) for a in cloud()),
                     ppf=ppf)  # fmt: skip

    offsets = points[neighbors] - points[:, None]
    pair = getattr(pieces, f"{wanted}_ppf")(normals, offsets, normals[neighbors])
    np.testing.assert_allclose(found, np.concatenate([offsets, pair], axis=-1), atol=2e-6)


@pytest.mark.parametrize("ppf", ["dot", "angle"])
def test_a_duplicate_of_a_point_lies_nowhere_from_it(ppf):
    points, normals, neighbors = (jnp.asarray(a) for a in cloud())

    found = features(jnp.tile(points[:1], (12, 1)), normals, neighbors, ppf=ppf)

    there = [0, 1, 2, 3, 4, 6]  # the offset, its directions to both normals, its length
    assert not found[..., jnp.array(there)].any() and found[..., 5].all()


@pytest.mark.parametrize("ppf", ["dot", "angle"])
def test_gradients_are_their_finite_differences(x64, ppf):
    points, normals, neighbors = (jnp.asarray(a) for a in cloud(1))
    rng = np.random.default_rng(2)
    change = jnp.asarray(rng.normal(size=points.shape)), jnp.asarray(rng.normal(size=points.shape))
    step = 1e-6

    def at(distance):
        return raw_features(
            points + distance * change[0], normals + distance * change[1], neighbors, ppf=ppf
        )

    _, derivative = jax.jvp(jax.jit(at), (0.0,), (1.0,))

    np.testing.assert_allclose(derivative, (at(step) - at(-step)) / (2 * step), atol=1e-7)


@pytest.mark.parametrize("ppf", ["dot", "angle"])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e6])
@pytest.mark.parametrize("normal", [(0, 0, 0), (1, 0, 0)])
def test_gradients_are_finite_for_duplicates_and_parallel_or_missing_normals(ppf, scale, normal):
    points, _, neighbors = cloud(3)
    points[1] = points[2] = points[0]
    points = jnp.asarray(points * scale, jnp.float32)
    normals = jnp.tile(jnp.array(normal, jnp.float32), (len(points), 1))

    def total(points, normals):
        return jnp.sum(features(points, normals, jnp.asarray(neighbors), ppf=ppf))

    for gradient in jax.grad(total, (0, 1))(points, normals):
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize("name", ["cosine", "none"])
def test_an_unknown_point_pair_feature_is_refused(unchecked, name):
    points, normals, neighbors = (jnp.asarray(a) for a in cloud())

    with pytest.raises(ValueError, match=f"^ppf: got '{name}'"):
        raw_features(points, normals, neighbors, ppf=name)


def test_with_position_a_points_own_coordinates_come_first():
    points, normals, neighbors = (jnp.asarray(a) for a in cloud(4))

    found = raw_features(points, normals, neighbors, position=True)

    assert found.shape == (12, 4, 10)
    np.testing.assert_array_equal(found[..., :3], jnp.broadcast_to(points[:, None], (12, 4, 3)))
    np.testing.assert_array_equal(found[..., 3:], raw_features(points, normals, neighbors))

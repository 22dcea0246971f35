"""Both searches give the sets of the plain one, ties and duplicates included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import cfr, pieces
from scipy.spatial import cKDTree

from cfr_jax.geometry import neighbors
from cfr_jax.geometry.neighbors import closest, nearest, nearest_on_host

on_device = jax.jit(nearest, static_argnames=("k", "radius"))


def lattice(rng):
    """All distances are exact, and nearly all are tied."""
    return rng.permutation(np.stack(np.meshgrid(*[np.arange(5)] * 3), -1).reshape(-1, 3)) / 8


CLOUDS = {
    "random": lambda rng: rng.normal(size=(125, 3)),
    "lattice": lattice,
    "duplicates": lambda rng: np.repeat(rng.normal(size=(25, 3)), 5, axis=0)[rng.permutation(125)],
    "one point": lambda rng: np.full((125, 3), 0.25),
    "far away": lambda rng: 1000 + np.round(rng.normal(size=(125, 3)), 2),
}


@pytest.fixture(params=["all pairs", "tree"])
def on_host(request, monkeypatch):
    """The host's search, for small clouds and for large ones."""
    monkeypatch.setattr(neighbors, "_FEW", 10**9 if request.param == "all pairs" else 0)
    monkeypatch.setattr(neighbors, "_TREE_ROWS", 50)  # three chunks
    return nearest_on_host


def sets(rows):
    return np.sort(np.asarray(rows), axis=1)


@pytest.mark.parametrize("k", [1, 12, 124])
@pytest.mark.parametrize("name", CLOUDS)
def test_device_and_host_find_the_sets_of_the_plain_search(name, k, on_host):
    points = CLOUDS[name](np.random.default_rng(0)).astype(np.float32)

    device, host = on_device(jnp.asarray(points), k), on_host(points, k)

    wanted = sets(pieces.nearest_neighbors(points, k))
    np.testing.assert_array_equal(sets(device), wanted)
    np.testing.assert_array_equal(sets(host), wanted)


@pytest.mark.parametrize("name", ["random", "lattice", "duplicates"])
def test_neighbors_beyond_the_radius_become_the_nearest(name, on_host):
    points = CLOUDS[name](np.random.default_rng(1)).astype(np.float32)
    points[7] += 4  # all alone: its nearest stays

    device = on_device(jnp.asarray(points), 20, radius=0.3)
    host = on_host(points, 20, radius=0.3)

    wanted = sets(cfr.find_neighbors(points, 20, 0.3))
    assert len(set(wanted[7])) == 1 and (wanted != sets(pieces.nearest_neighbors(points, 20))).any()
    np.testing.assert_array_equal(sets(device), wanted)
    np.testing.assert_array_equal(sets(host), wanted)


def test_blocks_of_rows_join_without_a_seam():
    points = np.random.default_rng(2).normal(size=(700, 3)).astype(np.float32)  # 7 blocks and a bit

    np.testing.assert_array_equal(
        sets(on_device(jnp.asarray(points), 5)), sets(pieces.nearest_neighbors(points, 5))
    )


def test_masked_points_are_nobodys_neighbor():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(125, 3)).astype(np.float32)
    mask = rng.random(125) < 0.6

    found = on_device(jnp.asarray(points), 12, mask=jnp.asarray(mask))

    valid = np.flatnonzero(mask)
    wanted = valid[pieces.nearest_neighbors(points[mask], 12)]
    np.testing.assert_array_equal(sets(found)[mask], sets(wanted))


def test_too_few_valid_points_repeat_their_nearest():
    points = np.random.default_rng(4).normal(size=(125, 3)).astype(np.float32)
    mask = np.arange(125) < 4

    found = np.asarray(on_device(jnp.asarray(points), 12, mask=jnp.asarray(mask)))

    first = pieces.nearest_neighbors(points[:4], 1)[:, 0]
    for row in range(4):
        others = sorted({0, 1, 2, 3} - {row})
        assert sorted(set(found[row])) == others
        assert (np.sort(found[row]) == np.sort([*others, *[first[row]] * 9])).all()


def test_half_a_batch_is_searched_like_the_whole():
    clouds = np.random.default_rng(5).normal(size=(2, 125, 3)).astype(np.float32)

    together = jax.jit(jax.vmap(lambda cloud: nearest(cloud, 12)))(jnp.asarray(clouds))

    for found, points in zip(together, clouds, strict=True):
        np.testing.assert_array_equal(sets(found), sets(pieces.nearest_neighbors(points, 12)))


@pytest.mark.parametrize("k", [0, 5])
def test_an_impossible_k_is_refused(k):
    points = np.zeros((5, 3), np.float32)

    with pytest.raises(ValueError, match=rf"^k: got {k} neighbors for a cloud of 5 points"):
        nearest(jnp.asarray(points), k)
    with pytest.raises(ValueError, match=rf"^k: got {k} neighbors for a cloud of 5 points"):
        nearest_on_host(points, k)


@pytest.mark.parametrize("masked", [False, True])
def test_the_closest_point_is_that_of_a_search_through_all(masked):
    rng = np.random.default_rng(6)
    queries, points = (rng.normal(size=(n, 3)).astype(np.float32) for n in (1100, 1000))
    mask = rng.random(1000) < 0.5 if masked else np.ones(1000, bool)

    found = jax.jit(closest)(
        jnp.asarray(queries), jnp.asarray(points), jnp.asarray(mask) if masked else None
    )

    distance, index = cKDTree(points[mask]).query(queries)
    np.testing.assert_array_equal(found.index, np.flatnonzero(mask)[index])
    np.testing.assert_allclose(found.square, distance**2, rtol=1e-5)

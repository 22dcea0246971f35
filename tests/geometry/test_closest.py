"""The closest point is the one that an exhaustive search finds, on CPUs and on accelerators."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from cfr_jax.geometry import closest as module
from cfr_jax.geometry.closest import closest

SEARCHES = {
    "product": jax.jit(module._closest_by_product),
    "differences": jax.jit(module._closest_by_differences),
}


def clouds(n=1100, m=1000):
    rng = np.random.default_rng(6)
    queries, points = (rng.normal(size=(size, 3)).astype(np.float32) for size in (n, m))
    return queries, points, rng.random(m) < 0.5


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("search", SEARCHES)
def test_the_closest_point_is_the_one_a_tree_finds(search, masked):
    queries, points, mask = clouds()
    mask = mask if masked else np.ones_like(mask)

    found = SEARCHES[search](*map(jnp.asarray, (queries, points, mask)))

    np.testing.assert_array_equal(
        found, np.flatnonzero(mask)[cKDTree(points[mask]).query(queries)[1]]
    )


@pytest.mark.parametrize("search", SEARCHES)
def test_among_equally_close_points_the_first_is_chosen(search):
    queries, points, _ = clouds(20, 10)

    found = SEARCHES[search](jnp.asarray(queries), jnp.asarray(np.tile(points, (3, 1))), None)

    np.testing.assert_array_equal(found, cKDTree(points).query(queries)[1])


@pytest.mark.parametrize("search", SEARCHES)
def test_if_no_point_is_valid_some_index_is_still_returned(search):
    queries, points, mask = clouds(20, 10)

    found = SEARCHES[search](*map(jnp.asarray, (queries, points, np.zeros_like(mask))))

    assert ((found >= 0) & (found < 10)).all()


@pytest.mark.parametrize("search", SEARCHES)
def test_a_query_that_is_not_a_number_still_gets_an_index(search):
    queries, points, mask = clouds(20, 10)

    found = SEARCHES[search](*map(jnp.asarray, (queries * np.nan, points, mask)))

    assert ((found >= 0) & (found < 10)).all()


def test_the_distance_is_right_and_so_is_its_gradient():
    queries, points, _ = (jnp.asarray(part) for part in clouds())

    found = jax.jit(closest)(queries, points)
    slope = jax.jit(jax.grad(lambda q: jnp.sum(closest(q, points).square)))(queries)

    distance, index = cKDTree(points).query(queries)
    np.testing.assert_array_equal(found.index, index)
    np.testing.assert_allclose(found.square, distance**2, rtol=1e-5)
    np.testing.assert_allclose(slope, 2 * (queries - points[index]), atol=1e-6)


def test_an_accelerator_needs_no_loop():
    shapes = [jax.ShapeDtypeStruct((n, 3), jnp.float32) for n in (4000, 5000)]
    program = jax.jit(closest).trace(*shapes)

    for platform in ("cuda", "rocm", "tpu", "cpu"):
        text = program.lower(lowering_platforms=(platform,)).as_text()
        assert ("stablehlo.while" in text) == (platform == "cpu")


def test_on_a_cpu_memory_does_not_grow_with_the_product_of_the_sizes():
    shapes = [jax.ShapeDtypeStruct((n, 3), jnp.float32) for n in (20_000, 5000)]

    compiled = jax.jit(closest).lower(*shapes).compile()

    ranks = 4 * 20_000 * 5000
    assert compiled.memory_analysis().temp_size_in_bytes < ranks / 20

"""Trees on the host against a search through all distances, with small_gicp and without."""

import sys

import numpy as np
import pytest

from cfr_jax.geometry.trees import Tree, cores


@pytest.fixture(params=["small_gicp", "SciPy"])
def library(request, monkeypatch):
    if request.param == "SciPy":
        monkeypatch.setitem(sys.modules, "small_gicp", None)
    else:
        pytest.importorskip("small_gicp")


def draw(count, seed):
    return np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize("k", [1, 2, 7])
def test_it_finds_what_a_search_through_all_distances_finds(library, k):
    points, queries = draw(500, 0), draw(300, 1)

    rows, distance = Tree(points).nearest(queries, k)

    all_of_them = np.linalg.norm(queries[:, None] - points, axis=2)
    np.testing.assert_array_equal(rows, np.argsort(all_of_them, axis=1)[:, :k])
    np.testing.assert_allclose(distance, np.sort(all_of_them, axis=1)[:, :k])


def test_the_closest_is_the_nearest_one(library):
    tree = Tree(draw(500, 0))

    rows, distance = tree.closest(tree.points[:20] + 1e-6)

    np.testing.assert_array_equal(rows, np.arange(20))
    np.testing.assert_allclose(distance, np.sqrt(3e-12), rtol=1e-6)


def test_no_query_has_no_answer(library):
    rows, distance = Tree(draw(10, 0)).closest(np.zeros((0, 3)))

    assert len(rows) == len(distance) == 0


def test_the_spacing_of_a_grid_is_its_edge(library):
    grid = 0.25 * np.stack(np.meshgrid(*[np.arange(22)] * 3), axis=-1).reshape(-1, 3)

    assert Tree(grid).spacing == pytest.approx(0.25)


def test_at_least_one_core_can_be_used():
    assert cores() >= 1

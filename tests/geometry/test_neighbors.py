"""All searches find the same sets as the plain one, including ties and duplicates."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import cfr, pieces

from cfr_jax.geometry import neighbors
from cfr_jax.geometry.neighbors import first_in_ball, nearest, nearest_on_host

# the search on CPUs, and those on accelerators: sorting all, sorting groups, in several blocks
SIZES = {"all": {"few": 200}, "groups": {"few": 8}, "blocks": {"few": 8, "entries": 5000}}


def searches(on_cpu, elsewhere):
    """Both kinds, (points, mask, k, radius) in."""
    made = {"bits": on_cpu} | {
        name: functools.partial(elsewhere, **sizes) for name, sizes in SIZES.items()
    }
    return {name: jax.jit(search, static_argnums=(2, 3)) for name, search in made.items()}


NEAREST = searches(neighbors._nearest_by_bits, neighbors._nearest_by_groups)
IN_BALL = searches(neighbors._first_by_bits, neighbors._first_by_groups)


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


@pytest.fixture(params=NEAREST)
def on_device(request):
    """The device's search, of CPUs and of accelerators."""

    def search(points, k, radius=np.inf, mask=None):
        mask = None if mask is None else jnp.asarray(mask)
        return NEAREST[request.param](jnp.asarray(points), mask, k, radius * radius)

    return search


def sets(rows):
    return np.sort(np.asarray(rows), axis=1)


@pytest.mark.parametrize("k", [1, 12, 124])
@pytest.mark.parametrize("name", CLOUDS)
def test_the_device_finds_the_sets_of_the_plain_search(name, k, on_device):
    points = CLOUDS[name](np.random.default_rng(0)).astype(np.float32)

    np.testing.assert_array_equal(
        sets(on_device(points, k)), sets(pieces.nearest_neighbors(points, k))
    )


@pytest.mark.parametrize("k", [1, 12, 124])
@pytest.mark.parametrize("name", CLOUDS)
def test_the_host_finds_the_sets_of_the_plain_search(name, k, on_host):
    points = CLOUDS[name](np.random.default_rng(0)).astype(np.float32)

    np.testing.assert_array_equal(
        sets(on_host(points, k)), sets(pieces.nearest_neighbors(points, k))
    )


def one_alone(name):
    """A cloud whose point 7 is far from all others, and its neighbors within 0.3."""
    points = CLOUDS[name](np.random.default_rng(1)).astype(np.float32)
    points[7] += 4
    wanted = sets(cfr.find_neighbors(points, 20, 0.3))
    # it keeps its nearest neighbor, and other points lose some of theirs
    assert len(set(wanted[7])) == 1 and (wanted != sets(pieces.nearest_neighbors(points, 20))).any()
    return points, wanted


@pytest.mark.parametrize("name", ["random", "lattice", "duplicates"])
def test_on_the_device_neighbors_beyond_the_radius_become_the_nearest(name, on_device):
    points, wanted = one_alone(name)

    np.testing.assert_array_equal(sets(on_device(points, 20, radius=0.3)), wanted)


@pytest.mark.parametrize("name", ["random", "lattice", "duplicates"])
def test_on_the_host_neighbors_beyond_the_radius_become_the_nearest(name, on_host):
    points, wanted = one_alone(name)

    np.testing.assert_array_equal(sets(on_host(points, 20, radius=0.3)), wanted)


def test_blocks_of_rows_join_without_a_seam(on_device):
    points = np.random.default_rng(2).normal(size=(700, 3)).astype(np.float32)  # 7 blocks and a bit

    np.testing.assert_array_equal(
        sets(on_device(points, 5)), sets(pieces.nearest_neighbors(points, 5))
    )


def test_masked_points_are_never_neighbors(on_device):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(125, 3)).astype(np.float32)
    mask = rng.random(125) < 0.6

    found = on_device(points, 12, mask=mask)

    valid = np.flatnonzero(mask)
    wanted = valid[pieces.nearest_neighbors(points[mask], 12)]
    np.testing.assert_array_equal(sets(found)[mask], sets(wanted))


def test_too_few_valid_points_repeat_their_nearest(on_device):
    points = np.random.default_rng(4).normal(size=(125, 3)).astype(np.float32)
    mask = np.arange(125) < 4

    found = np.asarray(on_device(points, 12, mask=mask))

    first = pieces.nearest_neighbors(points[:4], 1)[:, 0]
    for row in range(4):
        others = sorted({0, 1, 2, 3} - {row})
        assert sorted(set(found[row])) == others
        assert (np.sort(found[row]) == np.sort([*others, *[first[row]] * 9])).all()


def test_a_batch_is_searched_like_single_clouds():
    clouds = np.random.default_rng(5).normal(size=(2, 125, 3)).astype(np.float32)

    together = jax.jit(jax.vmap(lambda cloud: nearest(cloud, 12)))(jnp.asarray(clouds))

    for found, points in zip(together, clouds, strict=True):
        np.testing.assert_array_equal(sets(found), sets(pieces.nearest_neighbors(points, 12)))


@pytest.mark.parametrize("k", [0, 5])
def test_an_impossible_k_is_refused(k):
    points = np.zeros((5, 3), np.float32)

    told = rf"^k: got {k} neighbors for a cloud of 5 points, wanted 1 <= k <= 4$"
    with pytest.raises(ValueError, match=told):
        nearest(jnp.asarray(points), k)
    with pytest.raises(ValueError, match=told):
        nearest_on_host(points, k)


def test_a_large_cloud_on_the_host_is_searched_like_a_small_one():
    points = np.random.default_rng(8).normal(size=(1600, 3)).astype(np.float32)

    np.testing.assert_array_equal(
        sets(nearest_on_host(points, 5)), sets(pieces.nearest_neighbors(points, 5))
    )


def test_on_a_cpu_memory_grows_with_the_cloud_and_not_with_its_square():
    n = 8000
    points = jax.ShapeDtypeStruct((n, 3), jnp.float32)

    for search in (lambda x: nearest(x, 16), lambda x: first_in_ball(x, 16, 0.3)):
        compiled = jax.jit(search).lower(points).compile()
        assert compiled.memory_analysis().temp_size_in_bytes < 4 * n * n / 20


@pytest.mark.parametrize("search", IN_BALL)
@pytest.mark.parametrize("k", [1, 12, 200])
@pytest.mark.parametrize("name", CLOUDS)
def test_balls_hold_their_first_points_by_index(name, k, search):
    rng = np.random.default_rng(7)
    points, mask = CLOUDS[name](rng).astype(np.float32), rng.random(125) < 0.7
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    radius = float(np.median(distance)) / 2 + 1e-3  # not equal to a distance in the lattice

    found = IN_BALL[search](jnp.asarray(points), jnp.asarray(mask), k, radius)

    inside = (distance <= radius) & mask & ~np.eye(125, dtype=bool)
    for row, ball in enumerate(inside):
        wanted = np.flatnonzero(ball)[:k]
        np.testing.assert_array_equal(found[row], [*wanted, *[row] * (k - len(wanted))])


@pytest.mark.parametrize(("platform", "most"), [("cuda", 0), ("rocm", 0), ("tpu", 0), ("cpu", 2)])
def test_an_accelerator_searches_without_a_loop(platform, most):
    points = jax.ShapeDtypeStruct((4000, 3), jnp.float32)

    for search in (lambda x: nearest(x, 64), lambda x: first_in_ball(x, 64, 0.3)):
        batched = jax.vmap(search)
        for program, given in ((search, points), (batched, points.update(shape=(2, 4000, 3)))):
            text = jax.jit(program).trace(given).lower(lowering_platforms=(platform,)).as_text()
            loops = text.count("stablehlo.while")
            assert loops == 0 if most == 0 else 0 < loops <= most


@pytest.mark.parametrize(("n", "most"), [(500, 500), (12_000, 12_000 / 6.5)])
def test_an_accelerator_sorts_small_clouds_once_and_of_large_ones_a_seventh(n, most):
    points = jax.ShapeDtypeStruct((n, 3), jnp.float32)

    program = jax.jit(lambda x: nearest(x, 64)).trace(points)

    text = program.lower(lowering_platforms=("cuda",)).as_text()
    rows = [int(width) for width in re.findall(r"top_k.*tensor<\d+x(\d+)xf32>\)? ->", text)]
    assert len(rows) == (1 if n == 500 else 2) and sum(rows) <= most


@pytest.mark.parametrize("k", [1, 12, 30, 100])  # groups of eight, four, two, and points alone
def test_a_block_of_rows_sorts_no_more_values_than_it_may(k):
    points, entries = jax.ShapeDtypeStruct((125, 3), jnp.float32), 2500
    search = functools.partial(neighbors._nearest_by_groups, few=8, entries=entries)

    text = jax.jit(lambda x: search(x, None, k, np.inf)).trace(points).lower().as_text()

    sizes = re.findall(r"top_k.*tensor<(\d+)x(\d+)xf32>\)? ->", text)
    rows, widths = int(sizes[0][0]), [int(width) for _, width in sizes]
    assert rows < 125 and (rows - 1) * sum(widths) <= entries

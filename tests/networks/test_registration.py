"""`register` against the reference implementation, and what must not change its answer."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import authors, cfr, clouds, pieces

from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks.cfr import registration
from cfr_jax.networks.cfr.iterations import bind
from cfr_jax.networks.cfr.registration import encode, register
from cfr_jax.networks.features import raw_features
from cfr_jax.networks.inputs import Settings, moved_by, prepare
from cfr_jax.weights.conversion import from_state_dict

K = 16
SMALL = Settings(neighbors=K)


@pytest.fixture(scope="module")
def pair():
    return clouds.random_pair(0, 70, 80)


def rows(points, normals):
    return jnp.asarray(np.concatenate([points, normals], axis=1))


def both(pair):
    return rows(pair.x, pair.nx), rows(pair.y, pair.ny)


@pytest.fixture(scope="module")
def answer(params, pair):
    """Two iterations on the pair: what the invariances are held against."""
    return register(params, *both(pair), iterations=2, settings=SMALL)


def close(a, b, atol=1e-5):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=0, atol=atol)


def armchair_pair():
    """Two noisy samplings of a real shape, one of them moved."""
    rng = np.random.default_rng(0)
    with np.load(Path(__file__).parent / "armchair.npz") as file:
        points = file["points"].astype(np.float64)
        normals = file["normals"].astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    source, target = (rng.choice(len(points), 717, replace=False) for _ in range(2))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    noisy = points + rng.normal(0, 0.01, points.shape)
    moved = noisy[source] @ turn.T + rng.uniform(-0.5, 0.5, 3)
    parts = moved, noisy[target], normals[source] @ turn.T, normals[target]
    return clouds.Pair(*(part.astype(np.float32) for part in parts), np.eye(4))


@pytest.mark.parametrize("make", [lambda: clouds.random_pair(1, 717, 717), armchair_pair])
def test_published_weights_give_the_reference_transforms_at_full_size(params, state_dict, make):
    pair = make()

    found = register(params, *both(pair))

    wanted = cfr.trace(state_dict, *pair[:4])
    close(found.transforms, wanted.transforms)
    close(found.weights, wanted.weights[-1])
    close(found.covered, wanted.matches[-1].sum(axis=0))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_annealing_and_transforms_are_the_references_on_small_pairs(seed):
    state = authors.random_state_dict(seed, iterations=3)
    pair = clouds.random_pair(seed, 70, 80)

    found = register(from_state_dict(state), *both(pair), settings=SMALL)

    wanted = cfr.trace(state, *pair[:4], iterations=3, neighbors=K)
    np.testing.assert_allclose(found.beta, wanted.beta, rtol=1e-5)
    np.testing.assert_allclose(found.alpha, wanted.alpha, rtol=1e-5)
    close(found.transforms, wanted.transforms)


def test_features_are_the_references(params, state_dict, pair):
    cloud = prepare(both(pair)[1], settings=SMALL)

    raw = raw_features(cloud.points, cloud.normals, cloud.neighbors)
    heavy = bind(params).features(raw)
    light = encode(params, cloud, settings=SMALL).features

    wanted = cfr.trace(state_dict, *pair[:4], neighbors=K)
    close(raw.sum(1), cfr.raw_features(pair.y, pair.ny, wanted.target_neighbors).sum(1), 2e-5)
    close(heavy, wanted.target_descriptors, 2e-5)
    close(light, wanted.target_features)


def test_neighbors_from_the_host_give_the_same(params, pair, answer):
    source, target = (
        prepare(cloud, neighbors=nearest_on_host(np.asarray(cloud[:, :3]), K, radius=0.3))
        for cloud in both(pair)
    )

    found = register(params, source, target, iterations=2, settings=SMALL)

    close(found.transforms, answer.transforms)
    close(found.weights, answer.weights)


def test_a_target_encoded_once_gives_the_same(params, pair, answer):
    source, target = both(pair)
    reference = encode(params, target, settings=SMALL)

    found = register(params, source, reference, iterations=2, settings=SMALL)

    close(found.transforms, answer.transforms)
    close(found.covered, answer.covered)


def test_the_order_of_the_points_does_not_matter(params, pair, answer):
    rng = np.random.default_rng(0)
    source, target = both(pair)
    first, second = rng.permutation(len(source)), rng.permutation(len(target))

    found = register(params, source[first], target[second], iterations=2, settings=SMALL)

    close(found.transforms, answer.transforms)
    close(found.weights, answer.weights[first])
    close(found.targets, answer.targets[first])
    close(found.covered, answer.covered[second])


@pytest.mark.parametrize("columns", [6, 3], ids=["normals", "estimated"])
def test_padding_changes_nothing(params, pair, columns):
    source, target = (cloud[:, :columns] for cloud in both(pair))
    settings = Settings(neighbors=K)
    plain = register(params, source, target, iterations=2, settings=settings)

    def pad(cloud, length, seed):
        rng = np.random.default_rng(seed)
        where = np.sort(rng.choice(length, len(cloud), replace=False))
        junk = rng.normal(0, 100, (length, columns)).astype(np.float32)
        junk[where] = cloud
        mask = jnp.zeros(length, bool).at[where].set(True)
        return prepare(jnp.asarray(junk), mask=mask, settings=settings), where

    (source, here), (target, there) = pad(source, 90, 1), pad(target, 85, 2)
    found = register(params, source, target, iterations=2, settings=settings)

    close(found.transforms, plain.transforms)
    close(found.beta, plain.beta)
    close(found.weights[here], plain.weights)
    close(found.covered[there], plain.covered)
    assert not np.delete(found.weights, here).any()
    assert not np.delete(found.covered, there).any()


def test_a_batch_gives_each_pair_its_own_answer(params):
    pairs = [both(clouds.random_pair(seed, 70, 80)) for seed in range(3)]
    sources, targets = (jnp.stack(side) for side in zip(*pairs, strict=True))

    def one(source, target):
        return register(params, source, target, iterations=2, settings=SMALL)

    together = jax.vmap(one)(sources, targets)

    for i, (source, target) in enumerate(pairs):
        alone = one(source, target)
        close(together.transforms[i], alone.transforms)
        close(together.weights[i], alone.weights)


def test_compiled_or_not_is_the_same(params):
    source, target = both(clouds.random_pair(4, 12, 13))
    settings = Settings(neighbors=4)
    source, target = prepare(source, settings=settings), encode(params, target, settings=settings)
    compiled = register(params, source, target, iterations=1, settings=settings)

    plain = registration._register.__wrapped__(
        params, source, target, iterations=1, cascades=1, settings=settings
    )

    close(plain.transforms, compiled.transforms)
    close(plain.weights, compiled.weights)


def test_without_sight_of_positions_the_answer_follows_translations(params, pair, answer):
    # Features see directions of offsets, so turning a cloud changes them; positions enter through
    # the cascade's position kernels and the annealing network alone. With both shut, moving a cloud
    # without turning it moves the answer along; as they are, it does not quite.
    source, target = both(pair)
    shut = {
        **params,
        "cascade": params["cascade"] | {"position": jnp.zeros_like(params["cascade"]["position"])},
        "annealing": params["annealing"]
        | {"out": {**params["annealing"]["out"], "kernel": jnp.zeros((256, 10))}},
    }
    here, there = np.array([0.3, -0.2, 0.1], np.float32), np.array([-0.1, 0.4, 0.2], np.float32)
    moved = source.at[:, :3].add(here), target.at[:, :3].add(there)

    def follows(params):
        before = register(params, source, target, iterations=2, settings=SMALL).transforms
        after = register(params, *moved, iterations=2, settings=SMALL).transforms
        wanted = before.at[:, :3, 3].add(there - before[:, :3, :3] @ here)
        return float(jnp.abs(after - wanted).max())

    assert follows(shut) < 1e-5
    assert follows(params) > 1e-3


def test_fewer_iterations_are_the_first_ones(params, pair, answer):
    every = register(params, *both(pair), settings=SMALL)

    assert every.transforms.shape == (5, 4, 4)
    close(every.transforms[:2], answer.transforms, 1e-6)
    np.testing.assert_array_equal(every.transform, every.transforms[-1])


def test_iterations_beyond_the_parameters_repeat_the_last_layer():
    state = authors.random_state_dict(0, iterations=2)
    pair = clouds.random_pair(0, 70, 80)

    found = register(from_state_dict(state), *both(pair), iterations=4, settings=SMALL)

    trace = cfr.trace(state, *pair[:4], iterations=2, neighbors=K)
    close(found.transforms[:2], trace.transforms)
    moved = pieces.move(trace.transforms[1], pair.x)
    for transform in found.transforms[2:]:
        # features from layer 1, the only trained input of layer 2, at the new position
        fx = cfr.refine(state, 1, trace.source_features[0], moved)
        affinity = -trace.beta[1] * (
            cfr.squared_distances(fx, trace.target_features[1]) - trace.alpha[1]
        )
        matched, weights = cfr.soft_target(pieces.sinkhorn_log(affinity, passes=2), pair.y)
        wanted = pieces.procrustes(pair.x, matched, weights)
        close(transform, wanted)
        moved = pieces.move(wanted, pair.x)


def test_a_second_cascade_is_a_registration_from_where_the_first_ended(params, pair, answer):
    # given
    source, target = (prepare(cloud, settings=SMALL) for cloud in both(pair))
    moved = moved_by(answer.transform, source)
    again = register(params, moved, target, iterations=2, settings=SMALL)

    # when
    found = register(params, source, target, iterations=2, cascades=2, settings=SMALL)

    # then
    close(found.transforms[:2], answer.transforms)
    close(found.transforms[2:], again.transforms @ answer.transform, atol=1e-4)
    close(found.beta, jnp.concatenate([answer.beta, again.beta]), atol=1e-4)
    close(found.weights, again.weights, atol=1e-4)
    close(found.targets, again.targets, atol=1e-4)


def test_a_cloud_smaller_than_k_has_fewer_neighbors(params):
    source, target = both(clouds.random_pair(4, 20, 22))

    cloud = prepare(source)

    assert cloud.neighbors.shape == (20, 19)
    assert np.isfinite(register(params, cloud, target, iterations=1).transforms).all()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("source", {"source": jnp.zeros((70, 4))}),
        ("source", {"source": jnp.zeros((2, 3))}),
        ("target", {"target": jnp.zeros((80, 2))}),
        ("source", {"source": jnp.zeros(70)}),
        ("target", {"target": jnp.zeros((2, 80, 3))}),
        ("iterations", {"iterations": 0}),
        ("cascades", {"cascades": 0}),
        ("k", {"settings": Settings(neighbors=0)}),
    ],
)
def test_a_malformed_argument_is_refused_by_name(unchecked, params, pair, name, change):
    source, target = both(pair)
    arguments = {"source": source, "target": target, "iterations": 2, "settings": SMALL} | change

    with pytest.raises(ValueError, match=f"^{name}: got"):
        register(params, **arguments)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("points", {"points": jnp.zeros((10, 5))}),
        ("mask", {"mask": jnp.ones(9, bool)}),
        ("neighbors", {"neighbors": jnp.zeros((9, 4), jnp.int32)}),
    ],
)
def test_prepare_refuses_what_does_not_fit_together(unchecked, name, change):
    arguments = {"points": jnp.zeros((10, 3))} | change

    with pytest.raises(ValueError, match=f"^{name}: got"):
        prepare(**arguments)


def test_values_that_are_no_numbers_are_refused_by_name(params, pair, unchecked):
    source, target = both(pair)
    broken = np.asarray(source).copy()
    broken[3, 1] = np.nan
    with pytest.raises(ValueError, match="source: row 3 is not finite"):
        register(params, broken, target)
    with pytest.raises(ValueError, match="target: got a list"):
        register(params, source, [[0.0, 0.0, 0.0]] * 9)
    with pytest.raises(ValueError, match="target: got a NoneType"):
        encode(params, None)
    with pytest.raises(ValueError, match="source: got bool"):
        register(params, np.ones((9, 3), bool), target)


def test_the_last_transform_of_a_batch_is_the_last_of_each_pair(params, pair):
    source, target = both(pair)
    one = register(params, source, target)

    batch = jax.vmap(register, (None, 0, None))(params, jnp.stack([source, source]), target)

    assert batch.transform.shape == (2, 4, 4)
    close(batch.transform[0], one.transform)


@pytest.mark.parametrize("name", ["iterations", "cascades"])
@pytest.mark.parametrize("count", [1.5, True, "2", np.float64(2), 0, -1])
def test_a_count_that_is_no_whole_number_is_refused_by_name(params, pair, unchecked, name, count):
    with pytest.raises(ValueError, match=f"^{name}: got .*, wanted|^{name}: got .* at least 1"):
        register(params, *both(pair), settings=SMALL, **{name: count})


def test_parameters_that_are_none_are_refused_by_name(params, pair, unchecked):
    wrong = (
        None,
        [],
        {},
        {"a": 1},
        {3: params},
        {**params, "cascade": {}},
        {**params, "features": "a"},
    )
    for given in wrong:
        with pytest.raises(ValueError, match="^params: got .*, wanted the parameters of load_par"):
            register(given, *both(pair), settings=SMALL)
        with pytest.raises(ValueError, match="^params: got .*, wanted the parameters of load_par"):
            encode(given, both(pair)[1], settings=SMALL)

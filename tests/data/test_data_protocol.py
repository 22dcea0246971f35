import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.data import protocol as protocols
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.protocol import Protocol, fixed_pair, random_pair
from cfr_jax.geometry import motions

NAMED = [protocols.clean, protocols.noise, protocols.partial, protocols.low_overlap]


def corpus_of(shapes=4, points=2048, seed=0):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(shapes, points, 3))
    return Corpus(
        points=rng.normal(0, 0.3, (shapes, points, 3)).astype(np.float32),
        normals=(normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        labels=np.zeros(shapes, np.int64),
        names=tuple(f"shape {i}" for i in range(shapes)),
        categories=("any",),
    )


def published_draws(shape, index, kind, count=1024):
    """The published test procedure, section by section, with numpy's global legacy functions."""

    def half_space(cloud, share):
        phi, c = np.random.uniform(0.0, 2 * np.pi), np.random.uniform(-1.0, 1.0)
        theta = np.arccos(c)
        d = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
        h = np.dot(cloud[:, :3] - np.mean(cloud[:, :3], axis=0), np.array(d))
        return cloud[h > (0 if share == 0.5 else np.percentile(h, (1.0 - share) * 100))]

    def draw(cloud, k):
        if k <= len(cloud):
            return cloud[np.random.choice(len(cloud), k, replace=False)]
        once = np.random.choice(len(cloud), len(cloud), replace=False)
        again = np.random.choice(len(cloud), k - len(cloud), replace=True)
        return cloud[np.concatenate([once, again])]

    state = np.random.get_state()
    np.random.seed(index)
    if kind == "clean":
        shape = np.resize(shape, (count, shape.shape[1]))
    source, target = shape.copy(), shape.copy()
    if kind in ("partial", "low_overlap"):
        share = np.float32(0.7 if kind == "partial" else 0.5)
        np.random.seed(index)
        source, target = half_space(source, share), half_space(target, share)
        count = math.ceil(share * count)
    np.random.seed(index)
    ax, ay, az = (np.random.uniform() * np.pi * 45.0 / 180.0 for _ in range(3))
    rx = [[1, 0, 0], [0, np.cos(ax), -np.sin(ax)], [0, np.sin(ax), np.cos(ax)]]
    ry = [[np.cos(ay), 0, np.sin(ay)], [0, 1, 0], [-np.sin(ay), 0, np.cos(ay)]]
    rz = [[np.cos(az), -np.sin(az), 0], [np.sin(az), np.cos(az), 0], [0, 0, 1]]
    r = (np.array(rx) @ np.array(ry) @ np.array(rz)).astype(np.float32)
    t = np.random.uniform(-0.5, 0.5, 3).astype(np.float32)
    source = np.concatenate([source[:, :3] @ r.T + t, source[:, 3:] @ r.T], axis=1)
    if kind != "clean":
        np.random.seed(index)
        source, target = draw(source, count), draw(target, count)
        for cloud in (source, target):
            cloud[:, :3] += np.clip(np.random.normal(0.0, 0.01, (len(cloud), 3)), -0.05, 0.05)
    target = np.random.permutation(target)
    source = np.random.permutation(source)
    np.random.set_state(state)
    return source, target, r, t


@pytest.mark.parametrize("points", [1600, 600, 2048])
@pytest.mark.parametrize("protocol", NAMED, ids=lambda p: p.name)
def test_fixed_pairs_are_the_published_ones_bit_for_bit(protocol, points):
    corpus = corpus_of(points=points)

    for index in range(len(corpus)):
        pair = fixed_pair(corpus, index, protocol)
        shape = np.concatenate(corpus[index], axis=1)
        source, target, r, t = published_draws(shape, index, protocol.name)

        np.testing.assert_array_equal(pair.target, target[:, :3])
        np.testing.assert_array_equal(pair.target_normals, target[:, 3:])
        np.testing.assert_array_equal(pair.source, source[:, :3])
        np.testing.assert_array_equal(pair.source_normals, source[:, 3:])
        np.testing.assert_array_equal(pair.transform[:3, :3], r.T)
        np.testing.assert_allclose(pair.transform[:3, 3], -r.T @ t, atol=1e-7)


@pytest.mark.parametrize("protocol", NAMED, ids=lambda p: p.name)
@pytest.mark.parametrize("kind", [np.random.RandomState, np.random.default_rng])
def test_the_truth_maps_the_source_onto_the_target(protocol, kind):
    corpus = corpus_of()
    exact = dataclasses.replace(protocol, noise=False, points=2048)

    pair = random_pair(*corpus[0], exact, kind(3))

    landed = pair.source @ pair.transform[:3, :3].T + pair.transform[:3, 3]
    turned = pair.source_normals @ pair.transform[:3, :3].T
    shape = {tuple(p): n for p, n in zip(*map(np.ndarray.tolist, corpus[0]), strict=True)}
    known = np.array(list(shape))
    nearest = [np.abs(known - point).sum(1).argmin() for point in landed[:200]]
    np.testing.assert_allclose(landed[:200], known[nearest], atol=1e-6)
    np.testing.assert_allclose(turned[:200], np.array(list(shape.values()))[nearest], atol=1e-6)
    whole = pair.clean_source @ pair.transform[:3, :3].T + pair.transform[:3, 3]
    np.testing.assert_allclose(whole, pair.clean_target, atol=1e-6)


def test_clouds_have_the_published_sizes():
    corpus = corpus_of()

    sizes = [len(fixed_pair(corpus, 0, protocol).source) for protocol in NAMED]

    assert sizes == [1024, 1024, 717, 512]


def test_overlap_is_the_share_of_the_sources_part_that_the_target_has():
    points, normals = corpus_of(points=300)[0]
    everything = Protocol("all of each crop", points=300, keep=0.6, noise=False)

    pair = random_pair(points, normals, everything, np.random.default_rng(5))

    landed = pair.source @ pair.transform[:3, :3].T + pair.transform[:3, 3]
    near = np.linalg.norm(landed[:, None] - pair.target[None], axis=-1).min(1) < 1e-5
    assert 0.2 < pair.overlap < 1
    assert pair.overlap == pytest.approx(near.mean(), abs=1e-9)


def test_both_ways_gives_the_same_pairs_turned_either_way():
    # given the same shape, rotated by angles from [0, 45] and by angles from [-45, 45]
    corpus = corpus_of()
    one_way, both_ways = (
        fixed_pair(corpus, 1, protocol)
        for protocol in (protocols.partial, protocols.partial_both_ways)
    )

    # then each angle is mapped to the other range, and nothing else changes
    def angles(pair):
        undone = Rotation.from_matrix(pair.transform[:3, :3].T)
        return undone.as_euler("XYZ", degrees=True)

    np.testing.assert_allclose(angles(both_ways), 2 * angles(one_way) - 45, atol=1e-3)
    np.testing.assert_array_equal(both_ways.target, one_way.target)


def test_the_same_seed_gives_the_same_pair_and_another_seed_another():
    shape = corpus_of()[0]

    first, again, other = (
        random_pair(*shape, protocols.partial, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )

    np.testing.assert_array_equal(first.source, again.source)
    assert not np.array_equal(first.source, other.source)


def test_impossible_requests_are_refused_by_name():
    with pytest.raises(ValueError, match="keep: got 1.5"):
        Protocol("x", keep=1.5)
    with pytest.raises(ValueError, match="points: got 0"):
        Protocol("x", points=0)
    with pytest.raises(ValueError, match="index: got 9, wanted 0 to"):
        fixed_pair(corpus_of(), 9, protocols.clean)


def test_a_pair_of_given_overlap_has_it_and_lies_by_its_truth():
    corpus = corpus_of()

    pair = fixed_pair(corpus, 1, protocols.PROTOCOLS["overlap_3"])

    assert pair.overlap == pytest.approx(0.3, abs=0.003)
    assert len(pair.source) == len(pair.target) == math.ceil(1024 / 1.7)
    np.testing.assert_allclose(
        motions.apply(pair.transform, pair.clean_source), pair.clean_target, atol=1e-5
    )
    with pytest.raises(ValueError, match="^overlap: "):
        Protocol("both", keep=0.7, overlap=0.3)

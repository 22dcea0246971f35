"""Training pairs: each a function of seed and position alone, and each what it says it is."""

import numpy as np
import pytest
from oracle import pieces

from cfr_jax.data.batches import Sampling, batch_at, batches, draw_pair
from cfr_jax.data.corpus import Corpus

SMALL = Sampling(points=24, neighbors=6)


@pytest.fixture(scope="module")
def corpus():
    """Five bumpy ellipsoids."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(5, 80, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    stretched = directions * rng.uniform(0.4, 1, size=(5, 1, 3))
    return Corpus(
        points=stretched.astype(np.float32),
        normals=directions.astype(np.float32),
        labels=np.zeros(5, np.int64),
        names=tuple("abcde"),
        categories=("ellipsoid",),
    )


def stream(corpus, position, count, size=2, workers=1, seed=0):
    return list(
        batches(
            corpus, SMALL, size=size, position=position, count=count, seed=seed, workers=workers
        )
    )


def assert_same(batches, others):
    for batch, other in zip(batches, others, strict=True):
        assert batch.keys() == other.keys()
        for key in batch:
            np.testing.assert_array_equal(batch[key], other[key])


@pytest.mark.parametrize("workers", [2, 5])
def test_the_pairs_are_the_same_whatever_the_number_of_workers(corpus, workers):
    assert_same(stream(corpus, 0, 7, workers=workers), stream(corpus, 0, 7))


def test_a_resumed_stream_goes_on_where_it_stopped(corpus):
    whole = stream(corpus, 0, 6)

    assert_same(stream(corpus, 8, 2), whole[4:])


def test_the_size_of_a_batch_does_not_change_the_pairs(corpus):
    twos, threes = stream(corpus, 0, 3, size=2), stream(corpus, 0, 2, size=3)

    for key in twos[0]:
        np.testing.assert_array_equal(
            np.concatenate([batch[key] for batch in twos]),
            np.concatenate([batch[key] for batch in threes]),
        )


def test_every_shape_comes_once_an_epoch_in_an_order_of_its_own(corpus, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "cfr_jax.data.batches.draw_pair",
        lambda corpus, index, sampling, rng: drawn.append(int(index)) or {"a": np.zeros(1)},
    )

    batch_at(corpus, 0, 15, SMALL, seed=0)

    epochs = [drawn[:5], drawn[5:10], drawn[10:]]
    assert all(sorted(epoch) == [0, 1, 2, 3, 4] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_another_seed_gives_other_pairs(corpus):
    here, there = stream(corpus, 0, 1), stream(corpus, 0, 1, seed=1)

    assert (here[0]["source"] != there[0]["source"]).all()


def test_the_truth_carries_the_source_onto_the_shape_of_the_target(corpus):
    sampling = Sampling(points=60, neighbors=6, keep=(1.0, 1.0))

    for seed in range(5):
        pair = draw_pair(corpus, 0, sampling, np.random.default_rng(seed))

        moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
        gap = np.linalg.norm(moved[:, None] - corpus.points[0], axis=-1).min(axis=1)
        assert np.sqrt(np.mean(gap**2)) < 0.025  # the noise: 0.01 on each of three axes
        turned = pair["source_normals"] @ pair["transform"][:3, :3].T
        nearest = np.linalg.norm(moved[:, None] - corpus.points[0], axis=-1).argmin(axis=1)
        cosines = np.sum(turned * corpus.normals[0][nearest], axis=1)
        assert np.median(cosines) > 0.99


def test_a_pair_has_the_sizes_types_and_limits_asked_for(corpus):
    sampling = Sampling(
        points=24, neighbors=6, angle=10.0, translation=0.1, any_orientation=1.0, scale=(0.5, 0.6),
        estimated_normals=1.0,
    )  # fmt: skip

    pair = draw_pair(corpus, 1, sampling, np.random.default_rng(0))

    for side in ("source", "target"):
        assert pair[side].shape == pair[f"{side}_normals"].shape == (24, 3)
        assert pair[side].dtype == pair[f"{side}_normals"].dtype == np.float32
        assert pair[f"{side}_neighbors"].shape == (24, 6)
        assert pair[f"{side}_neighbors"].dtype == np.int32
    assert pair["transform"].shape == (4, 4) and pair["transform"].dtype == np.float32
    assert np.linalg.norm(pair["target"], axis=1).max() < 0.6 + 0.1
    assert pair["estimate_normals"]
    angle = np.degrees(np.arccos((np.trace(pair["transform"][:3, :3]) - 1) / 2))
    assert 0 < angle < 3 * 10

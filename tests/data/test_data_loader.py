"""Training pairs: each depends only on seed and position, and each has the stated properties."""

import numpy as np
import pytest
from oracle import pieces

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.loader import batch_at, batches
from cfr_jax.data.mixture import Mixture
from cfr_jax.data.sources import ShapeSource, TrainingSource

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


@pytest.fixture(scope="module")
def source(corpus):
    return ShapeSource(corpus)


def stream(source, position, count, size=2, workers=1, seed=0, **more):
    return list(
        batches(
            source,
            SMALL,
            size=size,
            position=position,
            count=count,
            seed=seed,
            workers=workers,
            **more,
        )
    )


def assert_same(batches, others):
    for batch, other in zip(batches, others, strict=True):
        assert batch.keys() == other.keys()
        for key in batch:
            np.testing.assert_array_equal(batch[key], other[key])


@pytest.mark.parametrize("workers", [2, 5])
def test_the_pairs_are_the_same_whatever_the_number_of_workers(source, workers):
    assert_same(stream(source, 0, 7, workers=workers), stream(source, 0, 7))


def test_a_resumed_stream_continues_where_it_stopped(source):
    whole = stream(source, 0, 6)

    assert_same(stream(source, 8, 2), whole[4:])


def test_the_size_of_a_batch_does_not_change_the_pairs(source):
    twos, threes = stream(source, 0, 3, size=2), stream(source, 0, 2, size=3)

    for key in twos[0]:
        np.testing.assert_array_equal(
            np.concatenate([batch[key] for batch in twos]),
            np.concatenate([batch[key] for batch in threes]),
        )


def test_several_processes_make_the_shares_of_the_same_batches(source):
    whole = stream(source, 0, 3, size=4)
    shares = [stream(source, 0, 3, size=4, share=slice(2 * i, 2 * i + 2)) for i in range(2)]

    joined = [
        {key: np.concatenate([first[key], second[key]]) for key in first}
        for first, second in zip(*shares, strict=True)
    ]
    assert_same(joined, whole)


def test_zero_workers_are_refused(source):
    with pytest.raises(ValueError, match="workers: got 0"):
        stream(source, 0, 1, workers=0)


class Listed(TrainingSource):
    """A source that records which of its items are drawn."""

    noun, stamp, recorded, check = "items", "the same", frozenset(), None

    def __init__(self, size):
        self.size, self.drawn = size, []

    def __len__(self):
        return self.size

    def draw(self, index, sampling, rng):
        self.drawn.append(index)
        return {"a": np.zeros(1)}


def test_every_shape_comes_once_per_epoch_in_a_new_order():
    source = Listed(5)

    batch_at(source, 0, 15, SMALL, seed=0)

    epochs = [source.drawn[:5], source.drawn[5:10], source.drawn[10:]]
    assert all(sorted(epoch) == [0, 1, 2, 3, 4] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_a_mixture_repeats_each_source_as_often_as_configured():
    few, many, out = Listed(2), Listed(5), Listed(3)
    mixture = Mixture([few, out, many], [3, 0, 1])

    assert len(mixture) == 11
    batch_at(mixture, 0, 11, SMALL, seed=0)

    assert sorted(few.drawn) == [0, 0, 0, 1, 1, 1]
    assert sorted(many.drawn) == [0, 1, 2, 3, 4] and not out.drawn


def test_another_seed_gives_other_pairs(source):
    here, there = stream(source, 0, 1), stream(source, 0, 1, seed=1)

    assert (here[0]["source"] != there[0]["source"]).all()


def test_the_truth_maps_the_source_onto_the_shape_of_the_target(source, corpus):
    sampling = Sampling(points=60, neighbors=6, keep=(1.0, 1.0))

    for seed in range(5):
        pair = source.draw(0, sampling, np.random.default_rng(seed))

        moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
        gap = np.linalg.norm(moved[:, None] - corpus.points[0], axis=-1).min(axis=1)
        assert np.sqrt(np.mean(gap**2)) < 0.025  # the noise: 0.01 on each of three axes
        turned = pair["source_normals"] @ pair["transform"][:3, :3].T
        nearest = np.linalg.norm(moved[:, None] - corpus.points[0], axis=-1).argmin(axis=1)
        cosines = np.sum(turned * corpus.normals[0][nearest], axis=1)
        assert np.median(cosines) > 0.99


def test_a_pair_has_the_sizes_types_and_limits_asked_for(source):
    sampling = Sampling(
        points=24, neighbors=6, angle=10.0, translation=0.1, any_orientation=1.0, scale=(0.5, 0.6),
        estimated_normals=1.0,
    )  # fmt: skip

    pair = source.draw(1, sampling, np.random.default_rng(0))

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

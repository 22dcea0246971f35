"""Pairs drawn on the device have the distributions of those drawn on the host."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import ks_2samp

from cfr_jax.data.augmentation.pairs_on_device import Shapes, draw_pairs
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.sources import ShapeSource
from cfr_jax.geometry.neighbors import nearest_on_host

PAIRS = 700
ALL = Sampling(
    points=48, neighbors=5, keep=(0.5, 0.8), angle=45.0, translation=0.5, both_ways=0.4, near=0.3,
    centered=0.4, any_orientation=0.3, scale=(0.8, 1.2), uneven=0.5, density=(4.0, 10.0),
    outliers=(0.0, 0.3), noise=(0.005, 0.02), sensor_noise=0.4, sensor_scale=(0.02, 0.05),
    estimated_normals=0.6,
)  # fmt: skip
PLAIN = Sampling(points=48, neighbors=5, keep=(0.55, 0.85), scale=(0.8, 1.2))
# a crop leaves fewer of a shape's 200 points than a cloud has, so some come twice
FEW = Sampling(points=90, neighbors=5, keep=(0.2, 0.4), noise=(0.0, 0.0), angle=0.0)
HALF = Sampling(points=48, neighbors=5, keep=(0.5, 0.5), noise=(0.0, 0.0))
# nearly all points are in both clouds, so their distances are the noise
NOISY = Sampling(
    points=170, neighbors=5, keep=(0.95, 1.0), angle=0.0, noise=(0.005, 0.02), sensor_noise=0.4,
    sensor_scale=(0.02, 0.05),
)  # fmt: skip
UNEVEN = Sampling(points=48, neighbors=5, keep=(0.9, 1.0), uneven=0.5, density=(4.0, 10.0))
CASES = {"plain": PLAIN, "few": FEW, "half": HALF, "noisy": NOISY, "uneven": UNEVEN, "all": ALL}


@pytest.fixture(scope="module")
def corpus():
    """Three bumpy ellipsoids, upright and off center, rounded to float16 and int8."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3, 200, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    bumps = 1 + 0.2 * np.sin(4 * directions[..., :1])
    points = directions * bumps * rng.uniform(0.3, 0.5, size=(3, 1, 3)) * [1, 1.6, 1] + [
        0.1,
        0,
        -0.1,
    ]
    normals = np.rint(127 * directions)
    return Corpus(
        points=points.astype(np.float16).astype(np.float32),
        normals=(normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        labels=np.zeros(3, np.int64),
        names=("a", "b", "c"),
        categories=("ellipsoid",),
    )


@functools.partial(jax.jit, static_argnames=("sampling",))
def drawn_pairs(shapes, seed, items, positions, sampling):
    return draw_pairs(shapes, seed, items, positions, sampling)


def on_device(corpus, sampling, count=PAIRS, seed=0, first=0):
    places = np.arange(first, first + count)
    items = jnp.asarray(places % len(corpus), jnp.int32)
    positions = jnp.asarray(places, jnp.uint32)
    pairs = drawn_pairs(Shapes.of(corpus), jnp.uint32(seed), items, positions, sampling)
    return jax.tree.map(np.asarray, pairs)


def on_host(corpus, sampling, count=PAIRS):
    source = ShapeSource(corpus)
    pairs = [
        source.draw(place % len(corpus), sampling, np.random.default_rng(place))
        for place in range(count)
    ]
    return {key: np.stack([pair[key] for pair in pairs]) for key in pairs[0]}


def measured(pairs):
    """Statistics of pairs, each (pairs,)."""
    found = {"estimated": pairs["estimate_normals"].astype(float)}
    transforms = pairs["transform"].astype(np.float64)
    undone = Rotation.from_matrix(transforms[:, :3, :3].transpose(0, 2, 1))
    for axis, angles in zip("xyz", undone.as_euler("XYZ").T, strict=True):
        found[f"angle about {axis}"] = angles
    for axis in range(3):
        found[f"translation {axis}"] = transforms[:, axis, 3]
    found["gap"] = np.array([
        np.median(cKDTree(target).query(pieces.move(transform, source))[0])
        for transform, source, target in zip(
            transforms, pairs["source"], pairs["target"], strict=True
        )
    ])  # fmt: skip
    for side in ("source", "target"):
        cloud, normals = pairs[side].astype(np.float64), pairs[f"{side}_normals"]
        middle = cloud.mean(axis=1, keepdims=True)
        away = np.linalg.norm(cloud - middle, axis=2)
        found[f"{side} off the origin"] = np.linalg.norm(middle[:, 0], axis=1)
        found[f"{side} height"] = middle[:, 0, 1]
        found[f"{side} farthest"] = away.max(axis=1)
        spread = np.linalg.eigvalsh(np.einsum("bni,bnj->bij", cloud - middle, cloud - middle))
        found |= {f"{side} spread {axis}": spread[:, axis] for axis in range(3)}
        along = np.mean((cloud - middle) ** 2, axis=1)
        found[f"{side} upright"] = along[:, 1] / along.sum(axis=1)
        near = np.sort([cKDTree(points).query(points, 3)[0][:, 2] for points in cloud])
        found |= {f"{side} nearest, {q}": near[:, int(q * near.shape[1])] for q in (0.1, 0.5, 0.9)}
        outward = np.sum((cloud - middle) * normals, axis=2) / away
        found[f"{side} normals outward"] = np.median(outward, axis=1)
        found[f"{side} normals inward"] = np.min(outward, axis=1)
        found[f"{side} different"] = np.array([len(np.unique(one, axis=0)) for one in cloud])
    # the host computes in float64, so its zeros are only nearly zero on the device
    return {name: np.round(values, 5) for name, values in found.items()}


def likelihoods(first, second):
    """For each statistic, the Kolmogorov-Smirnov p-value for equal distributions."""
    return {name: ks_2samp(first[name], second[name]).pvalue for name in first}


@pytest.fixture(scope="module")
def drawn(corpus):
    return on_device(corpus, ALL)


@pytest.fixture(scope="module")
def numbers_of(corpus):
    """The statistics of the device's pairs for a case."""
    return functools.cache(lambda case: measured(on_device(corpus, CASES[case])))


@pytest.mark.parametrize("case", CASES)
def test_pairs_have_the_distribution_of_pairs_from_the_host(corpus, numbers_of, case):
    found = likelihoods(numbers_of(case), measured(on_host(corpus, CASES[case])))

    # about thirty tests, few of them independent, so one in a thousand is rare enough
    assert {name: p for name, p in found.items() if p < 1e-3} == {}


@pytest.mark.parametrize(
    ("case", "change"),
    [
        ("all", {"keep": (0.7, 0.9)}), ("all", {"angle": 32.0}), ("all", {"translation": 0.35}),
        ("all", {"both_ways": 0.8}), ("all", {"near": 0.9}), ("all", {"centered": 0.7}),
        ("all", {"any_orientation": 1.0}), ("all", {"scale": (1.1, 1.5)}),
        ("all", {"outliers": (0.0, 0.1)}), ("all", {"estimated_normals": 0.3}),
        ("uneven", {"uneven": 0.2}), ("uneven", {"density": (1.0, 3.0)}),
        ("noisy", {"noise": (0.01, 0.03)}), ("noisy", {"sensor_noise": 0.7}),
        ("noisy", {"sensor_scale": (0.05, 0.1)}),
    ],
    ids=str,
)  # fmt: skip
def test_the_statistics_detect_a_field_that_differs(corpus, numbers_of, case, change):
    """Without this, the tests above might accept anything."""
    other = Sampling(**{**CASES[case].__dict__, **change})

    found = likelihoods(numbers_of(case), measured(on_host(corpus, other)))

    assert min(found.values()) < 1e-4


def test_the_truth_maps_one_cloud_onto_the_other(corpus):
    whole = Sampling(
        points=199, neighbors=6, keep=(1.0, 1.0), noise=(0.0, 0.0), both_ways=0.5, near=0.5,
        centered=0.5, any_orientation=0.5, scale=(0.5, 2.0),
    )  # fmt: skip

    pairs = on_device(corpus, whole, count=20)

    for i in range(20):
        moved = pieces.move(pairs["transform"][i].astype(np.float64), pairs["source"][i])
        gap, row = cKDTree(pairs["target"][i]).query(moved)
        assert (gap < 1e-5).mean() > 0.99  # a crop to 1.0 leaves out the lowest point
        turned = pairs["source_normals"][i] @ pairs["transform"][i, :3, :3].T
        apart = np.abs(turned - pairs["target_normals"][i][row]).max(axis=1)
        assert (apart[gap < 1e-5] < 1e-5).all()
        lengths = np.linalg.norm(pairs["source_normals"][i], axis=1)
        np.testing.assert_allclose(lengths, 1, atol=1e-5)


def test_neighbors_are_those_of_the_final_clouds(drawn):
    for side in ("source", "target"):
        for cloud, found in zip(drawn[side][:10], drawn[f"{side}_neighbors"], strict=False):
            wanted = nearest_on_host(cloud, ALL.neighbors, radius=ALL.radius)
            np.testing.assert_array_equal(np.sort(found), np.sort(wanted))


def test_a_pair_depends_only_on_its_position_in_the_stream(corpus, drawn):
    later = on_device(corpus, ALL, count=5, first=7)

    for key, leaf in later.items():
        if leaf.dtype == np.float32:  # a batch of another size rounds differently
            np.testing.assert_allclose(leaf, drawn[key][7:12], atol=1e-6)
        elif leaf.dtype == bool:
            np.testing.assert_array_equal(leaf, drawn[key][7:12])
    other = on_device(corpus, ALL, count=5, first=7, seed=1)
    assert (other["source"] != later["source"]).any(axis=(1, 2)).all()


def test_a_corpus_loses_little_in_nine_bytes_per_point(corpus):
    shapes = Shapes.of(corpus)

    np.testing.assert_array_equal(shapes.points.astype(np.float32), corpus.points)
    away = np.linalg.norm(np.cross(shapes.normals / 127, corpus.normals), axis=-1)
    assert away.max() < np.sin(np.radians(0.5))
    assert shapes.points.nbytes + shapes.normals.nbytes == 9 * 3 * 200


def test_a_shape_without_normals_keeps_none(corpus):
    bare = Corpus(corpus.points, 0 * corpus.normals, corpus.labels, corpus.names, ("ellipsoid",))

    pairs = on_device(bare, PLAIN, count=2)

    assert not pairs["source_normals"].any()


def test_shapes_far_from_the_unit_sphere_are_refused(corpus):
    far = Corpus(corpus.points * 1e6, corpus.normals, corpus.labels, corpus.names, ("ellipsoid",))

    most = f"{np.abs(far.points).max():g}"
    with pytest.raises(ValueError, match=f"corpus: got a coordinate of {most}, wanted shapes in"):
        Shapes.of(far)


@pytest.mark.parametrize("platform", ["cuda", "rocm", "tpu"])
def test_the_drawing_lowers_for_accelerators(corpus, platform):
    shapes = jax.tree.map(jnp.asarray, Shapes.of(corpus))
    items, positions = jnp.zeros(4, jnp.int32), jnp.zeros(4, jnp.uint32)

    traced = drawn_pairs.trace(shapes, jnp.uint32(0), items, positions, ALL)
    text = traced.lower(lowering_platforms=(platform,)).as_text()

    called = set(re.findall(r"custom_call @([\w.$]+)", text))
    assert not {name for name in called if re.search("lapack|callback|cpu", name)}
    # every product asks for full precision, which positions and motions need
    products = [line for line in text.splitlines() if "stablehlo.dot_general" in line]
    assert products and all(line.count("HIGHEST") == 2 for line in products)

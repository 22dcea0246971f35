"""Clouds of fewer points than a neighborhood has: one program for all of them, same answers."""

import jax.numpy as jnp
import numpy as np
import pytest

import cfr_jax as cfr
from cfr_jax.alignment import planning, solving
from cfr_jax.geometry import units
from cfr_jax.io import PointCloud
from cfr_jax.runtime import programs


def ellipsoid(count, seed=0):
    """Points and normals on the upper half."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] = np.abs(points[:, 2])
    normals = points / [1, 0.7, 0.4]
    return points * [1, 0.7, 0.4], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_pairs_of_all_small_sizes_share_the_programs():
    counted = []
    for source, target in ((20, 24), (29, 21), (64, 33), (65, 65), (3, 40)):
        cfr.align(ellipsoid(source)[0], ellipsoid(target, 1)[0], second_look=False)
        counted.append(programs._program.cache_info().misses)
    assert counted[1:] == [counted[0]] * 4


@pytest.mark.parametrize("count", [3, 20, 64, 65, 66])
@pytest.mark.parametrize("on_host", [True, False])
def test_padding_changes_no_feature_and_no_normal(count, on_host):
    # with all points as neighbors: where a neighborhood is a line, rounding chooses the normal
    settings = cfr.Settings(radius=4.0)
    points = ellipsoid(count)[0]
    unit = units.to_unit(
        PointCloud(points), np.zeros(3), 1.0, np.eye(4),
        budget=1024, neighbors=64, radius=4.0, seed=0, search=on_host,
    )  # fmt: skip
    (sent,) = solving.on_device(unit)
    assert len(unit.points) == (65 if count <= 65 else 128)

    padded = sent.prepared(settings)

    plain = cfr.prepare(jnp.asarray(points, jnp.float32), settings=settings)
    if count > 3:  # three points have a plane, and no outside
        np.testing.assert_allclose(padded.normals[:count], plain.normals, atol=1e-4)
    plain = plain.replace(normals=padded.normals[:count])
    features = [
        cfr.encode(cfr.load_params(), cloud, settings=settings).features[:, :count]
        for cloud in (padded, plain)
    ]
    np.testing.assert_allclose(*features, atol=1e-5)  # unit rows, in float32


def test_an_answer_does_not_depend_on_padding():
    points, normals = ellipsoid(30)
    angle = 0.4
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    source = np.hstack([points, normals])
    target = np.hstack([points[:25] @ turn.T + 0.1, normals[:25] @ turn.T])
    plan = planning.planned(source, target)
    params = cfr.load_params()

    padded = cfr.register(
        params, *(sent.prepared() for sent in solving.on_device(plan.source, plan.target))
    )

    plain = cfr.register(
        params,
        *(
            jnp.asarray(np.hstack([unit.points, unit.normals])[unit.mask], jnp.float32)
            for unit in (plan.source, plan.target)
        ),
    )
    np.testing.assert_allclose(padded.transforms, plain.transforms, atol=1e-5)
    np.testing.assert_allclose(padded.confidence, plain.confidence, atol=1e-4)
    np.testing.assert_allclose(padded.weights[:30], plain.weights, atol=1e-4)

"""Generalized ICP recovers known motions, never makes the score worse, and agrees with an
independent minimizer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import solids
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cfr_jax.refine import generalized_icp
from cfr_jax.refine.generalized_icp import Stage
from cfr_jax.refine.surfaces import Surface

SIZE = 512
REFINE = jax.jit(generalized_icp.refine, static_argnames=("stages",))


@jax.jit
def SCORE(source, target, transform):  # noqa: N802
    return generalized_icp.scores(source, target, transform[None], generalized_icp.CUT)[0]


def surface(sampled, transform=None):
    """A surface moved by `transform` and padded to SIZE rows."""
    points, normals = sampled
    if transform is not None:
        points, normals = solids.move(transform, points), normals @ transform[:3, :3].T
    pad = ((0, SIZE - len(points)), (0, 0))
    rows = (jnp.asarray(np.pad(part, pad), jnp.float32) for part in (points, normals))
    return Surface(*rows, jnp.arange(SIZE) < len(points))


def start(degrees, translation=(0.0, 0.0, 0.0), axis=(1.0, 2.0, 3.0)):
    return jnp.asarray(solids.motion(degrees, axis, translation), jnp.float32)


def refined(source, target, initial):
    return np.asarray(REFINE(source, target, initial).transform, np.float64)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (1, -2, 3)])
@pytest.mark.parametrize("kept", [1.0, 0.75])
def test_a_known_motion_is_recovered_from_noisy_overlapping_views(axis, kept):
    truth = solids.motion(40)
    source = solids.keep_side(solids.lopsided(500, 0, 0.005), (1, 0, 0.3), kept)
    target = solids.keep_side(solids.lopsided(500, 1, 0.005), (-1, 0.5, 0.3), kept)
    # the start is off in the source's frame, where the error is largest
    initial = truth @ np.asarray(start(8, (0.05, -0.05, 0.03), axis), np.float64)

    found = REFINE(surface(source), surface(target, truth), jnp.asarray(initial, jnp.float32))

    transform = np.asarray(found.transform, np.float64)
    assert bool(found.improved)
    assert solids.degrees_between(transform, truth) < 1.2
    away = solids.move(transform, source.points) - solids.move(truth, source.points)
    assert np.linalg.norm(away, axis=1).mean() < 0.015


@pytest.mark.parametrize("seed", range(6))
def test_it_never_scores_worse_than_its_start(seed):
    rng = np.random.default_rng(seed)
    source, target = surface(solids.lopsided(400, 0)), surface(solids.sphere(500, 1))
    initial = start(rng.uniform(0, 180), rng.uniform(-0.5, 0.5, 3), rng.normal(size=3))

    found = REFINE(source, target, initial)

    assert float(SCORE(source, target, found.transform)) <= float(SCORE(source, target, initial))
    assert bool(found.improved) or np.array_equal(found.transform, initial)


def test_what_would_score_worse_is_not_taken(monkeypatch):
    source, target = (surface(solids.lopsided(400, seed)) for seed in (0, 1))
    away = start(0, (1.0, 0, 0))
    monkeypatch.setattr(
        generalized_icp, "descend", lambda *_: (away, jnp.int32(1), jnp.array(True))
    )

    # a new jit, because programs compiled before would still use the unpatched `descend`
    found = jax.jit(lambda initial: generalized_icp.refine(source, target, initial))(start(1))

    assert not bool(found.improved) and np.array_equal(found.transform, start(1))


def test_clouds_already_in_place_stay_and_converge():
    cloud = surface(solids.lopsided(400, 0))

    found = REFINE(cloud, cloud, jnp.eye(4))

    assert bool(found.converged) and bool(found.improved) and int(found.steps) == 3
    np.testing.assert_allclose(found.transform, np.eye(4), atol=1e-6)


def test_clouds_out_of_reach_stay_where_they_are():
    source, target = surface(solids.lopsided(400, 0)), surface(solids.lopsided(400, 1))

    found = REFINE(source, target, start(10, (50.0, 0, 0)))

    assert np.array_equal(found.transform, start(10, (50.0, 0, 0)))


def test_a_plane_comes_to_lie_on_a_plane_and_hardly_moves_in_it():
    source, target = surface(solids.plane(500, 0)), surface(solids.plane(500, 1))
    initial = start(5, (0.02, -0.01, 0.04), (1.0, 1.0, 0.0))

    found = refined(source, target, initial)

    height = solids.move(found, np.asarray(source.points)[:500])[:, 2]
    assert np.abs(height).max() < 1e-3
    # within the plane it slides only to where the samples meet best, less than their spacing away
    assert np.abs(found[:2, 3] - np.asarray(initial)[:2, 3]).max() < 0.09


def test_a_line_does_not_turn_about_itself():
    source, target = surface(solids.line(300, 0)), surface(solids.line(300, 0))
    initial = start(4, (0, 0.02, 0), (0, 0, 1))

    found = refined(source, target, initial)

    turn = Rotation.from_matrix(found[:3, :3]).as_rotvec()
    assert np.isfinite(found).all() and abs(turn[0]) < 1e-3
    assert np.abs(solids.move(found, np.asarray(source.points)[:300])[:, 1:]).max() < 1e-3


@pytest.mark.parametrize("degenerate", ["coincident", "without normals", "three points"])
def test_degenerate_clouds_give_a_rigid_motion(degenerate):
    points, normals = solids.lopsided(400, 0)
    cloud = {
        "coincident": solids.Sampled(points * 0, normals),
        "without normals": solids.Sampled(points, normals * 0),
        "three points": solids.Sampled(points[:3], normals[:3]),
    }[degenerate]

    found = refined(surface(cloud), surface(solids.lopsided(400, 1)), start(5))

    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-5)


def test_padding_changes_nothing():
    source, target = solids.lopsided(300, 0), solids.lopsided(400, 1)
    exact = (
        Surface(*(jnp.asarray(part, jnp.float32) for part in cloud), jnp.ones(len(cloud[0]), bool))
        for cloud in (source, target)
    )

    wanted = refined(*exact, start(5))

    found = refined(surface(source), surface(target), start(5))
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def oracle_icp(source, target, initial, stage, rounds=40):
    """The fixed point of the iteration, in float64. In each round the pairs, weights and metric are
    held fixed, and scipy solves for the motion."""
    transform, tree = np.array(initial, np.float64), cKDTree(target.points)
    for _ in range(rounds):
        moved = solids.move(transform, source.points)
        distance, partner = tree.query(moved)
        weight = np.maximum(1 - (distance / stage.cut) ** 2, 0)  # a residual's; squared in the cost
        planes = [
            np.eye(3) - (1 - stage.thickness) * normals[:, :, None] * normals[:, None, :]
            for normals in (source.normals @ transform[:3, :3].T, target.normals[partner])
        ]
        half = np.linalg.cholesky(np.linalg.inv(planes[0] + planes[1])).transpose(0, 2, 1)

        def whitened(twist, moved=moved, partner=partner, half=half, weight=weight):
            there = Rotation.from_rotvec(twist[:3]).apply(moved) + twist[3:]
            off = np.einsum("nij,nj->ni", half, there - target.points[partner])
            return (weight[:, None] * off).ravel()

        twist = least_squares(whitened, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        change = solids.motion(0, translation=twist[3:])
        change[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
        transform = change @ transform
        if np.abs(twist).max() < 1e-9:
            break
    return transform


@pytest.mark.parametrize("thickness", [0.01, 0.1])
def test_it_ends_where_an_independent_minimizer_of_the_same_cost_does(thickness):
    stage = Stage(0.2, thickness)
    source, target = solids.lopsided(120, 0, 0.005), solids.lopsided(150, 1, 0.005)
    initial = solids.motion(3, translation=(0.02, 0, 0.01))
    wanted = oracle_icp(source, target, initial, stage)

    # the same stage four times, so that it has as many steps as it may need
    found = REFINE(
        surface(source), surface(target), jnp.asarray(initial, jnp.float32), stages=(stage,) * 4
    )

    assert bool(found.converged)
    np.testing.assert_allclose(found.transform, wanted, atol=2e-4)

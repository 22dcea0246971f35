"""The table of refinements: its entries, and how to add one from outside and use it."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax import cli, io, refine
from cfr_jax.alignment.align import align
from cfr_jax.batch.stream import align_many
from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry
from cfr_jax.evaluation.methods import methods_of
from cfr_jax.refine.surfaces import Fit, HostSurface, Surface

TRUTH = solids.motion(25)
STEPS = 7


def fit_points(source, target):
    """The rigid motion by Kabsch (1976), in numpy."""
    middles = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - middles[1]).T @ (source - middles[0]))
    u[:, 2] *= np.linalg.det(u @ vt)
    moved = np.eye(4)
    moved[:3, :3] = u @ vt
    moved[:3, 3] = middles[1] - u @ vt @ middles[0]
    return moved


def toy(source, target, initial):
    """Point-to-point ICP with a fixed number of steps."""
    assert isinstance(source, HostSurface) and source.points.dtype == np.float64
    tree = target.once("toy", lambda: cKDTree(target.points))
    for _ in range(STEPS):
        partners = target.points[tree.query(solids.move(initial, source.points))[1]]
        initial = fit_points(source.points, partners)
    return Fit(initial, True, False, STEPS)


def shift(source, target, initial):
    """Lays centroid on centroid, in a way that JAX can trace."""
    assert isinstance(source, Surface)
    middles = [jnp.mean(side.points, axis=0, where=side.mask[:, None]) for side in (source, target)]
    moved = initial.at[:3, 3].set(middles[1] - initial[:3, :3] @ middles[0])
    return Fit(moved, jnp.array(True), jnp.array(True), jnp.array(1, jnp.int32))


@pytest.fixture
def table(monkeypatch):
    """The table of refinements, restored after the test."""
    monkeypatch.setattr(refine, "_TABLE", dict(refine._TABLE))
    refine.add(refine.Refinement("toy", "ICP for a test", toy))
    refine.add(refine.Refinement("shift", "centroids for a test", shift, traceable=True))


@pytest.fixture(scope="module")
def pair():
    return solids.two_samplings(512, TRUTH)


@pytest.fixture(scope="module")
def plain(pair):
    return align(*pair, refine=False)


@pytest.mark.parametrize("name", ["toy", f"{__name__}:toy"])
def test_a_refinement_from_outside_refines_what_the_network_answers(table, pair, plain, name):
    found = align(*pair, refine=name)

    assert np.array_equal(found.transforms, plain.transforms)
    assert found.steps == STEPS and found.refined and not found.converged
    # the toy's effect shows in the points that the network saw, which are all points here
    source, target = pair
    away = [
        np.square(cKDTree(target).query(solids.move(motion, source))[0]).mean()
        for motion in (plain.transform, found.transform)
    ]
    assert away[1] < away[0]


def test_one_that_makes_it_worse_is_not_taken(table, pair, plain):
    def away(source, target, initial):
        return Fit(solids.motion(90) @ initial, True, True, 1)

    refine.add(refine.Refinement("away", "worse", away))

    found = align(*pair, refine="away")

    assert not found.refined
    np.testing.assert_array_equal(found.transform, plain.transform)


def test_one_that_sees_every_point_gets_all_of_them(table, pair):
    seen = []

    def count(source, target, initial):
        seen.append((len(source.points), source.thinned_to, len(target.points)))
        return Fit(initial, False, True, 3)

    refine.add(refine.Refinement("count", "looks at points", count, every_point=True))

    found = align(*pair, refine="count", max_points=128)

    assert seen == [(len(pair[0]), 128, len(pair[1]))]
    away, _ = cKDTree(pair[1]).query(solids.move(found.transform, pair[0]))
    assert found.steps == 3
    assert found.fitness == pytest.approx(np.mean(away <= found.inlier_distance))


def test_one_that_jax_can_trace_becomes_part_of_the_program(table, pair):
    found = align(*pair, refine="shift", second_look=False)
    (many,) = align_many([pair], refine="shift", second_look=False)

    assert found.steps == 1 and found.converged
    np.testing.assert_allclose(many.alignment.transform, found.transform, atol=1e-5)
    middle = solids.move(found.transform, pair[0].mean(axis=0)[None])[0]
    np.testing.assert_allclose(middle, pair[1].mean(axis=0), atol=1e-4)


def test_many_pairs_are_refined_by_what_jax_can_trace_alone(table, pair):
    with pytest.raises(ValueError, match="^refine: got 'toy', which runs on the host"):
        align_many([pair], refine="toy")


@pytest.mark.parametrize("name", ["toy", f"{__name__}:toy"])
def test_the_command_takes_it_by_name(table, pair, tmp_path, capsys, name):
    files = [str(tmp_path / f"{side}.ply") for side in ("source", "target")]
    for path, points in zip(files, pair, strict=True):
        io.write(path, io.PointCloud(points))

    assert cli.main(["register", *files, "--refine", name, "--json", "-"]) == 0

    assert json.loads(capsys.readouterr().out)["steps"] == STEPS


def test_a_config_takes_it_by_name(table, pair):
    entry = MethodEntry("cfr", {"refine": "toy", "through": "align"})
    config = EvaluationConfig("title", {"kind": "pairs"}, {"own": entry})
    (method,) = methods_of(config, (), seed=0)

    (answer,) = method.make()([Pair("pair", *pair)])

    found = align(*pair, refine="toy")
    np.testing.assert_array_equal(answer.transforms[-1], found.transform)


def test_a_name_is_given_once(table):
    with pytest.raises(ValueError, match="^name: got 'toy', wanted a name that is not taken"):
        refine.add(refine.Refinement("toy", "again", toy))


def matrix_only(source, target, initial):
    return initial


def test_one_that_returns_no_fit_is_named_with_what_it_returned(unchecked, pair, tmp_path, capsys):
    files = [str(tmp_path / f"{side}.ply") for side in ("source", "target")]
    for path, points in zip(files, pair, strict=True):
        io.write(path, io.PointCloud(points))

    code = cli.main(["register", *files, "--refine", f"{__name__}:matrix_only"])

    wanted = f"refine: {__name__}:matrix_only returned a ndarray, wanted a cfr_jax.refine.surfaces"
    assert code == 2 and wanted in capsys.readouterr().err


def test_what_is_no_refinement_is_refused(unchecked):
    with pytest.raises(ValueError, match="^refinement: got <function .*, wanted a Refinement"):
        refine.add(matrix_only)


@pytest.mark.parametrize("wrong", ["icp", "no_such_module:refine", f"{__name__}:no_such", "a:"])
def test_what_is_not_there_is_refused_with_what_there_is(unchecked, wrong):
    with pytest.raises(ValueError, match=f"^refine: got '{wrong}'.*(small_gicp|imported)"):
        refine.find(wrong)


@pytest.mark.parametrize("name", refine.names())
def test_every_entry_says_what_it_is_and_has_a_function(name):
    entry = refine.named(name)

    assert entry.title and callable(entry.function())

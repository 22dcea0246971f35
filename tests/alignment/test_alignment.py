"""`align` end to end with the shipped weights: the motions it finds, and changes of the input that
do not change the answer.

Nearly all clouds here have 417 to 512 points, so they share one compiled program.
"""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import solids

import cfr_jax
from cfr_jax.alignment.align import align
from cfr_jax.geometry import units
from cfr_jax.runtime import programs

DEMO = Path(cfr_jax.__file__).parent / "cli" / "demo_pair"
TRUTH = solids.motion(25)


@pytest.fixture(scope="module")
def pair():
    """Two noisy samplings of one shape, with the target moved by TRUTH."""
    return solids.two_samplings(500, TRUTH)


@pytest.fixture(scope="module")
def answer(pair):
    return align(*pair)


def off_at(first, second, points):
    """The distance between the places to which two motions carry the centroid of `points`."""
    center = points.mean(axis=0)
    return np.linalg.norm(solids.move(first, center) - solids.move(second, center))


# --- what it finds ---


def test_a_moved_shape_is_found(pair, answer):
    assert solids.degrees_between(answer.transform, TRUTH) < 1
    assert off_at(answer.transform, TRUTH, pair[0]) < 0.01
    assert answer.refined and answer.determined
    assert answer.fitness > 0.3 and 0 < answer.inlier_rmse <= answer.inlier_distance


def test_the_demo_pair_is_found():
    truth = np.array(json.loads((DEMO / "truth.json").read_text())["transform"])

    found = align(DEMO / "source.ply", str(DEMO / "target.ply"))

    assert solids.degrees_between(found.transform, truth) < 2
    assert found.determined and not found.warnings


def test_the_answer_is_a_rigid_motion_in_float64(answer):
    for transform in (answer.transform, *answer.transforms):
        assert transform.dtype == np.float64
        assert np.abs(transform[:3, :3] @ transform[:3, :3].T - np.eye(3)).max() < 1e-12
        assert np.linalg.det(transform[:3, :3]) > 0
        assert transform[3].tolist() == [0, 0, 0, 1]


def test_the_answer_describes_every_used_point(pair, answer):
    assert answer.source_rows.tolist() == answer.target_rows.tolist() == list(range(500))
    assert answer.weights.shape == (500,)
    assert (answer.weights >= 0).all() and (answer.weights <= 1 + 1e-5).all()
    assert answer.neighbors == 64 and answer.transforms.shape == (10, 4, 4)
    assert answer.trusted == (answer.determined and answer.confidence >= 0.5)
    assert bool(answer.warnings) == (not answer.trusted)


def test_without_refinement_the_networks_last_answer_stands(pair, answer):
    found = align(*pair, refine=False)

    assert np.array_equal(found.transform, found.transforms[-1]) and not found.refined
    np.testing.assert_allclose(found.transforms, answer.transforms, atol=1e-5)


def test_a_large_motion_is_found_from_a_start_near_it(pair):
    truth = solids.motion(120, (1, -1, 0.5))
    target = solids.move(truth @ np.linalg.inv(TRUTH), pair[1])
    initial = solids.motion(20, (0, 1, 1), (0.05, 0, -0.05)) @ truth

    found = align(pair[0], target, initial=initial.astype(np.float32))

    assert solids.degrees_between(found.transform, truth) < 1
    assert off_at(found.transform, truth, pair[0]) < 0.01
    assert np.abs(found.transform[:3, :3] @ found.transform[:3, :3].T - np.eye(3)).max() < 1e-12


# --- what changes nothing ---


@pytest.mark.parametrize("count", [500, 3000])
def test_map_coordinates_change_nothing(count):
    source, target = (solids.lopsided(count, seed, 0.003).points for seed in (0, 1))
    target, far = solids.move(TRUTH, target), np.array([5e6, -5e6, 5e6])

    near = align(source, target, max_points=500)
    found = align(source + far, target + far, max_points=500)

    assert found.source_rows.tolist() == near.source_rows.tolist()
    assert solids.degrees_between(found.transform, near.transform) < 1e-4
    center = source.mean(axis=0)
    arrived = solids.move(found.transform, center + far) - far
    assert np.linalg.norm(arrived - solids.move(near.transform, center)) < 1e-3


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_change_nothing_but_the_units(pair, answer, scale):
    found = align(*(scale * cloud for cloud in pair))

    assert solids.degrees_between(found.transform, answer.transform) < 1e-3
    assert np.abs(found.transform[:3, 3] / scale - answer.transform[:3, 3]).max() < 1e-4
    assert found.inlier_rmse / scale == pytest.approx(answer.inlier_rmse, rel=1e-3)
    assert found.inlier_distance / scale == pytest.approx(answer.inlier_distance, rel=1e-9)


def test_the_answer_moves_along_with_the_target(pair, answer):
    shift = np.array([3.0, -2.0, 1.0])

    found = align(pair[0], pair[1] + shift)

    wanted = answer.transform + np.pad(shift[:, None], ((0, 1), (3, 0)))
    np.testing.assert_allclose(found.transform, wanted, atol=1e-5)


@pytest.mark.parametrize("which", [0, 1])
def test_the_order_of_the_points_changes_nothing(pair, answer, which):
    # small enough to use all points; in a larger cloud, another order changes which are drawn
    order = np.random.default_rng(0).permutation(500)
    clouds = list(pair)
    clouds[which] = clouds[which][order]

    found = align(*clouds)

    np.testing.assert_allclose(found.transform, answer.transform, atol=1e-4)
    wanted = answer.weights[order] if which == 0 else answer.weights
    np.testing.assert_allclose(found.weights, wanted, atol=1e-3)


def test_padding_changes_nothing(pair, answer, monkeypatch):
    monkeypatch.setattr(units, "bucket", lambda count: 640)

    found = align(*pair)

    np.testing.assert_allclose(found.transforms, answer.transforms, atol=1e-5)
    np.testing.assert_allclose(found.transform, answer.transform, atol=1e-5)
    np.testing.assert_allclose(found.weights, answer.weights, atol=1e-4)
    assert found.fitness == pytest.approx(answer.fitness, abs=2 / 500)
    assert found.confidence == pytest.approx(answer.confidence, abs=1e-2)


def test_lists_and_other_numbers_are_clouds_too(pair, answer):
    found = align(pair[0].tolist(), pair[1])
    assert np.array_equal(found.transform, answer.transform)

    coarse = align(np.round(1000 * pair[0]).astype(np.int32), 1000 * pair[1].astype(np.float32))
    assert solids.degrees_between(coarse.transform, TRUTH) < 1


def test_the_same_call_gives_the_same_bits(pair, answer):
    again = align(*pair)

    assert np.array_equal(again.transforms, answer.transforms)
    assert np.array_equal(again.transform, answer.transform)
    assert np.array_equal(again.weights, answer.weights)
    assert again.confidence == answer.confidence
    assert again == answer and not again != answer


def test_answers_that_differ_anywhere_but_in_the_time_are_not_equal(answer):
    slower = dataclasses.replace(answer, seconds={"run": 1e9})

    assert slower == answer
    assert dataclasses.replace(answer, starts=2) != answer
    assert dataclasses.replace(answer, transform=2 * answer.transform) != answer
    assert answer != "an answer"


def test_a_fresh_process_gives_the_same_bits(tmp_path):
    clouds = [tmp_path / f"{seed}.npy" for seed in (0, 1)]
    for seed, path in enumerate(clouds):
        np.save(path, solids.lopsided(3000, seed, 0.003).points)
    here = align(*clouds, max_points=500, seed=3)

    script = (
        "import sys, cfr_jax\n"
        "found = cfr_jax.align(*sys.argv[1:], max_points=500, seed=3)\n"
        "print(found.transform.tobytes().hex(), found.source_rows.tobytes().hex())"
    )
    cache = {
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    there = subprocess.run(
        [sys.executable, "-c", script, *map(str, clouds)],
        capture_output=True, text=True, check=True, env=os.environ | cache,
    )  # fmt: skip

    assert there.stdout.split() == [
        here.transform.tobytes().hex(),
        here.source_rows.tobytes().hex(),
    ]


def test_the_seed_chooses_the_points():
    source, target = (solids.lopsided(3000, seed, 0.003).points for seed in (0, 1))

    first, other = (align(source, target, max_points=500, seed=seed) for seed in (0, 1))

    assert first.source_rows.tolist() != other.source_rows.tolist()
    assert len(first.source_rows) == len(first.target_rows) == 500
    assert solids.degrees_between(first.transform, other.transform) < 1


def test_a_size_in_the_same_bucket_is_not_compiled_again(pair, answer):
    before = programs._program.cache_info()

    found = align(pair[0][:430], pair[1][:470])

    after = programs._program.cache_info()
    assert (after.hits, after.misses) == (before.hits + 1, before.misses)
    assert found.seconds["compile"] < found.seconds["run"] < found.seconds["total"]


def test_a_stray_point_is_left_out_and_changes_little(pair):
    found = align(np.concatenate([pair[0], [[1e6, 0, 0]]]), pair[1])

    assert solids.degrees_between(found.transform, TRUTH) < 1
    assert 500 not in found.source_rows


def test_64_bit_jax_changes_nothing(pair, answer):
    params = cfr_jax.load_params()
    programs._program.cache_clear()

    with jax.enable_x64(True):
        found = align(*pair, params=params)

    programs._program.cache_clear()
    np.testing.assert_allclose(found.transform, answer.transform, atol=1e-5)

"""The scene: what it accepts, what it refuses, and from where the camera sees it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.viewer.camera import best_view
from cfr_jax.viewer.scene import Scene


def motion(axis_angle=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)):
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec(axis_angle).as_matrix()
    transform[:3, 3] = translation
    return transform


def arguments(**changes):
    rng = np.random.default_rng(0)
    return {
        "source": rng.normal(size=(5, 3)),
        "target": rng.normal(size=(7, 3)),
        "transforms": np.stack([np.eye(4), motion((0.1, 0.2, 0.3), (1, 2, 3))]),
        "labels": ("start", "refined"),
        **changes,
    }


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])
SCALED = np.diag([2.0, 2.0, 2.0, 1.0])
UNKNOWN = np.full((4, 4), np.nan)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("source", np.zeros((5, 2))),
        ("source", np.zeros((0, 3))),
        ("source", "cloud.ply"),
        ("source", np.full((5, 3), np.nan)),
        ("target", np.zeros(3)),
        ("target", np.full((7, 3), np.inf)),
        ("transforms", np.eye(4)),
        ("transforms", np.eye(4)[None]),
        ("transforms", np.stack([np.eye(4), MIRRORED])),
        ("transforms", np.stack([np.eye(4), SCALED])),
        ("transforms", np.stack([np.eye(4), UNKNOWN])),
        ("transforms", np.stack([np.eye(4), motion((0.5, 0, 0), (0, 0, 1)).T])),
        ("labels", ("start",)),
        ("labels", "ab"),
        ("weights", np.ones(4)),
        ("weights", np.full(5, -0.1)),
        ("weights", np.full(5, np.inf)),
        ("facts", {"fitness": 0.7}),
        ("warnings", "one sentence"),
    ],
)
def test_a_malformed_argument_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name}"):
        Scene(**arguments(**{name: value}))


def test_weights_may_be_unknown_and_a_point_unused():
    assert Scene(**arguments()).weights is None
    weights = Scene(**arguments(weights=[0.0, 0.5, 1.0, np.nan, 1.0001])).weights
    np.testing.assert_array_equal(np.isnan(weights), [False, False, False, True, False])


def test_later_changes_to_the_callers_arrays_do_not_reach_the_scene():
    given = arguments(facts={"fitness": "0.7"})
    scene = Scene(**given)
    before = scene.source.copy()

    given["source"][:] = 9.0
    given["facts"]["fitness"] = "0.9"

    np.testing.assert_array_equal(scene.source, before)
    assert scene.facts["fitness"] == "0.7"
    with pytest.raises(ValueError, match="read-only"):
        scene.source[0] = 0.0


def test_a_station_moves_the_original_source_by_its_own_transform():
    scene = Scene(**arguments())
    homogeneous = np.c_[scene.source, np.ones(5)]
    np.testing.assert_allclose(
        scene.moved(1), (homogeneous @ scene.transforms[1].T)[:, :3], atol=1e-14
    )
    np.testing.assert_array_equal(scene.moved(0), scene.source)


def test_a_flat_shape_is_seen_from_its_broad_side_and_the_right_way_up():
    rng = np.random.default_rng(1)
    plate = rng.uniform(-1, 1, size=(400, 3)) * [3.0, 0.1, 2.0]  # wide in x, high in z
    view = best_view(Scene(**arguments(source=plate, target=plate, transforms=[np.eye(4)] * 2)))

    right, up, toward = view.rotation
    assert abs(toward[1]) > 0.7 and up[2] > 0.7 and abs(right[0]) > 0.7
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.rotation) == pytest.approx(1.0)


def test_the_frame_holds_a_distant_start_and_ignores_a_stray_point():
    rng = np.random.default_rng(2)
    ball = rng.normal(size=(1000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    stray = np.concatenate([ball, [[500.0, 0.0, 0.0]]])
    stations = [motion(translation=(30, 0, 0)), np.eye(4)]
    view = best_view(Scene(**arguments(source=ball, target=stray, transforms=stations)))

    np.testing.assert_allclose(view.center, 0.0, atol=0.1)
    assert 30 < view.radii[0] < 33 and 0.9 < view.radii[1] < 1.2


def test_clouds_of_one_point_also_have_a_frame():
    view = best_view(Scene(**arguments(source=[[4e6, 0, 0]], target=[[4e6, 0, 0]])))
    assert np.isfinite(view.rotation).all() and (view.radii > 0).all()

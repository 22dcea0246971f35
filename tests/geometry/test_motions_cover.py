"""The cover of SO(3): proper rotations, and no rotation is far from all of them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cfr_jax.geometry.motions import cover


def farthest(rotations, probes):
    """The largest angle from any of `probes` to the nearest of `rotations`, in degrees."""
    quaternions = Rotation.from_matrix(rotations).as_quat()
    chord = cKDTree(np.concatenate([quaternions, -quaternions])).query(probes.as_quat())[0]
    return np.degrees(4 * np.arcsin(np.minimum(chord.max() / 2, 1)))


@pytest.mark.parametrize(("count", "radius"), [(64, 61), (128, 46), (256, 37)])
def test_no_rotation_is_farther_from_the_cover_than_its_docstring_says(count, radius):
    rotations = cover(count)

    found = farthest(rotations, Rotation.random(100_000, random_state=0))

    assert radius - 3 < found < radius


@pytest.mark.parametrize("count", [1, 2, 128])
def test_all_are_proper_rotations_and_always_the_same(count):
    rotations = cover(count)

    assert rotations.shape == (count, 3, 3)
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * count, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    assert np.array_equal(rotations, cover(count))


def test_no_two_rotations_are_close():
    quaternions = Rotation.from_matrix(cover(128)).as_quat()

    cosine = np.abs(quaternions @ quaternions.T) - 2 * np.eye(128)

    assert np.degrees(2 * np.arccos(cosine.max())) > 30


def test_a_cover_of_zero_rotations_is_refused():
    with pytest.raises(ValueError, match="^count: got 0"):
        cover(0)

"""SE(3) on the host, against scipy's matrix exponential and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from cfr_jax.geometry import twists


def generator(twist: np.ndarray) -> np.ndarray:
    """The (4, 4) matrix whose exponential is the motion."""
    made = np.zeros((4, 4))
    made[:3, :3], made[:3, 3] = np.cross(twist[:3], np.eye(3)).T, twist[3:]
    return made


@pytest.fixture
def some() -> np.ndarray:
    drawn = np.random.default_rng(3).normal(size=(40, 6))
    drawn[:5] *= 1e-5
    drawn[5] = 0.0
    turns = np.linalg.norm(drawn[:, :3], axis=1, keepdims=True)
    drawn[:, :3] *= np.minimum(1, 3.0 / np.maximum(turns, 1e-9))  # within pi
    return drawn


def test_exp_is_the_matrix_exponential(some):
    wanted = np.stack([expm(generator(twist)) for twist in some])
    np.testing.assert_allclose(twists.exp(some), wanted, atol=1e-12)


def test_log_is_the_inverse_of_exp(some):
    np.testing.assert_allclose(twists.log(twists.exp(some)), some, atol=1e-11)


def test_inverse_undoes_each_motion(some):
    moved = twists.exp(some)
    np.testing.assert_allclose(
        twists.inverse(moved) @ moved, np.broadcast_to(np.eye(4), moved.shape), atol=1e-12
    )


def test_the_adjoint_carries_a_twist_through_a_motion(some):
    # given
    motion, carried = twists.exp(some[::-1]), some
    # when
    other = np.einsum("nij,nj->ni", twists.adjoint(motion), carried)
    # then
    np.testing.assert_allclose(motion @ twists.exp(carried), twists.exp(other) @ motion, atol=1e-10)


def test_the_left_jacobian_is_that_of_finite_differences(some):
    step = 1e-6
    for twist, found in zip(some, twists.left_jacobian(some), strict=True):
        back = twists.inverse(twists.exp(twist))
        columns = [
            (
                twists.log(twists.exp(twist + step * axis) @ back)
                - twists.log(twists.exp(twist - step * axis) @ back)
            )
            / (2 * step)
            for axis in np.eye(6)
        ]
        np.testing.assert_allclose(found, np.stack(columns, axis=1), atol=1e-7)

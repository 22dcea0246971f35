"""Which shapes count as nearly symmetric: a rule on the shape alone."""

import dataclasses

import numpy as np
import pytest
import solids
from scipy.spatial.transform import Rotation

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import symmetry
from cfr_jax.evaluation.symmetry import LIMIT, asymmetry, nearly_symmetric

COUNT = 900


def prism(sides: int, seed: int = 0) -> np.ndarray:
    """An upright prism over a regular polygon, its mantle alone."""
    rng = np.random.default_rng(seed)
    corners = 2 * np.pi * np.arange(sides + 1) / sides
    corners = np.stack([np.cos(corners), np.sin(corners)], axis=1)
    side, along = rng.integers(sides, size=COUNT), rng.random((COUNT, 1))
    flat = corners[side] * (1 - along) + corners[side + 1] * along
    return np.column_stack([flat, rng.uniform(-0.8, 0.8, COUNT)])


def handled(seed: int = 0) -> np.ndarray:
    """A round prism with a handle in its upper half, a tenth of its points."""
    points = prism(40, seed)
    turn = np.linspace(-np.pi / 2, np.pi / 2, COUNT // 10)
    points[: len(turn)] = np.stack(
        [1 + 0.8 * np.cos(turn), 0 * turn, 0.4 + 0.4 * np.sin(turn)], axis=1
    )
    return points


@pytest.mark.parametrize("sides", [3, 5, 40])
def test_prisms_lie_on_themselves_however_they_stand(sides):
    points = prism(sides)
    turn = Rotation.random(random_state=sides).as_matrix()
    for shape in (points, 3 * points @ turn.T + 5):
        assert 0.8 < asymmetry(shape) < 1.5


@pytest.mark.parametrize("shape", [handled(), solids.lopsided(COUNT, 0).points])
def test_a_handle_or_a_tower_breaks_the_symmetry(shape):
    assert asymmetry(shape) > LIMIT


def test_a_shape_without_extent_is_symmetric():
    assert asymmetry(np.ones((9, 3))) == 1.0


def test_pairs_are_told_apart_and_what_was_found_is_kept(tmp_path, monkeypatch):
    # given
    def pair(shape):
        return Pair("", shape, shape, clean_source=shape, clean_target=shape)

    pairs = [pair(prism(4)), pair(handled())]
    path = tmp_path / "cache" / "symmetries.json"

    # when
    first = nearly_symmetric(pairs, path)
    monkeypatch.setattr(symmetry, "asymmetry", lambda points: 1 / 0)
    second = nearly_symmetric(pairs, path)

    # then
    assert first.tolist() == second.tolist() == [True, False]
    assert nearly_symmetric([dataclasses.replace(pairs[0], clean_target=None)], path) is None

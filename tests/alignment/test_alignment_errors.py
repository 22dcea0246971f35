"""Input that `align` rejects, always with the name of the argument."""

import numpy as np
import pytest
import solids

from cfr_jax.alignment.align import align

CLOUD = solids.lopsided(100, 0).points


def spoiled(value):
    points = CLOUD.copy()
    points[7, 1] = value
    return points


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (np.zeros((0, 3)), "no points"),
        (CLOUD[:1], "got 1 points, wanted at least 3"),
        (CLOUD[:2], "got 2 points, wanted at least 3"),
        (CLOUD.T, "did you mean .T"),
        (CLOUD[:, :2], "(n, 3)"),
        (CLOUD[0], "(n, 3)"),
        (CLOUD[None], "did you mean [0]"),
        (spoiled(np.nan), "point 7"),
        (spoiled(np.inf), "point 7"),
        (CLOUD.astype(complex), "complex128"),
        (CLOUD.astype(str), "floats or integers"),
        ([[1, 2, 3], [4, 5]], "array"),
        (None, "NoneType"),
        (np.ones((50, 3)), "lie in one place"),
        ("nowhere.ply", "nowhere.ply"),
        (np.ma.masked_greater(CLOUD, 0.9), "masked values, wanted an array without"),
    ],
)
@pytest.mark.parametrize("name", ["source", "target"])
def test_a_bad_cloud_is_refused_by_name(name, bad, told):
    clouds = {"source": CLOUD, "target": CLOUD} | {name: bad}

    with pytest.raises(ValueError) as caught:
        align(**clouds)

    message = str(caught.value)
    assert told in message and (message.startswith(name) or isinstance(bad, str))


@pytest.mark.parametrize(
    "initial",
    [
        "everywhere",
        [[1, 2], [3]],
        np.zeros((0, 4, 4)),
        {"transform": 1},
        np.eye(3),
        np.full((4, 4), np.nan),
        2 * np.eye(4),
        np.diag([1.0, 1, -1, 1]),
        np.eye(4) + np.eye(4)[[3, 0, 1, 2]],
        solids.motion(0, translation=(1e6, 0, 0)),
        solids.motion(0, translation=(1e300, 0, 0)),
        1e200 * np.eye(4),
        np.eye(4) + 0j,
        [[10**400, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        np.eye(4).astype(str),
        np.full((4, 4), 10**400, object),
        np.zeros((4, 4), "M8[s]"),
        [[]] * 4,
    ],
)
def test_a_bad_initial_motion_is_refused_by_name(unchecked, initial):
    with pytest.raises(ValueError, match="^initial: "):
        align(CLOUD, CLOUD, initial=initial)


@pytest.mark.parametrize(
    "argument",
    [{"max_points": bad} for bad in (2, 0, -1, 10.5, True, "10")]
    + [{"seed": bad} for bad in (-1, 0.5, None, "0")]
    + [{"params": bad} for bad in ("weights.safetensors", {}, {1: 2}, {"cascade": 3}, 7, [])]
    + [{"params": {"cascade": {"kernel": np.zeros(3, np.float32)}}}],
)
def test_other_bad_arguments_are_refused_by_name(unchecked, argument):
    [name] = argument

    with pytest.raises(ValueError, match=f"^{name}: got "):
        align(CLOUD, CLOUD, **argument)

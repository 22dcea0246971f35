"""Doubts about an answer: warnings in words, and limits on its confidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import confidence
from cfr_jax.alignment.planning import SETTINGS, SIZES_APART
from cfr_jax.alignment.scaling import ratios
from cfr_jax.geometry import motions
from cfr_jax.networks.probability import Calibration

# With a resistance below this, the fit hardly suffers when a cloud slides or turns. Among planes,
# spheres, cylinders, cones and similar shapes, sampled twice with 200 to 500 noisy points, 97%
# measured less along their free directions. Among partial views of real objects, about three
# quarters measured more.
FREE = 0.08
TRUSTED = 0.5
_HARDLY = 0.2  # with less of the source on the target, nobody can say what the shapes determine
_INLIERS = 30.0  # 21 inliers allow a confidence of 0.5, and a hundred allow 0.96
# Two views of one thing may differ in radius by the first factor, and two scans of it in the
# spacing of their points by the second one. Most units differ by more.
_PARTS_APART, _SPACINGS_APART = 2.0, 3.0


def warnings_of(
    free: Float[np.ndarray, " 6"] | None,
    rivals: Sequence[str],
    probability: float | None,
    fitness: float,
    neighbors: int,
    size_ratio: float,
    searched: bool,
    remarks: Sequence[str] = (),
    spacing_ratio: float | None = None,
) -> tuple[str, ...]:
    """All warnings about an answer, in words.

    `free` is a twist that the clouds do not determine, if there is one. `rivals` describes how the
    alternative motions differ from the answer (`turns`). `probability` is None if the weights have
    no calibration. `size_ratio` is the source's radius divided by the target's. `searched` tells
    whether starts far from the first were tried. `remarks` come first (`Plan.remarks`).
    `spacing_ratio` is like `size_ratio`, for the distances between neighboring points, if known.
    """
    warnings = list(remarks)
    if told := _sizes_in_words(size_ratio, spacing_ratio):
        warnings.append(told)
    if fitness < _HARDLY:
        warnings.append(f"the clouds hardly meet: {fitness:.0%} of the source lies on the target")
    elif free is not None:
        warnings.append(f"the clouds do not determine the motion: they {_describe(free)} freely")
    if rivals:
        warnings.append(f"nearly symmetric: the source fits about as well {' or '.join(rivals)}")
    if probability is None:
        warnings.append(
            "not to be trusted: these weights carry no calibration (`cfr calibrate` fits one), so "
            "nothing is known about how likely the answer is right"
        )
    elif not trusted(probability):
        hint = "" if searched else '; if the clouds are turned far, try initial="global" (--global)'
        warnings.append(
            f"not to be trusted: confidence {probability:.2f}, "
            f"{fitness:.0%} of the source lies on the target{hint}"
        )
    if neighbors < SETTINGS.neighbors:
        warnings.append(
            f"small clouds: {neighbors} neighbors per point instead of {SETTINGS.neighbors}"
        )
    return tuple(warnings)


def probability(
    fitted: Calibration | None,
    clues: Mapping[str, float],
    fitness: float,
    inliers: float = math.inf,
    rivals: int = 0,
) -> float | None:
    """The probability that the answer is right: the calibration's, with three upper bounds. None
    without a calibration.

    A calibration is fitted to clouds of hundreds of points that meet, without rivals, and does not
    hold for others. So the probability is at most

    - the fitness, if the clouds hardly meet;
    - 1 / (1 + r) with r `rivals`, because each of them is as likely right as the answer;
    - 1 - exp(-n / 30) with n `inliers` (points of the source that lie on the target), because a few
      points of noise can always be laid on a few others.
    """
    told = confidence.of_alignment(fitted, clues)
    if told is None:
        return None
    if fitness < _HARDLY:
        told = min(told, fitness)
    return min(told, 1 / (1 + rivals), 1 - math.exp(-inliers / _INLIERS))


def trusted(probability: float | None) -> bool:
    """Whether an answer is more likely right than wrong. An unknown probability is not enough."""
    return probability is not None and probability >= TRUSTED


def of_scale(confidence: float | None) -> tuple[str, ...]:
    """A warning if the factor of scale was estimated and may be wrong; None: it was not
    estimated."""
    if confidence is None or trusted(confidence):
        return ()
    return (
        f"not to be trusted: the clouds leave the factor of scale open (confidence "
        f"{confidence:.2f}); give the factor if you know it",
    )


def _sizes_in_words(size_ratio: float, spacing_ratio: float | None) -> str:
    """What is remarkable about the sizes of the two clouds. Empty if they are similar.

    If the units differ, the sizes and the spacings of the points differ by the same factor. If only
    the sizes differ, then one cloud is a part of the other.
    """
    if 1 / SIZES_APART <= size_ratio <= SIZES_APART:
        return ""
    larger, smaller, times = "source", "target", size_ratio
    if size_ratio < 1:
        larger, smaller, times = "target", "source", 1 / size_ratio
    told = f"the {larger} is {times:.3g} times as large as the {smaller}: same units?"
    unit = ratios.nearest(1 / size_ratio)
    fits = abs(math.log(size_ratio * unit.factor)) <= math.log(_PARTS_APART)
    if spacing_ratio is not None:
        same = abs(math.log(spacing_ratio))
        if same <= math.log(_SPACINGS_APART):
            return (
                f"the {larger} is {times:.3g} times as large as the {smaller}, with points as "
                "dense: if it shows much more, cut the rest off"
            )
        fits = fits and abs(math.log(spacing_ratio * unit.factor)) <= math.log(_SPACINGS_APART)
    if not fits:
        return told
    return (
        f"{told} If the source is in {unit.source} and the target in {unit.target}, "
        f'multiply the source by {unit.factor:.4g} (scale={unit.factor:.4g}, or scale="auto")'
    )


def turns(
    transform: Float[np.ndarray, "4 4"], others: Float[np.ndarray, "a 4 4"]
) -> tuple[str, ...]:
    """Says in words how each of `others` differs from `transform`: by a turn about an axis of the
    target's frame, or by a shift."""
    told = []
    for other in others:
        turn = motions.to_rotvec(other[:3, :3] @ transform[:3, :3].T)
        angle = float(np.degrees(np.linalg.norm(turn)))
        told.append(f"turned by {angle:.0f}° about {direction(turn)}" if angle > 1 else "shifted")
    return tuple(told)


def _describe(twist: np.ndarray) -> str:
    turn, slide = twist[:3], twist[3:]
    verb, axis = (
        ("turn about", turn)
        if np.linalg.norm(turn) >= np.linalg.norm(slide)
        else ("slide along", slide)
    )
    return f"{verb} {direction(axis)}"


def direction(axis: Float[np.ndarray, " 3"]) -> str:
    """The direction of a line, written as the unit vector whose largest component is positive."""
    axis = axis / np.linalg.norm(axis)
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    axis = axis.round(2) + 0.0  # no "-0.00"
    return f"({', '.join(f'{value:.2f}' for value in axis)})"

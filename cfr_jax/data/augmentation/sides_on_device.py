"""One side of a pair, drawn on the device: its rows, its noise, and its outliers.

Arrays have fixed sizes here. So cropped points get a score of minus infinity, and a draw of n rows
without replacement takes the n highest random scores.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Int32, Key

from cfr_jax.data.augmentation.sampling import SENSOR_AWAY, Sampling
from cfr_jax.data.perturbations import NOISE_CLIP, NOISE_SCALE
from cfr_jax.geometry import rigid

_MOST = NOISE_CLIP / NOISE_SCALE  # standard deviations at which noise is clipped


class Shared(NamedTuple):
    """The random choices that both clouds of a pair share."""

    turn: Float[Array, "3 3"]
    motion: Float[Array, "4 4"]
    scale: Float[Array, ""]
    uneven: Bool[Array, ""]
    centered: Bool[Array, ""]
    sensor: Bool[Array, ""]
    estimate: Bool[Array, ""]


def draw_side(
    points: Float[Array, "p 3"],
    normals: Float[Array, "p 3"],
    placed: Float[Array, "4 4"],
    drawn: Shared,
    key: Key[Array, ""],
    sampling: Sampling,
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, " 3"]]:
    """Points and normals of one side, and the offset that was subtracted to center it."""
    of_rows, of_noise, of_outliers = random.split(key, 3)
    rows = _rows(points, drawn.uneven, of_rows, sampling)
    rotation = rigid.from_parts(drawn.turn, jnp.zeros(3))
    x = drawn.scale * rigid.rotate(rotation, points[rows])
    x = rigid.apply(placed, x)
    n = rigid.rotate(placed, rigid.rotate(rotation, normals[rows]))
    noisy = _add_noise(x, of_noise, sampling)
    if sampling.sensor_noise:
        noisy = jnp.where(drawn.sensor, _add_sensor_noise(x, of_noise, sampling), noisy)
    x = noisy
    if sampling.outliers[1]:
        x, n = _add_outliers(x, n, of_outliers, sampling)
    middle = jnp.where(drawn.centered, jnp.mean(x, axis=0), 0)
    return x - middle, n, middle


def between(key: Key[Array, ""], limits: tuple[float, float]) -> Float[Array, ""]:
    """A number drawn uniformly from a range."""
    return random.uniform(key, minval=limits[0], maxval=limits[1])


def _rows(
    points: Float[Array, "p 3"], uneven: Bool[Array, ""], key: Key[Array, ""], sampling: Sampling
) -> Int32[Array, " n"]:
    """Rows of one cloud: a crop, then `sampling.points` of its rows, as in
    `pairs_on_host.choose_rows`.

    If the crop leaves too few rows, all of them are used and some are repeated.
    """
    of_keep, of_plane, of_side, of_scores, of_more = random.split(key, 5)
    count, n = points.shape[0], sampling.points
    keep = between(of_keep, sampling.keep)
    kept = _crop(points, keep, of_plane)
    score = random.gumbel(of_scores, (count,))
    if sampling.uneven:
        height = _heights(points, of_side)
        low = jnp.min(jnp.where(kept, height, jnp.inf))
        high = jnp.max(jnp.where(kept, height, -jnp.inf))
        of_density, of_more = random.split(of_more)
        times = between(of_density, sampling.density)
        weight = jnp.log(times) * (height - low) / jnp.maximum(high - low, 1e-12)
        score = score + jnp.where(uneven, weight, 0)
    # Gumbel noise on the log weights: the largest sums are a weighted draw without replacement.
    order = jnp.argsort(jnp.where(kept, score, -jnp.inf), descending=True)
    left = jnp.maximum(jnp.sum(kept), 1)
    place = jnp.arange(n)
    again = random.randint(of_more, (n,), 0, left)
    if sampling.uneven:
        # no row is used a third time before all are used twice
        chance = jnp.where(place < left, random.uniform(of_side, (n,)), jnp.inf)
        turns = jnp.argsort(chance)[jnp.clip(place - left, 0, n - 1)]
        again = jnp.where(uneven & (place < 2 * left), turns, again)
    return order[jnp.where(place < left, place, jnp.minimum(again, left - 1))]


def _crop(
    points: Float[Array, "p 3"], keep: Float[Array, ""], key: Key[Array, ""]
) -> Bool[Array, " p"]:
    """Which points a crop keeps, a share of `keep`: those beyond a plane with a random normal, as
    in `perturbations.crop`.
    """
    count = points.shape[0]
    height = _heights(points - jnp.mean(points, axis=0), key)
    place = (1 - keep) * (count - 1)
    below = jnp.clip(jnp.floor(place), 0, count - 2)
    ordered, row = jnp.sort(height), below.astype(jnp.int32)
    plane = ordered[row] + (ordered[row + 1] - ordered[row]) * (place - below)
    return (height > jnp.where(keep == 0.5, 0, plane)) | (keep >= 1)


def _add_noise(
    x: Float[Array, "n 3"], key: Key[Array, ""], sampling: Sampling
) -> Float[Array, "n 3"]:
    of_scale, of_each = random.split(key)
    scale = between(of_scale, sampling.noise)
    return x + scale * jnp.clip(random.normal(of_each, x.shape), -_MOST, _MOST)


def _add_sensor_noise(
    x: Float[Array, "n 3"], key: Key[Array, ""], sampling: Sampling
) -> Float[Array, "n 3"]:
    of_away, of_side, of_scale, of_each = random.split(key, 4)
    away = between(of_away, SENSOR_AWAY)
    ray = x - (jnp.mean(x, axis=0) + away * _directions(of_side, 1))
    distance = jnp.maximum(jnp.sqrt(jnp.sum(ray * ray, axis=1, keepdims=True)), 1e-6)
    scale = between(of_scale, sampling.sensor_scale)
    error = jnp.clip(random.normal(of_each, distance.shape), -_MOST, _MOST)
    return x + ray / distance * error * scale * (distance / away) ** 2


def _add_outliers(
    x: Float[Array, "n 3"], n: Float[Array, "n 3"], key: Key[Array, ""], sampling: Sampling
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    of_share, of_rows, of_radius, of_place, of_normal = random.split(key, 5)
    count = x.shape[0]
    share = between(of_share, sampling.outliers)
    rank = jnp.argsort(random.uniform(of_rows, (count,)))
    out = (rank < jnp.floor(share * count).astype(jnp.int32))[:, None]
    middle = jnp.mean(x, axis=0)
    reach = jnp.sqrt(jnp.max(jnp.sum((x - middle) ** 2, axis=1)))
    radius = reach * jnp.cbrt(random.uniform(of_radius, (count, 1)))
    placed = middle + radius * _directions(of_place, count)
    return jnp.where(out, placed, x), jnp.where(out, _directions(of_normal, count), n)


def _heights(points: Float[Array, "p 3"], key: Key[Array, ""]) -> Float[Array, " p"]:
    """Heights along a random direction, summed in float32, which a GPU's matrix product is not."""
    return jnp.sum(points * _directions(key, 1), axis=1)


def _directions(key: Key[Array, ""], count: int) -> Float[Array, "n 3"]:
    drawn = random.normal(key, (count, 3))
    return drawn / jnp.sqrt(jnp.sum(drawn * drawn, axis=1, keepdims=True))

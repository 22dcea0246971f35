"""`register`: two clouds in, the rigid motion of each iteration out.

A pure function of arrays: it jits, vmaps, and differentiates with respect to parameters and clouds.
Clouds are expected about the size of the unit sphere, where the network was trained; `align` brings
any pair there and back.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax import confidence, rigid
from cfr_jax import neighbors as knn
from cfr_jax.features import PairFeature, raw_features
from cfr_jax.network import CFR
from cfr_jax.normals import estimate_normals
from cfr_jax.sinkhorn import Affinity, Form, Match, match


@dataclasses.dataclass(frozen=True)
class Settings:
    """What changes the compiled program. The defaults are the paper's."""

    neighbors: int = 64
    radius: float = 0.3
    """Neighbors further away are replaced by the nearest one; in units of the unit sphere."""
    ppf: PairFeature = "dot"
    match: Form = "auto"
    """How correspondences are found: "dense" stores the N x M affinities, "streamed" makes them
    anew whenever it needs them, "auto" streams what is large. "log space" is RPM-Net's."""
    detach_motion: bool = False
    """Stop gradients at the motion between iterations, as the paper trains."""
    # What the paper leaves out of RPM-Net, to measure what that saves. Weights answer best with
    # what they were trained with.
    passes: int | None = None
    """Sinkhorn passes of every iteration; None: i passes in iteration i."""
    repeat_annealing: bool = False
    """Predict the annealing in every iteration, from where the source is by then."""
    repeat_extraction: bool = False
    """Extract the heavy features in every iteration, from the source as it is turned by then,
    instead of handing on those of the iteration before."""


@struct.dataclass
class Cloud:
    """A cloud ready for the network: normals and neighbors known; `mask` marks valid rows."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    neighbors: Int32[Array, "n k"]
    mask: Bool[Array, " n"] | None = None


@struct.dataclass
class Encoded:
    """The reference side of a registration, computed once for any number of sources."""

    cloud: Cloud
    features: Float[Array, "L m d"]


@struct.dataclass
class Registration:
    """Answer of `register`."""

    transforms: Float[Array, "L 4 4"]
    """One motion per iteration, each from the source as given onto the target."""
    weights: Float[Array, " n"]
    """How much of each source point found a partner in the last match, in [0, 1]."""
    covered: Float[Array, " m"]
    """The same for each target point."""
    targets: Float[Array, "n 3"]
    """Where the last match puts each source point."""
    beta: Float[Array, " L"]
    """Annealing: how sharp the match of each iteration was."""
    alpha: Float[Array, " L"]
    """Annealing: how far in feature space it reached."""
    clues: confidence.NetworkClues
    """What the confidence was estimated from."""
    confidence: Float[Array, ""]
    """Estimated probability, in [0, 1], that `transform` is right to 5 degrees and 0.1; for clouds
    of unit size and the weights that ship."""

    @property
    def transform(self) -> Float[Array, "*batch 4 4"]:
        """The last motion; maps source onto target. Batched as `transforms` is, after `vmap`."""
        return self.transforms[..., -1, :, :]


@functools.partial(jax.jit, static_argnames=("settings",))
def prepare(
    points: Float[Array, "n c"],
    *,
    mask: Bool[Array, " n"] | None = None,
    neighbors: Int32[Array, "n k"] | None = None,
    settings: Settings = Settings(),
) -> Cloud:
    """A `Cloud` from raw points (n, 3), or points and normals (n, 6).

    Missing normals are estimated (`normals.estimate_normals`); missing neighbors are searched on
    the device. Fewer than K + 1 points have fewer neighbors each. Raises ValueError on wrong
    shapes.
    """
    _check_points("points", points)
    n = points.shape[0]
    if mask is not None and mask.shape != (n,):
        raise ValueError(f"mask: got shape {mask.shape}, wanted ({n},) as there are {n} points")
    if neighbors is not None and (neighbors.ndim != 2 or neighbors.shape[0] != n):
        raise ValueError(f"neighbors: got shape {neighbors.shape}, wanted ({n}, k)")
    points = points.astype(jnp.float64 if points.dtype == jnp.float64 else jnp.float32)
    normals = points[:, 3:] if points.shape[1] == 6 else None
    points = points[:, :3]
    if mask is not None:
        points = jnp.where(mask[:, None], points, 0)
    if neighbors is None:
        k = min(settings.neighbors, n - 1)
        neighbors = knn.nearest(lax.stop_gradient(points), k, radius=settings.radius, mask=mask)
    if normals is None:
        normals = estimate_normals(points, neighbors, mask)
    elif mask is not None:
        normals = jnp.where(mask[:, None], normals, 0)
    return Cloud(points, normals, neighbors, mask)


def encode(
    params: dict, target: Float[Array, "m c"] | Cloud, *, settings: Settings = Settings()
) -> Encoded:
    """The features of a reference in every iteration; hand it to `register` as the target, with the
    same settings. Raises ValueError as `register` does."""
    _check_values("target", target)
    return _encode(params, target, settings=settings)


@functools.partial(jax.jit, static_argnames=("settings",))
def _encode(params, target, *, settings):
    cloud = _prepared("target", target, settings)
    network = bind(params)
    heavy = _heavy_features(network, cloud, settings)
    if settings.repeat_extraction:
        layers = range(iterations_of(params))
        every = [network.cascade.layer(i, heavy, cloud.points, cloud.mask) for i in layers]
        return Encoded(cloud, jnp.stack(every))
    return Encoded(cloud, network.cascade.at_rest(heavy, cloud.points, cloud.mask))


def register(
    params: dict,
    source: Float[Array, "n c"] | Cloud,
    target: Float[Array, "m c"] | Cloud | Encoded,
    *,
    iterations: int | None = None,
    settings: Settings = Settings(),
) -> Registration:
    """Registers `source` onto `target`: `transform @ [x; 1]` lies on the target.

    Clouds are raw arrays, (n, 3) or with normals (n, 6), or prepared (`prepare`, for masks and
    neighbors of your own); a target may be encoded beforehand. Iteration i runs i Sinkhorn passes.
    `iterations` may be anything from 1; beyond the L of the parameters, the last layer is repeated
    on the features it was trained to receive, with its own annealing and L passes: the cloud moves
    on, the features only follow its position. Differentiates through everything but the choice of
    neighbors. Raises ValueError on wrong shapes, and for values that are no finite numbers, where
    they can be seen: inside `jit` and `vmap` they cannot, and NaN in gives NaN out.
    """
    _check_values("source", source)
    _check_values("target", target)
    return _register(params, source, target, iterations=iterations, settings=settings)


@functools.partial(jax.jit, static_argnames=("iterations", "settings"))
def _register(params, source, target, *, iterations, settings):
    iterations = iterations_of(params) if iterations is None else iterations
    if iterations < 1:
        raise ValueError(f"iterations: got {iterations}, wanted at least 1")
    source = _prepared("source", source, settings)
    if not isinstance(target, Encoded):
        target = _encode(params, target, settings=settings)
    steps = list(iterate(params, source, target, iterations, settings))
    transforms, last = jnp.stack([step.transform for step in steps]), steps[-1].match
    clues = confidence.of_network(
        transforms,
        source.points,
        last.targets,
        last.weights,
        last.covered,
        source.mask,
        target.cloud.mask,
    )
    return Registration(
        transforms=transforms,
        weights=last.weights,
        covered=last.covered,
        targets=last.targets,
        beta=jnp.stack([step.affinity.beta for step in steps]),
        alpha=jnp.stack([step.affinity.alpha for step in steps]),
        clues=clues,
        confidence=confidence.of_registration(clues),
    )


class Step(NamedTuple):
    """What one iteration found."""

    transform: Float[Array, "4 4"]
    match: Match
    affinity: Affinity


def iterate(
    params: dict, source: Cloud, target: Encoded, iterations: int, settings: Settings
) -> Iterator[Step]:
    """The iterations of `register`, one by one, for those who need what lies between (the loss).

    This is the scan over the parameters stacked on L, written out: iteration i runs i Sinkhorn
    passes, and in a compiled loop that count could not be static.
    """
    network, count = bind(params), iterations_of(params)
    reference = target.cloud
    annealing = network.annealing(source.points, reference.points, source.mask, reference.mask)
    received = features = _heavy_features(network, source, settings)
    moved = source
    for i in range(iterations):
        layer = min(i, count - 1)
        if i and settings.repeat_annealing:
            annealing = network.annealing(
                moved.points, reference.points, source.mask, reference.mask
            )
        if i and settings.repeat_extraction:
            received = _heavy_features(network, moved, settings)
        elif i == layer:
            received = features
        features = network.cascade.layer(layer, received, moved.points, source.mask)
        affinity = Affinity(
            features, target.features[layer], annealing.beta[layer], annealing.alpha[layer]
        )
        found = match(
            affinity,
            reference.points,
            passes=layer + 1 if settings.passes is None else settings.passes,
            form=settings.match,
            source_mask=source.mask,
            target_mask=reference.mask,
        )
        transform = rigid.fit_rigid(source.points, found.targets, found.weights)
        yield Step(transform, found, affinity)
        motion = lax.stop_gradient(transform) if settings.detach_motion else transform
        moved = moved_by(motion, source)


def unroll(params: dict, source: Cloud, target: Cloud, settings: Settings) -> Iterator[Step]:
    """The iterations that the parameters were made for, both clouds given as they are."""
    reference = _encode(params, target, settings=settings)
    return iterate(params, source, reference, iterations_of(params), settings)


def moved_by(motion: Float[Array, "4 4"], cloud: Cloud) -> Cloud:
    """The cloud elsewhere: points moved, normals turned."""
    points, normals = rigid.apply(motion, cloud.points), rigid.rotate(motion, cloud.normals)
    return Cloud(points, normals, cloud.neighbors, cloud.mask)


def iterations_of(params: dict) -> int:
    """L, the number of iterations that the parameters were made for."""
    return params["annealing"]["out"]["bias"].shape[0] // 2


def bind(params: dict) -> CFR:
    """The network with its parameters inside."""
    shared = params["cascade"]["kernel"].shape[0] == 1
    return CFR(iterations_of(params), shared).bind({"params": params})


def _prepared(name, cloud, settings):
    if isinstance(cloud, Cloud):
        return cloud
    _check_points(name, cloud)
    return prepare(cloud, settings=settings)


def _check_values(name, cloud):
    """What a compiled function cannot tell: kinds and values, where they are known by now."""
    if isinstance(cloud, Cloud | Encoded | jax.core.Tracer):
        return
    if not isinstance(cloud, np.ndarray | jax.Array):
        raise ValueError(
            f"{name}: got a {type(cloud).__name__}, wanted an array (n, 3) or (n, 6), "
            "or what `prepare` or `encode` returned"
        )
    _check_points(name, cloud)
    if cloud.dtype.kind not in "fiu":
        raise ValueError(f"{name}: got {cloud.dtype}, wanted floats or integers")
    wrong = np.flatnonzero(~np.isfinite(np.asarray(cloud, np.float64)).all(axis=1))
    if len(wrong):
        raise ValueError(
            f"{name}: row {wrong[0]} is not finite, and {len(wrong) - 1} more; wanted numbers"
        )


def _check_points(name, points):
    if points.ndim != 2 or points.shape[1] not in (3, 6):
        raise ValueError(
            f"{name}: got shape {points.shape}, wanted (n, 3) points or (n, 6) points and normals"
        )
    if points.shape[0] < 3:
        raise ValueError(f"{name}: got {points.shape[0]} points, wanted at least 3")


def _heavy_features(network, cloud, settings):
    raw = raw_features(cloud.points, cloud.normals, cloud.neighbors, ppf=settings.ppf)
    return network.features(raw, cloud.mask)

"""`register`: two clouds in, the rigid motion of each iteration out.

A pure function of arrays: use it under `jit` and `vmap`, and differentiate it with respect to
parameters and clouds. The network was trained on clouds about the size of the unit sphere, and
expects such clouds. `align` takes clouds of any size and place and converts both ways.
"""

from __future__ import annotations

import functools
from numbers import Integral

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.geometry import rigid
from cfr_jax.networks.cfr.checks import checked, refuse_unless
from cfr_jax.networks.cfr.iterations import Encoded, encoded, iterate, iterations_of, moved_on
from cfr_jax.networks.cfr.network import check_params
from cfr_jax.networks.clues import (
    NetworkClues,
    of_network,
    of_registration,
    root_mean_square,
)
from cfr_jax.networks.inputs import Cloud, Settings, check_points, prepare
from cfr_jax.networks.probability import calibration_of
from cfr_jax.networks.record import Params
from cfr_jax.runtime.entries import entry
from cfr_jax.runtime.values import ByValue


@struct.dataclass(eq=False)
class Registration(ByValue):
    """The answer of `register`."""

    transforms: Float[Array, "L 4 4"]
    """One motion per iteration, cascade after cascade. Each maps the source as given onto the
    target."""
    weights: Float[Array, " n"]
    """How much of each source point found a partner in the last match, in [0, 1]."""
    covered: Float[Array, " m"]
    """The same for each target point."""
    targets: Float[Array, "n 3"]
    """Where the last match puts each source point."""
    beta: Float[Array, " L"]
    """Annealing: how sharp the match of each iteration was."""
    alpha: Float[Array, " L"]
    """Annealing: how far in feature space each match reached."""
    clues: NetworkClues
    """What the confidence was estimated from."""
    confidence: Float[Array, ""] | None
    """Estimated probability, in [0, 1], that `transform` is right to within 5 degrees and 0.1. It
    holds for clouds of unit size and one cascade, and falls to zero for much smaller and larger
    ones. None if the parameters have no calibration."""

    @property
    def transform(self) -> Float[Array, "*batch 4 4"]:
        """The last motion; maps source onto target. After `vmap`, batched like `transforms`."""
        return self.transforms[..., -1, :, :]


@entry
def encode(
    params: Params,
    target: Float[Array | np.ndarray, "m c"] | Cloud,
    *,
    settings: Settings = Settings(),
) -> Encoded:
    """The features of a target in every iteration, to reuse it with many sources.

    Pass the result to `register` as the target, with the same settings. Raises ValueError as
    `register` does.
    """
    check_params(params)
    clouds = {"target": target}
    usable = checked(clouds)
    encoded = _encode(params, target, settings=settings)
    refuse_unless(usable, clouds)
    return encoded


@functools.partial(jax.jit, static_argnames=("settings",))
def _encode(params: Params, target: Array | Cloud, *, settings: Settings) -> Encoded:
    return encoded(params, _prepared("target", target, settings), settings)


@entry
def register(
    params: Params,
    source: Float[Array | np.ndarray, "n c"] | Cloud,
    target: Float[Array | np.ndarray, "m c"] | Cloud | Encoded,
    *,
    iterations: int | None = None,
    cascades: int = 1,
    settings: Settings = Settings(),
) -> Registration:
    """Registers `source` onto `target`: `transform @ [x; 1]` lies on the target.

    Clouds are arrays of JAX or numpy, (n, 3) or (n, 6) with normals, or the results of `prepare`,
    which takes masks and your own neighbors. The target may also be the result of `encode`.
    Iteration i runs i Sinkhorn passes.

    `iterations` may be any number from 1. Beyond the L iterations of the parameters, the last layer
    is repeated on the features it was trained to receive, with its own annealing and L passes: the
    cloud keeps moving, and the features only follow its position. Each of the `cascades` does all
    of this again, starting where the previous one ended. Features and annealing then see clouds
    that are nearly aligned. A further cascade takes as long as another registration onto an encoded
    target.

    Derivatives exist for everything but the choice of neighbors, which is held fixed: in reverse
    mode (`jax.grad`, `jax.jacrev`), in forward mode (`jax.jacfwd`, `jax.jvp`), and of second order
    (`jax.hessian`). Only reverse mode is written by hand to save memory; the others keep what JAX
    keeps, and take longer to compile.

    Raises ValueError for wrong shapes, for masked arrays with masked values, and for values that
    are not finite or lie so far out that float32 cannot tell points apart. Inside `jit` and `vmap`
    the values are not known, and NaN in gives NaN out. Clouds of another than unit size are not
    refused; the confidence falls. Raises RuntimeError in a process that was forked after the first
    call.
    """
    check_params(params)
    for name, count in (("iterations", iterations), ("cascades", cascades)):
        if count is not None and (isinstance(count, bool) or not isinstance(count, Integral)):
            raise ValueError(f"{name}: got {count!r}, wanted a whole number of at least 1")
    clouds = {"source": source, "target": target}
    usable = checked(clouds)
    found = _register(
        params, source, target, iterations=iterations, cascades=cascades, settings=settings
    )
    refuse_unless(usable, clouds)
    return found


@functools.partial(jax.jit, static_argnames=("iterations", "cascades", "settings"))
def _register(
    params: Params,
    source: Array | Cloud,
    target: Array | Cloud | Encoded,
    *,
    iterations: int | None,
    cascades: int,
    settings: Settings,
) -> Registration:
    iterations = iterations_of(params) if iterations is None else iterations
    for name, count in (("iterations", iterations), ("cascades", cascades)):
        if count < 1:
            raise ValueError(f"{name}: got {count}, wanted at least 1")
    source = _prepared("source", source, settings)
    reference: Encoded = (
        target if isinstance(target, Encoded) else _encode(params, target, settings=settings)
    )

    def cascade(start: Array, _: None) -> tuple[Array, dict]:
        start = lax.stop_gradient(start) if settings.detach_motion else start
        moved = moved_on(start, source, settings)
        steps = list(iterate(params, moved, reference, iterations, settings))
        transforms = jnp.stack([rigid.compose(step.transform, start) for step in steps])
        found = {
            "transforms": transforms,
            "weights": steps[-1].match.weights,
            "covered": steps[-1].match.covered,
            "targets": steps[-1].match.targets,
            "beta": jnp.stack([step.affinity.beta for step in steps]),
            "alpha": jnp.stack([step.affinity.alpha for step in steps]),
        }
        return transforms[-1], found

    # a loop, so that the cascade is compiled only once
    start = jnp.eye(4, dtype=jnp.result_type(source.points, reference.cloud.points))
    found = lax.scan(cascade, start, length=cascades)[1]
    of_all = {name: jnp.concatenate(found[name]) for name in ("transforms", "beta", "alpha")}
    of_last = {name: found[name][-1] for name in ("weights", "covered", "targets")}
    clues = of_network(
        of_all["transforms"],
        source.points,
        of_last["targets"],
        of_last["weights"],
        of_last["covered"],
        source.mask,
        reference.cloud.mask,
    )
    size = jnp.maximum(
        root_mean_square(source.points, source.mask),
        root_mean_square(reference.cloud.points, reference.cloud.mask),
    )
    confidence = of_registration(calibration_of(params), clues, size)
    return Registration(**of_all, **of_last, clues=clues, confidence=confidence)


def _prepared(name: str, cloud: Array | Cloud, settings: Settings) -> Cloud:
    if isinstance(cloud, Cloud):
        return cloud
    check_points(name, cloud)
    return prepare(cloud, settings=settings)

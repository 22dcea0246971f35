"""`register`: two clouds in, the rigid motion of each iteration out.

A pure function of arrays: it jits, vmaps, and differentiates with respect to parameters and clouds.
Clouds are expected about the size of the unit sphere, where the network was trained; `align` brings
any pair there and back.
"""

from __future__ import annotations

import functools
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.geometry import rigid
from cfr_jax.networks.cfr.iterations import Encoded, encoded, iterate, iterations_of, moved_on
from cfr_jax.networks.cfr.network import check_params
from cfr_jax.networks.clues import NetworkClues, of_network, of_registration
from cfr_jax.networks.inputs import Cloud, Settings, check_points, prepare
from cfr_jax.networks.probability import calibration_of


@struct.dataclass
class Registration:
    """Answer of `register`."""

    transforms: Float[Array, "L 4 4"]
    """One motion per iteration, cascade after cascade, each from the source as given onto the
    target."""
    weights: Float[Array, " n"]
    """How much of each source point found a partner in the last match, in [0, 1]."""
    covered: Float[Array, " m"]
    """The same for each target point."""
    targets: Float[Array, "n 3"]
    """Where the last match puts each source point."""
    beta: Float[Array, " L"]
    """Annealing: how sharp the match of each of these iterations was."""
    alpha: Float[Array, " L"]
    """Annealing: how far in feature space it reached."""
    clues: NetworkClues
    """What the confidence was estimated from."""
    confidence: Float[Array, ""] | None
    """Estimated probability, in [0, 1], that `transform` is right to 5 degrees and 0.1; for clouds
    of unit size and one cascade. None where the parameters carry no calibration."""

    @property
    def transform(self) -> Float[Array, "*batch 4 4"]:
        """The last motion; maps source onto target. Batched as `transforms` is, after `vmap`."""
        return self.transforms[..., -1, :, :]


def encode(
    params: dict, target: Float[Array, "m c"] | Cloud, *, settings: Settings = Settings()
) -> Encoded:
    """The features of a reference in every iteration; hand it to `register` as the target, with the
    same settings. Raises ValueError as `register` does."""
    check_params(params)
    clouds = {"target": target}
    finite = _checked(clouds)
    encoded = _encode(params, target, settings=settings)
    _refuse_unless(finite, clouds)
    return encoded


@functools.partial(jax.jit, static_argnames=("settings",))
def _encode(params: dict, target: Array | Cloud, *, settings: Settings) -> Encoded:
    return encoded(params, _prepared("target", target, settings), settings)


def register(
    params: dict,
    source: Float[Array, "n c"] | Cloud,
    target: Float[Array, "m c"] | Cloud | Encoded,
    *,
    iterations: int | None = None,
    cascades: int = 1,
    settings: Settings = Settings(),
) -> Registration:
    """Registers `source` onto `target`: `transform @ [x; 1]` lies on the target.

    Clouds are raw arrays, (n, 3) or with normals (n, 6), or prepared (`prepare`, for masks and
    neighbors of your own); a target may be encoded beforehand. Iteration i runs i Sinkhorn passes.
    `iterations` may be anything from 1; beyond the L of the parameters, the last layer is repeated
    on the features it was trained to receive, with its own annealing and L passes: the cloud moves
    on, the features only follow its position. Each of the `cascades` is all of this, started where
    the one before it ended: features and annealing see the clouds nearly aligned then, for the
    time of another registration onto an encoded target. Differentiates through everything but the
    choice of neighbors. Raises ValueError on wrong shapes, and for values that are no finite
    numbers, where they can be seen: inside `jit` and `vmap` they cannot, and NaN in gives NaN out.
    """
    check_params(params)
    for name, count in (("iterations", iterations), ("cascades", cascades)):
        if count is not None and (isinstance(count, bool) or not isinstance(count, Integral)):
            raise ValueError(f"{name}: got {count!r}, wanted a whole number of at least 1")
    clouds = {"source": source, "target": target}
    finite = _checked(clouds)
    found = _register(
        params, source, target, iterations=iterations, cascades=cascades, settings=settings
    )
    _refuse_unless(finite, clouds)
    return found


@functools.partial(jax.jit, static_argnames=("iterations", "cascades", "settings"))
def _register(
    params: dict,
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

    # a loop, since it is compiled once however many there are
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
    confidence = of_registration(calibration_of(params), clues)
    return Registration(**of_all, **of_last, clues=clues, confidence=confidence)


def _prepared(name: str, cloud: Array | Cloud, settings: Settings) -> Cloud:
    if isinstance(cloud, Cloud):
        return cloud
    check_points(name, cloud)
    return prepare(cloud, settings=settings)


def _checked(clouds: dict[str, Any]) -> Array | None:
    """Refuses what a compiled function cannot tell, where it is known by now. What is on the device
    stays there: the answer is one flag that it makes, whether those values are finite."""
    on_device = []
    for name, cloud in clouds.items():
        if isinstance(cloud, Cloud | Encoded | jax.core.Tracer):
            continue
        if not isinstance(cloud, np.ndarray | jax.Array):
            raise ValueError(
                f"{name}: got a {type(cloud).__name__}, wanted an array (n, 3) or (n, 6), "
                "or what `prepare` or `encode` returned"
            )
        check_points(name, cloud)
        if cloud.dtype.kind not in "fiu":
            raise ValueError(f"{name}: got {cloud.dtype}, wanted floats or integers")
        if isinstance(cloud, np.ndarray):
            _check_finite(name, cloud)
        else:
            on_device.append(cloud)
    with jax.ensure_compile_time_eval():  # while a caller is traced, what it knows has its values
        return _all_finite(on_device) if on_device else None


@jax.jit
def _all_finite(clouds: list[Array]) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(cloud)) for cloud in clouds]))


def _refuse_unless(finite: Array | None, clouds: dict[str, Any]) -> None:
    """Raises ValueError for values on the device that are not finite. To be asked when the work has
    been handed to the device: only the flag is waited for, and rows are fetched for the message."""
    if finite is not None and not jax.device_get(finite):
        for name, cloud in clouds.items():
            if isinstance(cloud, jax.Array) and not isinstance(cloud, jax.core.Tracer):
                _check_finite(name, jax.device_get(cloud))


def _check_finite(name: str, cloud: np.ndarray) -> None:
    wrong = np.flatnonzero(~np.isfinite(cloud).all(axis=1))
    if len(wrong):
        raise ValueError(
            f"{name}: row {wrong[0]} is not finite, and {len(wrong) - 1} more; wanted numbers"
        )

"""What `register` refuses: values that a compiled function could not complain about."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cfr_jax.networks.cfr.iterations import Encoded
from cfr_jax.networks.inputs import Cloud, check_points, refuse_masked

_FARTHEST = 1e6  # coordinates; sums of fourth powers of larger ones leave float32
_EXTENTS = 1e4  # as far from the origin as this many extents: float32 then keeps three digits


def checked(clouds: dict[str, Any]) -> Array | None:
    """Checks what a compiled function cannot check, as far as the values are known by now.

    Clouds on the device stay there. For them the device computes one flag, which this returns:
    whether all of their values can be used.
    """
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
        kind = cloud.dtype
        if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
            raise ValueError(f"{name}: got {kind}, wanted floats or integers")
        if isinstance(cloud, np.ndarray):
            _check_values(name, cloud)
        else:
            on_device.append(cloud)
    with jax.ensure_compile_time_eval():  # concrete arrays have values even in a traced caller
        return _all_usable(on_device) if on_device else None


@jax.jit
def _all_usable(clouds: list[Array]) -> Array:
    def usable(cloud: Array) -> Array:
        # as `prepare` does; bfloat16 and integers do not mix with float32 where promotion is strict
        cloud = cloud.astype(jnp.float64 if cloud.dtype == jnp.float64 else jnp.float32)
        points = cloud[:, :3]
        far = jnp.max(jnp.abs(points))
        extent = jnp.max(jnp.max(points, axis=0) - jnp.min(points, axis=0))
        near = (far <= _FARTHEST) & (far <= _EXTENTS * extent)
        return jnp.all(jnp.isfinite(cloud)) & (near | (extent == 0))

    return jnp.all(jnp.stack([usable(cloud) for cloud in clouds]))


def refuse_unless(usable: Array | None, clouds: dict[str, Any]) -> None:
    """Raises ValueError if values on the device cannot be used.

    Call this after the work was sent to the device: it waits for the flag alone. Rows are fetched
    only for the message.
    """
    if usable is not None and not jax.device_get(usable):
        for name, cloud in clouds.items():
            if isinstance(cloud, jax.Array) and not isinstance(cloud, jax.core.Tracer):
                _check_values(name, jax.device_get(cloud))


def _check_values(name: str, cloud: np.ndarray) -> None:
    refuse_masked(name, cloud, "`prepare` takes a mask of points")
    values = np.asarray(cloud, np.float64)
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(wrong):
        raise ValueError(
            f"{name}: row {wrong[0]} is not finite, and {len(wrong) - 1} more; "
            "wanted finite numbers"
        )
    points = values[:, :3]
    far = np.abs(points).max()
    if far > _FARTHEST:
        raise ValueError(
            f"{name}: reaches {far:.3g} from the origin, wanted at most {_FARTHEST:g}, and about 1 "
            "(`align` takes clouds of any size)"
        )
    extent = np.ptp(points, axis=0).max()
    if extent > 0 and far > _EXTENTS * extent:
        raise ValueError(
            f"{name}: lies {far / extent:.3g} times its extent from the origin, where float32 does "
            f"not tell points apart; wanted at most {_EXTENTS:g} (`align` takes clouds anywhere)"
        )

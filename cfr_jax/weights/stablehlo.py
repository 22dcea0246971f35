"""`register` as one file: a StableHLO program that includes its parameters, for hosts without this
package.

The exported program takes clouds that are padded to a fixed capacity, with their point counts. The
capacity is fixed because XLA plans its memory for known sizes, and because the blocks for neighbor
search and feature pooling depend on the size. Padding does not change the results. The number of
pairs can stay variable (`batch=True`).
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export
from jaxtyping import Array, Float, Int32
from numpy.typing import ArrayLike

from cfr_jax.networks.cfr.registration import register
from cfr_jax.networks.inputs import Settings, prepare
from cfr_jax.networks.record import Params
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.checksums import sealed, unsealed
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import contents

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
OUTPUTS = ("transform", "transforms", "weights", "covered")


def export_register(
    params: Params,
    *,
    points: int,
    platforms: Sequence[str] = ("cpu",),
    normals: bool = False,
    batch: bool = False,
    settings: Settings | None = None,
) -> jax_export.Exported:
    """The program `(source, source_count, target, target_count) -> dict` for these platforms.

    Clouds are (points, 3) float32, or (points, 6) with unit normals if `normals` is True. Only
    their first `count` rows (int32) are used; the others may hold any finite values. As for
    `register`, both clouds must be centered and of about unit size. The dict holds "transform"
    (4, 4), which maps source onto target, "transforms" (L, 4, 4), "weights" (points,) and "covered"
    (points,). With `batch`, every argument and result has one more leading axis, of any length. If
    a count is below `settings.neighbors` + 1, points have repeated neighbors.

    The program finds neighbors and missing normals itself, on the device. Parameters are constants
    of the program. An exported program cannot be differentiated. Raises ValueError for too few
    points and for unknown platforms.
    """
    settings = Settings() if settings is None else settings
    if points < settings.neighbors + 1:
        raise ValueError(
            f"points: got {points}, wanted at least {settings.neighbors + 1}, because each point "
            f"has {settings.neighbors} neighbors"
        )
    unknown = [name for name in platforms if name not in PLATFORMS]
    if unknown or not platforms:
        raise ValueError(
            f"platforms: got {', '.join(unknown) or 'none'}, wanted some of {', '.join(PLATFORMS)}"
        )

    def program(
        source: Float[Array, "n c"],
        source_count: Int32[Array, ""],
        target: Float[Array, "n c"],
        target_count: Int32[Array, ""],
    ) -> dict[str, Array]:
        clouds = [
            prepare(cloud, mask=jnp.arange(points) < count, settings=settings)
            for cloud, count in ((source, source_count), (target, target_count))
        ]
        found = register(params, *clouds, settings=settings)
        return {name: getattr(found, name) for name in OUTPUTS}

    front = jax_export.symbolic_shape("pairs") if batch else ()
    cloud = jax.ShapeDtypeStruct((*front, points, 6 if normals else 3), jnp.float32)
    count = jax.ShapeDtypeStruct(front, jnp.int32)
    exporter = jax_export.export(
        jax.jit(jax.vmap(program) if batch else program), platforms=tuple(platforms)
    )
    return exporter(cloud, count, cloud, count)


def save_exported(path: str | os.PathLike[str], exported: jax_export.Exported) -> None:
    """Writes the program to a temporary file, then renames it to `path`.

    The file holds 32 bytes, the SHA-256 of the rest, and then what `exported.serialize()` returns.
    JAX itself does not notice most flipped bits of a program. A host without this package checks
    the digest in two lines (`examples/run_exported.py`).
    """
    write_atomically(path, sealed(bytes(exported.serialize())))


@dataclasses.dataclass(frozen=True)
class ExportedRegister:
    """An exported program, which can be called with clouds of any size up to its capacity."""

    exported: jax_export.Exported

    @property
    def capacity(self) -> int:
        """Largest number of points in a cloud."""
        return self.exported.in_avals[0].shape[-2]

    @property
    def channels(self) -> int:
        """3, or 6 if clouds have normals."""
        return self.exported.in_avals[0].shape[-1]

    @property
    def platforms(self) -> tuple[str, ...]:
        """The platforms that it runs on."""
        return tuple(self.exported.platforms)

    def __call__(self, source: ArrayLike, target: ArrayLike) -> dict[str, Array]:
        """Registers one pair of unit-size clouds, (n, channels) and (m, channels), as `register`
        does.

        "weights" has length n and "covered" has length m. Raises ValueError for clouds that do not
        fit the program.
        """
        arguments = [part for cloud in self._padded(source, target) for part in cloud]
        batched = len(self.exported.in_avals[0].shape) == 3
        if batched:
            arguments = [argument[None] for argument in arguments]
        found = self.exported.call(*arguments)
        if batched:
            found = {name: value[0] for name, value in found.items()}
        found["weights"] = found["weights"][: np.shape(source)[0]]
        found["covered"] = found["covered"][: np.shape(target)[0]]
        return found

    def _padded(self, *clouds: ArrayLike) -> Iterator[tuple[Array, Array]]:
        for name, cloud in zip(("source", "target"), clouds, strict=True):
            cloud = np.asarray(cloud, np.float32)
            if cloud.ndim != 2 or cloud.shape[1] != self.channels or len(cloud) < 3:
                raise ValueError(f"{name}: got shape {cloud.shape}, wanted (n, {self.channels})")
            if len(cloud) > self.capacity:
                raise ValueError(
                    f"{name}: got {len(cloud)} points, but the program was exported for at most "
                    f"{self.capacity}"
                )
            if not np.isfinite(cloud).all():
                raise ValueError(f"{name}: got values that are not finite, wanted finite ones")
            padded = np.pad(cloud, ((0, self.capacity - len(cloud)), (0, 0)))
            yield jnp.asarray(padded), jnp.asarray(len(cloud), jnp.int32)


def load_exported(path: str | os.PathLike[str]) -> ExportedRegister:
    """Reads a program that `save_exported` or `cfr export` wrote, after checking its digest.

    Raises ValueError for any other file, and if a bit of it has changed. A program without a digest
    in front, as `jax.export` alone writes it, is refused, too: what it computes cannot be checked.
    `jax.export.deserialize` loads it.
    """
    try:
        content = unsealed(contents(path))
        if content is None:
            raise Refused(
                "is not an exported program, or it is damaged: its first 32 bytes are not the "
                "SHA-256 of the rest"
            )
        try:
            exported = jax_export.deserialize(bytearray(content))
        except Exception as error:  # flatbuffers may read past the end or find nonsense
            raise Refused(f"is not an exported program: {type(error).__name__}") from error
        if [aval.ndim for aval in exported.in_avals] not in ([2, 0, 2, 0], [3, 1, 3, 1]):
            raise Refused("is an exported program, but not one of `register`")
    except Refused as error:
        raise Refused(f"{shown(path)} {error}") from error
    return ExportedRegister(exported)

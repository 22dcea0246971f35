"""Training pairs of shapes, drawn on the device that trains on them.

One program does what `sources.ShapeSource` and `pairs_on_host` do on the host, with the same
distributions (not the same random numbers). Only the indices of the shapes are copied from the
host. A pair depends only on its shape and its key, and the key depends only on the seed and the
position in the stream. So a resumed run draws the same pairs, and so does any number of devices.

Most options that are set to zero cost nothing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import random
from jaxtyping import Array, Float, Float16, Int8, Int32, Key, UInt32

from cfr_jax.data.augmentation.sampling import Sampling, shared_count
from cfr_jax.data.augmentation.sides_on_device import Shared, between, draw_side
from cfr_jax.data.corpus import Corpus
from cfr_jax.geometry import neighbors, rigid

_BYTE = 127  # int8 value of a normal's coordinate 1


@struct.dataclass
class Shapes:
    """A corpus in as few bytes as its precision needs: 9 for a point with its normal."""

    points: Float16[Array, "s p 3"] | Float16[np.ndarray, "s p 3"]
    normals: Int8[Array, "s p 3"] | Int8[np.ndarray, "s p 3"]
    """In units of 1/127; zero where a shape has no normal."""

    @classmethod
    def of(cls, corpus: Corpus) -> Shapes:
        """The shapes of a corpus, still in host memory.

        Rounding changes coordinates in the unit sphere by at most 2^-12, and normals by 0.3
        degrees. Raises ValueError if a coordinate is too large for float16.
        """
        most = float(np.abs(corpus.points).max())
        if most > float(np.finfo(np.float16).max):  # float(), or it would compare in float16
            raise ValueError(
                f"corpus: got a coordinate of {most:g}, wanted shapes in the unit sphere"
            )
        normals = np.rint(_BYTE * corpus.normals).astype(np.int8)
        return cls(corpus.points.astype(np.float16), normals)


def draw_pairs(
    shapes: Shapes,
    seed: UInt32[Array, ""],
    items: Int32[Array, " b"],
    positions: UInt32[Array, " b"],
    sampling: Sampling,
) -> dict[str, Array]:
    """A batch in the format of `loader.batch_at`, with arrays (b, ...).

    Pair i is made from shape `items[i]` for position `positions[i]` of the stream. `sampling` is
    static.
    """
    key = random.key(seed)

    def one(item: Array, position: Array) -> dict[str, Array]:
        return draw_pair(
            shapes.points[item], shapes.normals[item], random.fold_in(key, position), sampling
        )

    return jax.vmap(one)(items, positions)


def draw_pair(
    points: Float16[Array, "p 3"],
    normals: Int8[Array, "p 3"],
    key: Key[Array, ""],
    sampling: Sampling,
) -> dict[str, Array]:
    """A pair made from one shape, in the format of `pairs_on_host.finish_pair`.

    It has both clouds (n, 3) float32, each with normals and neighbors (n, k), "transform" (4, 4),
    which maps source onto target, and "estimate_normals".
    """
    points, normals = points.astype(jnp.float32), normals.astype(jnp.float32)
    length = jnp.sqrt(jnp.sum(normals * normals, axis=1, keepdims=True))
    normals = normals / jnp.maximum(length, 1)
    of_pair, of_sides = random.split(key)
    if sampling.copied:
        score = random.uniform(random.fold_in(of_pair, 1), (len(points),))
        rows = jnp.argsort(score)[: shared_count(sampling, len(points))]
        points, normals = points[rows], normals[rows]
    drawn = _decide(of_pair, sampling)

    def cloud(key: Array, placed: Array) -> tuple[Array, Array, Array]:
        return draw_side(points, normals, placed, drawn, key, sampling)

    # both clouds at once, which takes half as many kernels
    placed = jnp.stack([drawn.motion, jnp.eye(4)])
    x, n, middle = jax.vmap(cloud)(random.split(of_sides, 2), placed)
    found = jax.vmap(lambda x: neighbors.nearest(x, sampling.neighbors, radius=sampling.radius))(x)
    back = rigid.inverse(drawn.motion)
    shift = rigid.rotate(back, middle[:1])[0] + back[:3, 3] - middle[1]
    pair = {
        "transform": rigid.from_parts(back[:3, :3], shift),
        "estimate_normals": drawn.estimate,
    }
    for row, side in enumerate(("source", "target")):
        pair |= {side: x[row], f"{side}_normals": n[row], f"{side}_neighbors": found[row]}
    return pair


def _decide(key: Key[Array, ""], sampling: Sampling) -> Shared:
    of_flags, of_turn, of_scale, of_motion = random.split(key, 4)
    shares = ("any_orientation", "uneven", "centered", "sensor_noise", "estimated_normals")
    limits = jnp.array([getattr(sampling, name) for name in shares])
    turned, uneven, centered, sensor, estimate = random.uniform(of_flags, (5,)) < limits
    turn = jnp.eye(3)
    if sampling.any_orientation:
        turn = jnp.where(turned, rigid.from_wxyz(random.normal(of_turn, (4,))), turn)
    return Shared(
        turn=turn,
        motion=_motion(of_motion, sampling),
        scale=between(of_scale, sampling.scale),
        uneven=uneven,
        centered=centered,
        sensor=sensor,
        estimate=estimate,
    )


def _motion(key: Key[Array, ""], sampling: Sampling) -> Float[Array, "4 4"]:
    of_flags, of_angles, of_shift = random.split(key, 3)
    both_ways, near, factor = random.uniform(of_flags, (3,))
    factor = jnp.where(near < sampling.near, factor, 1)
    most = factor * np.float32(np.deg2rad(sampling.angle))
    share = random.uniform(of_angles, (3,))
    share = jnp.where(both_ways < sampling.both_ways, 2 * share - 1, share)
    (sx, sy, sz), (cx, cy, cz) = jnp.sin(most * share), jnp.cos(most * share)
    # Rx Ry Rz, multiplied out
    rotation = jnp.array(
        [
            [cy * cz, -cy * sz, sy],
            [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
            [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
        ]
    )
    shift = random.uniform(of_shift, (3,), minval=-1, maxval=1)
    return rigid.from_parts(rotation, factor * np.float32(sampling.translation) * shift)

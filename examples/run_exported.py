"""Runs a program that `cfr export` wrote; needs jax, numpy and flatbuffers, but not cfr_jax.

    cfr export --points 1024 --platforms cpu,cuda,tpu --out model.stablehlo
    python run_exported.py model.stablehlo source.npy target.npy

The clouds are (n, 3) arrays in the same unit. Prints the 4x4 motion of the source onto the target.
The file is 32 bytes, the SHA-256 of the rest, and then the program as `jax.export` writes it.
"""

import hashlib
import sys

import jax
import jax.export
import numpy as np


def register(exported, source, target, seed=0):
    """The motion of the source onto the target, (4, 4) float64.

    The clouds may have any size and unit; they are thinned at random to the program's capacity.
    """
    capacity = exported.in_avals[0].shape[0]
    centers = [cloud.mean(axis=0) for cloud in (source, target)]
    scale = max(
        np.linalg.norm(cloud - center, axis=1).max()
        for cloud, center in zip((source, target), centers, strict=True)
    )
    arguments = []
    for cloud, center in zip((source, target), centers, strict=True):
        kept = np.random.default_rng(seed).permutation(len(cloud))[:capacity]
        unit = ((cloud[kept] - center) / scale).astype(np.float32)
        arguments += [np.pad(unit, ((0, capacity - len(unit)), (0, 0))), np.int32(len(unit))]
    found = np.asarray(exported.call(*arguments)["transform"], np.float64)
    motion = np.eye(4)  # in the frames of the files: x -> R (x - c_source) + scale t + c_target
    motion[:3, :3] = found[:3, :3]
    motion[:3, 3] = centers[1] + scale * found[:3, 3] - found[:3, :3] @ centers[0]
    return motion


def load(path):
    """The exported program, after checking that no bit of it has changed."""
    with open(path, "rb") as file:
        digest, program = file.read(32), file.read()
    if hashlib.sha256(program).digest() != digest:
        raise ValueError(f"{path} is damaged, or cfr export did not write it")
    return jax.export.deserialize(bytearray(program))


if __name__ == "__main__":
    program = load(sys.argv[1])
    np.set_printoptions(suppress=True)
    print(register(program, *(np.load(path)[:, :3].astype(float) for path in sys.argv[2:4])))

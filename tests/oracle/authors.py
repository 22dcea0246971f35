"""Random weights under the names and in the layouts of the authors' PyTorch checkpoints.

Drawn as PyTorch draws them (uniform within 1/sqrt(inputs)), with a GroupNorm that differs from
the identity, and with the annealing's last bias raised so that correspondences are neither all
alike nor all certain: then a mistake anywhere shows in the transforms.
"""

from itertools import pairwise

import numpy as np

Array = np.ndarray

ITERATIONS = 5


def random_state_dict(
    seed: int, *, conv_rank: int = 3, iterations: int = ITERATIONS
) -> dict[str, Array]:
    """A CFR state dict: float32 tensors; 1x1 convolutions (out, in, 1), or one more 1 at rank 4."""
    draw = _Draw(seed, conv_rank)
    draw.annealing(beta=[12.0] * iterations, alpha=[0.3] * iterations)
    draw.stage("feat_extractor_ball.prepool", (7, 96, 96, 96), rank=conv_rank)
    for i in range(iterations):
        draw.norm(f"feat_extractor_xyz.nets_a.{i}.0", 96)
        draw.linear(f"feat_extractor_xyz.nets_a.{i}.2", 96, 96, rank=conv_rank)
        draw.linear(f"feat_extractor_xyz.nets_b.{i}.0", 3, 96, rank=conv_rank, bias=False)
    return draw.state


def random_rpmnet_state_dict(seed: int, *, conv_rank: int = 3) -> dict[str, Array]:
    """The same for RPM-Net, whose layers after the pooling are convolutions as well."""
    draw = _Draw(seed, conv_rank)
    draw.annealing(beta=[60.0], alpha=[0.1])  # its random features lie closer to each other
    draw.stage("feat_extractor.prepool", (10, 96, 96, 192), rank=conv_rank)
    draw.stage("feat_extractor.postpool", (192, 192, 96), rank=conv_rank)
    draw.linear("feat_extractor.postpool.6", 96, 96, rank=conv_rank)
    return draw.state


class _Draw:
    """A state dict being filled, tensor after tensor, from one stream of random numbers."""

    def __init__(self, seed: int, conv_rank: int):
        if conv_rank not in (3, 4):
            raise ValueError(f"conv_rank must be 3 or 4, got {conv_rank}")
        self.conv_rank = conv_rank
        self.rng = np.random.default_rng(seed)
        self.state: dict[str, Array] = {}

    def annealing(self, beta: list[float], alpha: list[float]) -> None:
        """The annealing network; its outputs lie about the given values after softplus."""
        self.stage("weights_net.prepool", (4, 64, 64, 64, 128, 1024), rank=self.conv_rank)
        self.stage("weights_net.postpool", (1024, 512, 256), rank=2)
        self.linear("weights_net.postpool.6", 256, len(beta + alpha), rank=2)
        bias = self.state["weights_net.postpool.6.bias"]
        bias += np.log(np.expm1(beta + alpha)).astype(np.float32)  # the inverse of softplus

    def stage(self, prefix: str, widths: tuple[int, ...], *, rank: int) -> None:
        for layer, (inputs, outputs) in enumerate(pairwise(widths)):
            self.linear(f"{prefix}.{3 * layer}", inputs, outputs, rank=rank)
            self.norm(f"{prefix}.{3 * layer + 1}", outputs)

    def linear(self, name: str, inputs: int, outputs: int, *, rank: int, bias: bool = True) -> None:
        bound = 1 / np.sqrt(inputs)
        shape = (outputs, inputs) + (1,) * (rank - 2)
        self._put(f"{name}.weight", self.rng.uniform(-bound, bound, shape))
        if bias:
            self._put(f"{name}.bias", self.rng.uniform(-bound, bound, outputs))

    def norm(self, name: str, channels: int) -> None:
        self._put(f"{name}.weight", self.rng.uniform(0.8, 1.2, channels))
        self._put(f"{name}.bias", self.rng.uniform(-0.1, 0.1, channels))

    def _put(self, name: str, values: Array) -> None:
        self.state[name] = values.astype(np.float32)

"""The cost model: how much arithmetic and how much memory each module needs, in the plain count.

n, m points, K neighbors, D channels, L iterations. A product of (a, b) and (b, c) counts 2abc;
what is computed twice so that it need not be stored counts once, so that a share of the roof is a
share of what the method asks for, and elementwise work is not counted.
"""

from __future__ import annotations

RAW = 7
POINTNET = (4, 64, 64, 64, 128, 1024)
_FLOAT = 4


def features(n: int, k: int = 64, d: int = 96) -> float:
    """The MLP on the neighbors of one cloud, in FLOP."""
    return 2.0 * n * k * (RAW * d + 2 * d * d)


def executed_features(n: int, k: int = 64, d: int = 96) -> float:
    """The same as it runs: the first two layers twice, once for the second norm's statistics."""
    return 2.0 * n * k * (2 * RAW * d + 3 * d * d)


def cascade(n: int, d: int = 96, iterations: int = 5) -> float:
    """The light layers of one cloud."""
    return 2.0 * n * iterations * (3 * d + d * d)


def annealing(n: int, m: int) -> float:
    """The PointNet on both clouds."""
    return 2.0 * (n + m) * sum(a * b for a, b in zip(POINTNET, POINTNET[1:], strict=False))


def match(n: int, m: int, d: int = 96, iterations: int = 5, streamed: bool = False) -> float:
    """Affinities and Sinkhorn: i passes in iteration i, each two products with the block.

    Streamed, every pass makes the block anew, and so does the end of each iteration.
    """
    passes = iterations * (iterations + 1) // 2
    blocks = passes + iterations if streamed else iterations
    return 2.0 * n * m * (d * blocks + 2 * passes + 4 * iterations)


def pair(n: int, m: int, k: int = 64, d: int = 96, iterations: int = 5) -> float:
    """A whole registration, without neighbors and normals (no products there)."""
    clouds = sum(features(c, k, d) + cascade(c, d, iterations) for c in (n, m))
    return clouds + annealing(n, m) + match(n, m, d, iterations)


def memory(n: int, m: int, k: int = 64, d: int = 96, iterations: int = 5, streamed=False) -> float:
    """Bytes of the arrays that are alive at the peak: raw channels and neighbors of both clouds,
    features of the reference for every iteration, and the block of affinities twice if stored."""
    raw = (n + m) * k * (2 * RAW + 1)
    kept = (n + m) * d * 3 + m * d * iterations
    block = 0 if streamed else 2 * n * m
    return float(_FLOAT * (raw + kept + block))

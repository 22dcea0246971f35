"""The cost model: how much arithmetic and memory each module needs.

n and m are numbers of points, K neighbors, D channels, L iterations. A product of (a, b) and (b, c)
counts 2abc, and elementwise work does not count. What is computed twice to save memory counts once,
so that a share of the roof refers to what the method needs.
"""

from __future__ import annotations

RAW = 7
POINTNET = (4, 64, 64, 64, 128, 1024)
_FLOAT = 4


def features(n: int, k: int = 64, d: int = 96) -> float:
    """FLOP of the MLP on the neighbors of one cloud."""
    return 2.0 * n * k * (RAW * d + 2 * d * d)


def executed_features(n: int, k: int = 64, d: int = 96) -> float:
    """The same as executed: two layers run twice, once for the second norm's statistics."""
    return 2.0 * n * k * (2 * RAW * d + 3 * d * d)


def cascade(n: int, d: int = 96, iterations: int = 5) -> float:
    """FLOP of the light layers of one cloud."""
    return 2.0 * n * iterations * (3 * d + d * d)


def annealing(n: int, m: int) -> float:
    """FLOP of the PointNet on both clouds."""
    return 2.0 * (n + m) * sum(a * b for a, b in zip(POINTNET, POINTNET[1:], strict=False))


def match(n: int, m: int, d: int = 96, iterations: int = 5, streamed: bool = False) -> float:
    """FLOP of affinities and Sinkhorn: i passes in iteration i, each with two block products.

    If streamed, every pass recomputes the block, and so does the end of each iteration.
    """
    passes = iterations * (iterations + 1) // 2
    blocks = passes + iterations if streamed else iterations
    return 2.0 * n * m * (d * blocks + 2 * passes + 4 * iterations)


def pair(n: int, m: int, k: int = 64, d: int = 96, iterations: int = 5) -> float:
    """FLOP of a whole registration, without neighbors and normals, which have no products."""
    clouds = sum(features(c, k, d) + cascade(c, d, iterations) for c in (n, m))
    return clouds + annealing(n, m) + match(n, m, d, iterations)


def memory(n: int, m: int, k: int = 64, d: int = 96, iterations: int = 5, streamed=False) -> float:
    """Bytes of the arrays that are alive at the peak.

    These are the raw channels and neighbors of both clouds, the features of the reference for every
    iteration, and, if stored, the block of affinities twice.
    """
    raw = (n + m) * k * (2 * RAW + 1)
    kept = (n + m) * d * 3 + m * d * iterations
    block = 0 if streamed else 2 * n * m
    return float(_FLOAT * (raw + kept + block))

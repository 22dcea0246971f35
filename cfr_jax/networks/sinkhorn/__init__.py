"""Sinkhorn normalization with slack: which source point corresponds to which target point, softly.

The affinities m = exp(log affinity) get an extra row and column of ones, the slack, for points
without a partner. The slack row and column are never normalized themselves. One pass divides every
real row by its sum, then every real column by its sum, slack included. Several forms give the same
numbers: `dense` stores the (n, m) block, `streamed` recomputes it in blocks of rows whenever it is
needed, and `log_space` is the published form, to compare with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import Affinity, Match
from cfr_jax.networks.sinkhorn.by_hand import Way, match_by_hand
from cfr_jax.networks.sinkhorn.dense import match_dense
from cfr_jax.networks.sinkhorn.log_space import match_in_log_space
from cfr_jax.networks.sinkhorn.streamed import rows_of

__all__ = ["FORMS", "Affinity", "Form", "Match", "form_for", "match"]

Form = Literal["auto", "dense", "streamed", "log space"]
Platform = Literal["cpu", "accelerator"]

# The most entries that are stored: 128 MiB of float32 on a CPU, 2 GiB on an accelerator. Each
# further pass reads a stored block twice, and recomputes a streamed block once. On a CPU that is at
# worst twice as slow; on a GPU it is several times as slow, with many more kernels.
_STORED: dict[Platform, int] = {"cpu": 1 << 25, "accelerator": 1 << 29}
# Entries of one streamed block of rows: 16 MiB and 256 MiB.
_STREAMED: dict[Platform, int] = {"cpu": 1 << 22, "accelerator": 1 << 26}


def match(
    affinity: Affinity,
    points: Float[Array, "m 3"],
    *,
    passes: int,
    form: Form = "auto",
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Match:
    """Normalizes the affinities by `passes` passes and averages `points` with them.

    The result is finite for every finite affinity. Masked points take no part. `passes` and `form`
    are static. "auto" chooses by the number of entries of one pair and by the platform that the
    program is lowered for (`form_for`); for a batch of large pairs ask for "streamed". There are
    derivatives for everything but the masks, also in forward mode. Raises ValueError for fewer than
    one pass and for an unknown form.
    """
    if passes < 1:
        raise ValueError(f"passes: got {passes}, wanted at least 1")
    if form != "auto" and form not in FORMS:
        raise ValueError(f"form: got {form!r}, wanted 'auto' or one of {sorted(FORMS)}")
    run = _match_by_size if form == "auto" else FORMS[form]
    return run(affinity, points, passes=passes, source_mask=source_mask, target_mask=target_mask)


def form_for(n: int, m: int, platform: Platform) -> Form:
    """The form that "auto" means for n source and m target points."""
    return "dense" if n * m <= _STORED[platform] else "streamed"


def _match_streamed(affinity: Affinity, points: Array, **rest: Any) -> Match:
    return _by_hand(affinity, points, [_streamed(affinity, each) for each in _STREAMED], **rest)


def _by_hand(affinity: Affinity, points: Array, ways: list[Way], **rest: Any) -> Match:
    return match_by_hand(affinity, points, on_cpu=ways[0], elsewhere=ways[1], **rest)


def _streamed(affinity: Affinity, platform: Platform) -> Way:
    return Way("streamed", rows_of(affinity.target.shape[0], _STREAMED[platform]))


def _match_by_size(affinity: Affinity, points: Array, **rest: Any) -> Match:
    sizes = affinity.source.shape[0], affinity.target.shape[0]
    forms = [form_for(*sizes, platform) for platform in _STORED]
    if forms[0] == "dense":
        return match_dense(affinity, points, **rest)
    ways = [
        Way("stored", 0) if form == "dense" else _streamed(affinity, platform)
        for form, platform in zip(forms, _STORED, strict=True)
    ]
    return _by_hand(affinity, points, ways, **rest)


FORMS: dict[Form, Callable[..., Match]] = {
    "dense": match_dense,
    "streamed": _match_streamed,
    "log space": match_in_log_space,
}

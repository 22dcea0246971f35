"""Sinkhorn normalization with slack: which source point corresponds to which target point, softly.

A row and a column of ones stand beside the affinities m = exp(log affinity) and take what has no
partner; they are never normalized themselves. One pass divides every real row by its sum, then
every real column by its sum, slack included. Three forms give the same numbers: `dense` stores the
(n, m) block, `streamed` never does, `log_space` is the published one that they are compared with.
"""

from __future__ import annotations

from typing import Literal

from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import Affinity, Match
from cfr_jax.networks.sinkhorn.dense import match_dense
from cfr_jax.networks.sinkhorn.log_space import match_in_log_space
from cfr_jax.networks.sinkhorn.streamed import match_streamed

__all__ = ["FORMS", "Affinity", "Form", "Match", "form_for", "match"]

Form = Literal["auto", "dense", "streamed", "log space"]
FORMS = {
    "dense": match_dense,
    "streamed": match_streamed,
    "log space": match_in_log_space,
}

# Entries of a block that is still stored: 128 MiB of float32. Stored, a further pass costs reading
# the block twice; streamed, making it once more, which is slower, at worst twice as slow.
_STORED = 1 << 25


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

    Finite for every finite affinity. Masked points neither give nor take. `passes` and `form` are
    static; "auto" decides by the number of entries (`form_for`). Differentiates with respect to
    everything but the masks: once, where streamed. Raises ValueError for fewer than one pass, and
    for a form that does not exist.
    """
    if passes < 1:
        raise ValueError(f"passes: got {passes}, wanted at least 1")
    if form == "auto":
        form = form_for(affinity.source.shape[0], affinity.target.shape[0])
    if form not in FORMS:
        raise ValueError(f"form: got {form!r}, wanted 'auto' or one of {sorted(FORMS)}")
    return FORMS[form](
        affinity, points, passes=passes, source_mask=source_mask, target_mask=target_mask
    )


def form_for(n: int, m: int) -> Form:
    """The form that "auto" means for n source and m target points."""
    return "dense" if n * m <= _STORED else "streamed"

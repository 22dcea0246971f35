"""`--shard`: which share of a list this process takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cfr_jax.batch.sharding import Shard


def asked_share(wish: str | None) -> Shard | None:
    """The share that `I/N` names, or the cluster for `auto`; None for None.

    Raises a ValueError that names the option for anything else.
    """
    from cfr_jax.batch.sharding import parse_shard, process_shard

    if wish is None:
        return None
    if wish != "auto":
        try:
            return parse_shard(wish)
        except ValueError as error:
            raise ValueError(f"--shard: {error}") from None

    import jax

    try:
        if not jax.distributed.is_initialized():
            jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            "--shard auto: found no cluster that gives this process a number; give --shard I/N "
            "instead\n"
            f"({str(error).splitlines()[0]})"
        ) from None
    return process_shard()

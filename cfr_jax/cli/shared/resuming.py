"""Long work that continues where it stopped, and that several machines can share (`--shard`)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfr_jax.batch.journal import Journal
    from cfr_jax.batch.sharding import Shard


@contextmanager
def journal(
    path: Path, made_with: dict[str, Any], share: Shard | None, args: argparse.Namespace
) -> Iterator[Journal]:
    """The journal of the command at `path`; without a share, with all that shares have done.

    If the work is interrupted, standard error says how to continue. Raises ValueError for a file
    that is no journal of the command, or that was made with other settings.
    """
    from cfr_jax.batch.journal import Journal
    from cfr_jax.batch.sharding import other_shards

    with Journal(path, made_with, retry=args.retry_failed, command=args.command) as kept:
        for other in other_shards(path) if share is None else ():
            kept.adopt(other, made_with)
        try:
            yield kept
        except KeyboardInterrupt:
            print(
                f"cfr {args.command}: stopped; {path} keeps what is done\n"
                "run the same command again to continue",
                file=sys.stderr,
            )
            raise


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

"""Splits one list over several machines, and says which share belongs to this one."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Shard:
    """Every `count`-th pair, starting with the `number`-th (1 to `count`)."""

    number: int
    count: int

    def rows(self) -> slice:
        """The slice of the list that belongs to this shard."""
        return slice(self.number - 1, None, self.count)

    def beside(self, path: Path) -> Path:
        """`path` with the shard in its name, so that shards never overwrite each other."""
        return path.with_name(f"{path.stem}.{self.number}-of-{self.count}{path.suffix}")


def parse_shard(text: str) -> Shard:
    """`2/4` is the second of four shards; raises ValueError for anything else."""
    match = re.fullmatch(r"(\d+)/(\d+)", text.strip())
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"got {text!r}, wanted I/N with I from 1 to N, such as 2/4, or auto")
    return Shard(int(match[1]), int(match[2]))


def process_shard() -> Shard | None:
    """This process's share of the processes of `jax.distributed`; None if not initialized."""
    import jax

    if not jax.distributed.is_initialized():
        return None
    return Shard(jax.process_index() + 1, jax.process_count())


def other_shards(path: Path) -> list[Path]:
    """The files beside `path` whose names say that they are shards of it."""
    name = re.compile(re.escape(path.stem) + r"\.\d+-of-\d+" + re.escape(path.suffix))
    return sorted(file for file in path.parent.iterdir() if name.fullmatch(file.name))

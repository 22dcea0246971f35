"""Sequences of millions of items that take little memory, because items are made when asked for."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar, overload

Item = TypeVar("Item")


class MadeOnAccess(Sequence[Item], Generic[Item]):
    """A sequence that says how long it is and how item i is made, and keeps no item."""

    @overload
    def __getitem__(self, index: int) -> Item: ...

    @overload
    def __getitem__(self, index: slice) -> list[Item]: ...

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return [self[row] for row in range(len(self))[index]]
        if not -len(self) <= index < len(self):
            raise IndexError(f"index: got {index}, wanted one of {len(self)} pairs")
        return self._make(range(len(self))[index])

    def _make(self, index: int) -> Item:
        raise NotImplementedError


class OnDemand(MadeOnAccess[Item]):
    """`count` items, where item i is `make(i)`, made each time it is accessed."""

    def __init__(self, count: int, make: Callable[[int], Item]):
        self._count, self._maker = count, make

    def __len__(self) -> int:
        return self._count

    def _make(self, index: int) -> Item:
        return self._maker(index)


class Texts:
    """Texts one after the other in one block of memory."""

    def __init__(self) -> None:
        self._bytes, self._ends = bytearray(), array("Q", [0])

    def append(self, text: str) -> None:
        """Adds a text at the end."""
        self._bytes += text.encode("utf-8", "surrogatepass")
        self._ends.append(len(self._bytes))

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, index: int) -> str:
        if not 0 <= index < len(self):
            raise IndexError(index)
        held = self._bytes[self._ends[index] : self._ends[index + 1]]
        return held.decode("utf-8", "surrogatepass")

    def __iter__(self) -> Iterator[str]:
        return (self[index] for index in range(len(self)))

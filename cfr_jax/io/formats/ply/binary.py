"""The rows of a PLY element in binary, without a loop over them even where they differ in size."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int64

from cfr_jax.io.budget import check_room
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.ply.elements import Element, Held, Property, Ragged, gathered, wanted_of

_BLOCK = 1 << 17  # bytes whose possible rows are gone through at once


def read_binary(
    data: bytes, offset: int, order: str, elements: list[Element], whole: bool
) -> list[Held]:
    """All elements of a binary file; `order` is numpy's sign of the byte order."""
    held: list[Held] = []
    for element in elements:
        if element.count == 0 or not element.properties:
            held.append([_nothing(prop, order) for prop in element.properties])
            continue
        lengths = _first_lengths(data, offset, order, element)
        dtype = _row_type(order, element, lengths)
        rows = _equal_rows(data, offset, dtype, element, lengths)
        wanted = wanted_of(element, whole)
        if rows is None:
            found, offset = _unequal_rows(data, offset, order, element, wanted)
            held.append(found)
            continue
        offset += element.count * dtype.itemsize
        columns: Held = []
        for position, (prop, needed) in enumerate(zip(element.properties, wanted, strict=True)):
            if not needed:
                columns.append(None)
            elif prop.counter is None:
                columns.append(rows[f"{position}"])
            else:
                sizes = rows[f"count {position}"]
                columns.append(Ragged(rows[f"{position}"], sizes))
        held.append(columns)
    return held


def _nothing(prop: Property, order: str) -> np.ndarray | Ragged:
    empty = np.empty(0, order + prop.kind)
    return empty if prop.counter is None else Ragged(empty, np.empty(0, order + prop.counter))


def _first_lengths(data: bytes, offset: int, order: str, element: Element) -> dict[int, int]:
    """The length of each list in the element's first row."""
    lengths = {}
    octets = np.frombuffer(data, np.uint8)
    for position, prop in enumerate(element.properties):
        if prop.counter is not None:
            counts, good = _counts(octets, np.array([offset]), order, prop)
            if not good[0]:
                raise _bad_list(data, offset, element, prop, row=0)
            lengths[position] = int(counts[0])
            offset += int(prop.counter[1])
        offset += lengths.get(position, 1) * prop.size
    return lengths


def _row_type(order: str, element: Element, lengths: dict[int, int]) -> np.dtype:
    fields: list[tuple] = []
    for position, prop in enumerate(element.properties):
        if prop.counter is not None:
            fields.append((f"count {position}", order + prop.counter))
            fields.append((f"{position}", order + prop.kind, (lengths[position],)))
        else:
            fields.append((f"{position}", order + prop.kind))
    return np.dtype(fields)


def _equal_rows(
    data: bytes, offset: int, dtype: np.dtype, element: Element, lengths: dict[int, int]
) -> np.ndarray | None:
    """The rows as one array; None if lists of different lengths make them differ in size."""
    size = element.count * dtype.itemsize
    if offset + size <= len(data):
        rows = np.frombuffer(data, dtype, element.count, offset)
        same = ((rows[f"count {position}"] == length).all() for position, length in lengths.items())
        return rows if all(same) else None
    if not lengths:
        raise CloudFileError(
            f"byte {offset}: {element.count} rows of element {element.name!r} are {size} bytes, "
            f"the file holds {max(len(data) - offset, 0)}"
        )
    return None


def _unequal_rows(
    data: bytes, offset: int, order: str, element: Element, wanted: list[bool]
) -> tuple[Held, int]:
    """The properties of rows that differ in size, and the offset behind them."""
    check_room(element.count, 32, len(data), "rows of different sizes")
    octets = np.frombuffer(data, np.uint8)
    parts: list[list] = [[] for _ in element.properties]
    sizes: list[list] = [[] for _ in element.properties]
    done = 0
    for at in _row_starts(octets, offset, order, element):
        first = done
        done += len(at)
        for position, prop in enumerate(element.properties):
            if prop.counter is None:
                if wanted[position]:
                    parts[position].append(_numbers(octets, at, order + prop.kind))
                at = at + prop.size
                continue
            counts, good = _counts(octets, at, order, prop)
            if not good.all():
                row = int(np.argmin(good))
                raise _bad_list(data, int(at[row]), element, prop, first + row)
            at = at + int(prop.counter[1])
            if wanted[position]:
                taken = gathered(octets, at, counts * prop.size)
                parts[position].append(taken.view(order + prop.kind))
                sizes[position].append(counts.astype(prop.counter))
            at = at + counts * prop.size
        offset = int(at[-1])
    held: Held = []
    for prop, needed, part, size in zip(element.properties, wanted, parts, sizes, strict=True):
        if not needed:
            held.append(None)
        elif prop.counter is None:
            held.append(np.concatenate(part))
        else:
            held.append(Ragged(np.concatenate(part), np.concatenate(size)))
        part.clear()
        size.clear()
    return held, offset


def _row_starts(
    octets: np.ndarray, offset: int, order: str, element: Element
) -> Iterator[Int64[np.ndarray, " k"]]:
    """Where the rows begin, a block of them at a time.

    Each byte of a block is taken for the beginning of a row, and its end is found for all of them
    at once; what is left is to follow from one row's end to the next. A row with a list takes a
    byte at least, so no count in a header can make this run away.
    """
    left = element.count
    while left:
        end = min(offset + _BLOCK, len(octets) + 1)
        behind = _ends(octets, np.arange(offset, end), order, element).tolist()
        starts = []
        at = offset
        while at < end and left:
            starts.append(at)
            left -= 1
            at = behind[at - offset]
            if at > len(octets):
                left = 0
        yield np.array(starts, np.int64)
        if at > len(octets):
            # What reads the row's lists has raised already, unless its last number is cut off.
            raise CloudFileError(
                f"byte {starts[-1]}: the file ends within element {element.name!r}"
            )
        offset = at


def _ends(
    octets: np.ndarray, at: Int64[np.ndarray, " k"], order: str, element: Element
) -> Int64[np.ndarray, " k"]:
    """Where rows that begin at `at` end; behind the file where they do not fit."""
    outside = len(octets) + 1
    for prop in element.properties:
        if prop.counter is None:
            at = at + prop.size
        else:
            counts, good = _counts(octets, at, order, prop)
            at = np.where(good, at + int(prop.counter[1]) + counts * prop.size, outside)
        at = np.minimum(at, outside)
    return at


def _counts(
    octets: np.ndarray, at: Int64[np.ndarray, " k"], order: str, prop: Property
) -> tuple[Int64[np.ndarray, " k"], np.ndarray]:
    """The lengths of lists that begin at `at`, and which of them the file holds."""
    assert prop.counter is not None
    width = int(prop.counter[1])
    inside = at + width <= len(octets)
    counts = _numbers(octets, np.where(inside, at, 0), order + prop.counter).astype(np.int64)
    # Dividing cannot overflow, as multiplying could.
    room = (len(octets) - at - width) // prop.size
    good = inside & (counts >= 0) & (counts <= room)
    return np.where(good, counts, 0), good


def _numbers(octets: np.ndarray, at: Int64[np.ndarray, " k"], kind: str) -> np.ndarray:
    """The numbers of a type that begin at these bytes; zeros where the file ends before."""
    width = np.dtype(kind).itemsize
    raw = np.empty((len(at), width), np.uint8)
    for k in range(width):
        raw[:, k] = octets[np.minimum(at + k, len(octets) - 1)]
    return raw.view(kind)[:, 0]


def _bad_list(
    data: bytes, offset: int, element: Element, prop: Property, row: int
) -> CloudFileError:
    return CloudFileError(
        f"byte {offset}: row {row} of {element.count} of element {element.name!r} wants a list "
        f"{prop.name!r:.40} of 0 or more that the file ({len(data)} bytes) holds"
    )

"""Runs as a script: reads HDF5 files for the process that started it (`reading`).

A damaged file can crash the HDF5 library, keep it busy for ever, or make it ask for all memory.
Then only this process ends. Requests are lines of JSON on standard input. An answer is the length
of its header in 8 bytes, the header in JSON, and the bytes of the arrays one after the other.

It imports nothing of this package, so that it starts quickly.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from typing import Any, BinaryIO

import h5py
import numpy as np

_SPARE = 256 << 20  # bytes that the libraries may take beside what is read
_BLOCK = 256  # texts that are read at a time
_LONGEST_TEXT = 4096


class Unusable(Exception):
    """The file is HDF5, but not what was asked for; says why."""


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answers each request until there are no more."""
    for line in requests:
        try:
            header, arrays = answer(json.loads(line))
        except Unusable as error:
            header, arrays = {"error": str(error)}, []
        except MemoryError:
            header, arrays = {"error": "needs more memory than its size allows"}, []
        except Exception as error:  # h5py raises nearly every type there is
            why = " ".join(str(error).split())[:300]
            header, arrays = {"error": f"is damaged ({type(error).__name__}: {why})"}, []
        text = json.dumps(header).encode()
        answers.write(len(text).to_bytes(8, "little") + text)
        for array in arrays:
            answers.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        answers.flush()


def answer(request: dict[str, Any]) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Header and arrays for a request of `reading.read`."""
    _limit_memory(4 * request["budget"] + _SPARE)
    try:
        file = h5py.File(request["path"], "r")
    except OSError as error:
        why = " ".join(str(error).split())[:300]
        raise Unusable(f"is not an HDF5 file ({why})") from None
    with file:
        place = file
        if request["group"] is not None:
            place = _own(file, request["group"])
            if not isinstance(place, h5py.Group):
                raise Unusable(f"{request['group']} is no group")
        names = list(place)
        budget = _Budget(request["budget"])
        found = [
            (name, _numbers(place, name, budget)) for name in request["arrays"] if name in names
        ]
        header = {
            "names": names,
            "groups": list(_groups(place, names)) if request["groups"] else [],
            "arrays": [[name, array.dtype.str, array.shape] for name, array in found],
            "texts": {
                name: list(_texts(place, name, budget))
                for name in request["texts"]
                if name in names
            },
            "attributes": dict(_attributes(place, request["attributes"])),
        }
    return header, [array for _, array in found]


class _Budget:
    """Bytes that may still be read."""

    def __init__(self, most: int):
        self._most, self._left = most, most

    def take(self, name: str, size: int) -> None:
        """Raises `Unusable` if a member of that size is too much."""
        self._left -= size
        if self._left < 0:
            raise Unusable(
                f"{name} unfolds to more than the {self._most:,} bytes that a file of its size may"
            )


def _own(place: h5py.Group, name: str) -> Any:
    """A member that is part of this file, and of no other."""
    kind = place.id.links.get_info(name.encode("utf-8", "surrogateescape")).type
    if kind != h5py.h5l.TYPE_HARD:
        word = {h5py.h5l.TYPE_SOFT: "a soft", h5py.h5l.TYPE_EXTERNAL: "an external"}
        raise Unusable(f"{name} is {word.get(kind, 'an unknown')} link, wanted the data itself")
    return place[name]


def _groups(place: h5py.Group, names: list[str]) -> Iterator[str]:
    for name in names:
        raw = name.encode("utf-8", "surrogateescape")
        if place.id.links.get_info(raw).type == h5py.h5l.TYPE_HARD:
            if h5py.h5g.get_objinfo(place.id, raw).type == h5py.h5g.GROUP:
                yield name


def _dataset(place: h5py.Group, name: str, budget: _Budget) -> h5py.Dataset:
    """A dataset whose values are in this file, and fit."""
    dataset = _own(place, name)
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        raise Unusable(f"{name} is no array")
    made = dataset.id.get_create_plist()
    if made.get_external_count():
        raise Unusable(f"{name} lies in other files, wanted the data itself")
    if made.get_layout() == h5py.h5d.VIRTUAL:
        raise Unusable(f"{name} is made of other arrays (virtual), wanted the data itself")
    width = max(dataset.id.get_type().get_size(), 4)  # everything becomes float32 at least
    budget.take(name, dataset.size * width)
    if dataset.chunks is not None:  # a chunk is unfolded whole, even one that is mostly outside
        budget.take(name, max(0, int(np.prod(dataset.chunks, dtype=object)) - dataset.size) * width)
    return dataset


def _numbers(place: h5py.Group, name: str, budget: _Budget) -> np.ndarray:
    dataset = _dataset(place, name, budget)
    if dataset.dtype.kind not in "fiub" or dataset.dtype.hasobject:
        raise Unusable(f"{name} is {dataset.dtype}, wanted numbers")
    return np.asarray(dataset[()])


def _texts(place: h5py.Group, name: str, budget: _Budget) -> Iterator[str]:
    dataset = _dataset(place, name, budget)
    if h5py.check_string_dtype(dataset.dtype) is None or dataset.ndim != 1:
        raise Unusable(f"{name} is {dataset.dtype} {dataset.shape}, wanted a list of texts")
    for start in range(0, len(dataset), _BLOCK):
        for text in dataset.asstr(errors="replace")[start : start + _BLOCK]:
            budget.take(name, len(text))
            if len(text) > _LONGEST_TEXT:
                raise Unusable(f"{name} has a text of {len(text):,} characters")
            yield text


def _attributes(place: h5py.Group, wanted: list[list[str]]) -> Iterator[tuple[str, Any]]:
    """Numbers beside a member, or beside the group itself (""), by "member@name"."""
    for member, name in wanted:
        if member and member not in place:
            continue
        owner = _own(place, member) if member else place
        if not h5py.h5a.exists(owner.id, name.encode()):
            continue
        attribute = h5py.h5a.open(owner.id, name.encode())
        if attribute.shape not in ((), (1,)) or attribute.dtype.kind not in "fiu":
            raise Unusable(f"{member or 'the group'} has a {name} that is no number")
        yield f"{member}@{name}", np.asarray(owner.attrs[name]).reshape(()).item()


def _limit_memory(spare: int) -> None:
    try:
        import resource

        with open("/proc/self/statm") as file:
            now = int(file.read().split()[0]) * resource.getpagesize()
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        most = now + spare if hard == resource.RLIM_INFINITY else min(now + spare, hard)
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    except (ImportError, OSError, ValueError):  # systems without such limits
        return


def main() -> None:
    """Serves on the standard streams."""
    # what a library prints must not get among the answers
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    serve(sys.stdin.buffer, answers)


if __name__ == "__main__":
    main()

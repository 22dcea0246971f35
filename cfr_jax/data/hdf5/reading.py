"""Members of an HDF5 file from anybody, as arrays.

The HDF5 library is not made for files that want to harm: some crash it, and on some it never ends.
So a process of its own reads (`child`), with a limit on time and memory, and is started again if
need be. Only members that are asked for are opened, and only if their values lie in the file.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import opened

_LEAST_BUDGET, _BUDGET = 64 << 20, 4  # bytes that may be read, and more of them for each of a file
_SECONDS, _BYTES_PER_SECOND = 30.0, 10e6
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True)
class Held:
    """What was asked for, as far as it is there."""

    names: list[str] = field(default_factory=list)
    """Of all members."""
    groups: list[str] = field(default_factory=list)
    """Of the members that are groups, if they were asked for."""
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    attributes: dict[str, int | float] = field(default_factory=dict)
    """By "member@name", or "@name" for those of the group."""


def is_hdf5(path: Path) -> bool:
    """Whether the file has the signature of HDF5, which may follow 512, 1024, 2048 … bytes of
    something else."""
    try:
        with opened(path) as stream:
            size, place = os.fstat(stream.fileno()).st_size, 0
            while place < size:
                stream.seek(place)
                if stream.read(len(_SIGNATURE)) == _SIGNATURE:
                    return True
                place = max(512, 2 * place)
    except (Refused, OSError):
        pass
    return False


def read(
    path: Path,
    *,
    group: str | None = None,
    groups: bool = False,
    arrays: Iterable[str] = (),
    texts: Iterable[str] = (),
    attributes: Iterable[tuple[str, str]] = (),
) -> Held:
    """Arrays of numbers, lists of texts, and attributes (member, name) that are numbers, of the
    file or of one `group` in it.

    What is asked for and not there is left out. Raises ValueError, naming the file, if it is no
    HDF5 file, if it is damaged, if what is asked for is of another type, larger than a file of its
    size may hold, or not part of the file itself (links, external and virtual data), or if reading
    takes too long.
    """
    try:
        with opened(path) as stream:
            size = os.fstat(stream.fileno()).st_size
        request = {
            "path": os.fspath(Path(path).absolute()),
            "group": group,
            "groups": groups,
            "arrays": list(arrays),
            "texts": list(texts),
            "attributes": list(attributes),
            "budget": _LEAST_BUDGET + _BUDGET * size,
        }
        header, found = _reader.ask(request, _SECONDS + size / _BYTES_PER_SECOND)
    except Refused as error:
        raise Refused(f"{shown(path)} {error}") from error
    return Held(header["names"], header["groups"], found, header["texts"], header["attributes"])


class _Reader:
    """The process that reads; started when it is needed, and ended with this one."""

    def __init__(self) -> None:
        self._process: subprocess.Popen | None = None
        self._lock = threading.Lock()

    def ask(self, request: dict, seconds: float) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Header and arrays; raises `Refused` if the process says so, dies, or takes too long."""
        with self._lock:
            process = self._started()
            late = threading.Event()

            def end() -> None:
                late.set()
                process.kill()

            timer = threading.Timer(seconds, end)
            timer.daemon = True
            timer.start()
            try:
                return _exchange(process, request)
            except (EOFError, BrokenPipeError):
                self._end()
                if late.is_set():
                    raise Refused(f"could not be read within {seconds:.0f} s") from None
                raise Refused("is damaged: the HDF5 library crashed on it") from None
            except Refused:
                raise
            except BaseException:  # the rest of the answer would be taken for the next one
                self._end()
                raise
            finally:
                timer.cancel()

    def close(self) -> None:
        """Ends the process; a thread that waits for it is told that it crashed."""
        self._end()

    def forget(self) -> None:
        """After a fork: the process belongs to the parent."""
        self._process, self._lock = None, threading.Lock()

    def _started(self) -> subprocess.Popen:
        if self._process is None or self._process.poll() is not None:
            paths = os.pathsep.join(path for path in sys.path if path)
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(Path(__file__).with_name("child.py"))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process alone
                env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
            )
        return self._process

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    try:
                        stream.close()
                    except OSError:  # what was still to be written goes nowhere
                        pass


def _exchange(process: subprocess.Popen, request: dict) -> tuple[dict, dict[str, np.ndarray]]:
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps(request).encode() + b"\n")
    process.stdin.flush()
    length = int.from_bytes(_exactly(process.stdout, 8), "little")
    header = json.loads(bytes(_exactly(process.stdout, length)))
    if "error" in header:
        raise Refused(header["error"])
    found = {}
    for name, kind, shape in header["arrays"]:
        dtype = np.dtype(kind)
        data = _exactly(process.stdout, dtype.itemsize * math.prod(shape))
        found[name] = np.frombuffer(data, dtype).reshape(shape)
    return header, found


def _exactly(stream: Any, size: int) -> bytearray:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = stream.readinto(view)
        if not count:
            raise EOFError
        view = view[count:]
    return data


_reader = _Reader()
atexit.register(_reader.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reader.forget)

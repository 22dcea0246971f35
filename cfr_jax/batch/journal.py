"""The results of all pairs, one JSON line each, so that a killed run loses no answer.

A line is written in one piece as soon as its pair is done. If a kill cut off the last line, it is
removed when the file is opened again. The first line says what the answers were made with.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

Key = tuple[str, str, int]


class Journal:
    """An open journal; close it, or use it in a `with` statement."""

    def __init__(
        self,
        path: Path,
        made_with: dict[str, Any],
        retry: bool = False,
        command: str = "batch",
    ):
        """Opens the journal at `path`, or creates it.

        With `retry`, pairs that failed count as not done. `command` of `cfr` writes it. Raises
        ValueError if another process has the file open, if it was made with other settings, or if
        it is not a journal.
        """
        self.path = path
        self._command = command
        self._format = f"cfr_jax/{command}/1"
        self.done: dict[Key, dict[str, Any]] = {}
        header = {"format": self._format, "made_with": made_with}
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            self._lock()
            self._open(header)
        except BaseException:
            self.close()
            raise
        if retry:
            self.done = {
                key: record for key, record in self.done.items() if record["error"] is None
            }

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file, so that other processes can open it."""
        with contextlib.suppress(OSError):
            os.close(self._file)

    def adopt(self, path: Path, made_with: dict[str, Any]) -> None:
        """Also counts the pairs in another journal as done; it must have the same settings.

        Raises ValueError if it has other settings or is not a journal.
        """
        records = _records(path)
        header = next(records, {})
        if header.get("format") != self._format or "made_with" not in header:
            raise ValueError(
                f"{path} exists, but is not a journal of `cfr {self._command}`\n"
                "move it, or choose another --out"
            )
        theirs = header["made_with"]
        differing = [name for name in made_with if theirs.get(name) != made_with[name]]
        if differing:
            name = differing[0]
            raise ValueError(
                f"{path} was started with {name} {theirs.get(name)!r}, not {made_with[name]!r}\n"
                "give the same options to continue, remove it to start over, or choose another "
                "--out"
            )
        for record in records:
            # For a pair that was tried again, the last line counts.
            self.done[record["source"], record["target"], record["repeat"]] = record

    def _open(self, header: dict[str, Any]) -> None:
        data, start = self.path.read_bytes(), (json.dumps(header) + "\n").encode()
        whole = data.rfind(b"\n") + 1
        if whole or not start.startswith(data):
            self.adopt(self.path, header["made_with"])  # before the file is changed at all
        os.ftruncate(self._file, whole)
        os.lseek(self._file, 0, os.SEEK_END)
        if not whole:
            self._append(header)

    def write(self, record: dict[str, Any]) -> None:
        """Adds the record of a pair, and counts it as done once it is on its way to the disk."""
        self._append(record)
        self.done[record["source"], record["target"], record["repeat"]] = record

    def _append(self, value: dict[str, Any]) -> None:
        line = memoryview((json.dumps(value, allow_nan=False) + "\n").encode())
        while line:  # a signal or a full disk may cut a write short
            line = line[os.write(self._file, line) :]

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:  # Windows: nothing there keeps two runs from writing one file
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{self.path} is being written by another `cfr {self._command}`\n"
                "wait for it, choose another --out, or split the work with --shard"
            ) from None
        except OSError:  # file systems without locks
            return


def _records(path: Path) -> Iterator[dict[str, Any]]:
    with open(path, "rb") as stream:
        for number, line in enumerate(stream, 1):
            if not line.endswith(b"\n"):  # still being written, by another shard
                return
            try:
                record = json.loads(line)
                if not isinstance(record, dict) or (number > 1 and "source" not in record):
                    raise ValueError("it is not a record of a pair")
            except ValueError as error:
                if number == 1:
                    return
                raise ValueError(
                    f"{path}, line {number} is damaged ({error}): remove the line"
                ) from None
            yield record

"""What became of each pair, one JSON line each, so that no kill loses an answer.

A line is written in one go as soon as its pair is done, with a checksum. A line that a kill cut
short is found when the file is opened again, and taken off; one that was changed is refused. The
first line says what the answers were made with. In memory is only where each line is.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cfr_jax.batch.checked_lines import line_of, record_at, records_in
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import irregular, opened

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
        """Opens the journal at `path`, or begins it. With `retry`, pairs that failed count as not
        done; `command` of `cfr` writes it. Raises ValueError if another process has it open, if it
        was made with other settings, if it is no journal, or if a line of it is damaged."""
        self.path = path
        self._command = command
        self._format = f"cfr_jax/{command}/2"
        self._places: dict[Key, tuple[Path, int]] = {}
        self._failed: set[Key] = set()
        header = {"format": self._format, "made_with": made_with}
        if (kind := irregular(path)) is not None:
            raise Refused(f"{shown(path)} is not a regular file but {kind}")
        with _said(path):
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NONBLOCK", 0)
            self._file = os.open(path, flags, 0o666)
        try:
            self._lock()
            self._open(header)
        except BaseException:
            self.close()
            raise
        if retry:
            for key in self._failed:
                del self._places[key]

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __contains__(self, key: Key) -> bool:
        """Whether the pair is done."""
        return key in self._places

    def __iter__(self) -> Iterator[Key]:
        """The pairs that are done."""
        return iter(self._places)

    def __getitem__(self, key: Key) -> dict[str, Any]:
        """The record of a pair that is done, read again; raises ValueError if it was changed."""
        path, start = self._places[key]
        with _said(path):
            return record_at(path, start)

    def close(self) -> None:
        """Lets others open the file."""
        with contextlib.suppress(OSError):
            os.close(self._file)

    def adopt(self, path: Path, made_with: dict[str, Any]) -> None:
        """Also takes for done what another journal of the same settings holds."""
        with _said(path):
            records = records_in(path)
            start, header = next(records, (0, {}))
        if header.get("format") != self._format or not isinstance(header.get("made_with"), dict):
            older = str(header.get("format")).startswith(f"cfr_jax/{self._command}/")
            what = (
                "a journal of another version"
                if older
                else f"not a journal of `cfr {self._command}`, or damaged"
            )
            raise Refused(f"{shown(path)} exists, but is {what}\nmove it, or choose another --out")
        theirs = header["made_with"]
        differing = [name for name in made_with if theirs.get(name) != made_with[name]]
        if differing:
            name = differing[0]
            raise Refused(
                f"{shown(path)} was started with {name} {shown(repr(theirs.get(name)), 80)}, "
                f"not {made_with[name]!r}\n"
                "give the same options to continue, remove it to start over, or choose another "
                "--out"
            )
        with _said(path):
            for start, record in records:
                self._note(record, path, start)  # of a pair that was tried again, the last counts

    def _open(self, header: dict[str, Any]) -> None:
        start = line_of(header)
        if os.fstat(self._file).st_size:
            with _said(self.path), opened(self.path) as stream:
                begun = stream.read(len(start))
        else:
            begun = b""
        whole = self._size_of_whole_lines()
        if whole or not start.startswith(begun):
            self.adopt(self.path, header["made_with"])  # before anything of it is changed
        if whole < os.fstat(self._file).st_size:
            with _said(self.path):
                os.ftruncate(self._file, whole)
        if not whole:
            self._append(header)

    def _size_of_whole_lines(self) -> int:
        """Bytes up to the end of the last whole line."""
        end = os.fstat(self._file).st_size
        while end:
            size = min(end, 1 << 16)
            os.lseek(self._file, end - size, os.SEEK_SET)
            found = os.read(self._file, size).rfind(b"\n")
            if found >= 0:
                return end - size + found + 1
            end -= size
        return 0

    def write(self, record: dict[str, Any]) -> None:
        """Adds the record of a pair, and takes it for done once it is on its way to the disk.

        Raises OSError if that is not possible, and if the file was removed meanwhile.
        """
        self._note(record, self.path, self._append(record))

    def _note(self, record: dict[str, Any], path: Path, start: int) -> None:
        key = record["source"], record["target"], record["repeat"]
        self._places[key] = path, start
        (self._failed.discard if record["error"] is None else self._failed.add)(key)

    def _append(self, value: dict[str, Any]) -> int:
        """Where the line of the value starts."""
        line, start = memoryview(line_of(value)), None
        try:
            mine, there = os.fstat(self._file), os.stat(self.path)
            if (mine.st_dev, mine.st_ino) != (there.st_dev, there.st_ino):
                raise FileNotFoundError(2, "it was replaced by another file")
            start = os.lseek(self._file, 0, os.SEEK_END)
            while line:  # a signal or a full disk may cut a write short
                line = line[os.write(self._file, line) :]
        except OSError as error:
            if start is not None:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._file, start)  # no half line, should anybody go on
            raise OSError(
                f"{shown(self.path)} can no longer be written ({error.strerror})\n"
                "make room or put its folder back; the same command goes on from what is there"
            ) from error
        return start

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:  # Windows: whoever starts two of one name there has to know better
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Refused(
                f"{shown(self.path)} is being written by another `cfr {self._command}`\n"
                "wait for it, choose another --out, or split the work with --shard"
            ) from None
        except OSError:  # file systems without locks
            return


@contextlib.contextmanager
def _said(path: Path) -> Iterator[None]:
    """Within, a file that cannot be opened or read is named."""
    try:
        yield
    except OSError as error:
        raise Refused(f"{shown(path)} cannot be opened: {error.strerror}") from error
    except Refused as error:
        told = str(error)
        raise (error if shown(path) in told else Refused(f"{shown(path)} {told}")) from error

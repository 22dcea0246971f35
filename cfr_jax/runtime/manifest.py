"""The SHA-256 of every file in a folder, so that a flipped bit or a lost file is noticed and named.

Orbax alone reads an array file with a flipped bit as if nothing had happened.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from cfr_jax.runtime.messages import Refused
from cfr_jax.runtime.reading import contents, opened, parse_json

NAME = "manifest.json"
Read = TypeVar("Read")


class Damaged(ValueError):
    """The content of a folder is not what was written. The message names the file."""


def write(folder: Path) -> None:
    """Writes the manifest of everything that is in `folder` now."""
    (folder / NAME).write_bytes(_text(_files(folder)))


def verify(folder: Path) -> None:
    """Raises `Damaged` unless `folder` holds exactly what its manifest says."""
    if not os.path.lexists(folder / NAME):
        raise Damaged(f"{folder} has no {NAME}: it was never finished")
    told = _checked(folder / NAME, contents)
    found = _files(folder)
    try:
        wanted = parse_json(told)["files"]
    except (ValueError, KeyError, TypeError) as error:
        raise Damaged(f"{folder / NAME} cannot be read") from error
    # Compared byte by byte: a flipped bit may leave valid JSON, and that is damage, too.
    if not isinstance(wanted, dict) or told != _text(wanted):
        raise Damaged(f"{folder / NAME} is not as it was written")
    for name in sorted(wanted.keys() | found.keys()):
        if name not in found:
            raise Damaged(f"{folder / name} is missing")
        if name not in wanted:
            raise Damaged(f"{folder / name} does not belong there")
        if found[name] != wanted[name]:
            raise Damaged(f"{folder / name} is damaged: its SHA-256 is not what was written")


def _files(folder: Path) -> dict[str, str]:
    """The digest of each file. Whatever is no file, such as a pipe, raises `Damaged`."""
    paths = sorted(path for path in folder.rglob("*") if path.name != NAME and not _is_folder(path))
    return {path.relative_to(folder).as_posix(): _checked(path, _digest) for path in paths}


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _checked(path: Path, read: Callable[[Path], Read]) -> Read:
    try:
        return read(path)
    except Refused as error:
        raise Damaged(f"{path} {error}") from error
    except OSError as error:  # a disk that cannot read its own sectors
        raise Damaged(f"{path} cannot be read ({error.strerror})") from error


def _digest(path: Path) -> str:
    about = path.lstat()
    if stat.S_ISREG(about.st_mode) and not about.st_size:  # orbax writes empty files, too
        return hashlib.sha256().hexdigest()
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _text(files: dict) -> bytes:
    listed = json.dumps(files, indent=1, sort_keys=True)
    whole = {"files": files, "sha256": hashlib.sha256(listed.encode()).hexdigest()}
    return (json.dumps(whole, indent=1, sort_keys=True) + "\n").encode()

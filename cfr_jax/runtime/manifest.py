"""The SHA-256 of every file in a folder, so that a flipped bit or a lost file is noticed and named.

Orbax alone reads an array file with a flipped bit as if nothing had happened.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

NAME = "manifest.json"


class Damaged(ValueError):
    """The content of a folder is not what was written. The message names the file."""


def write(folder: Path) -> None:
    """Writes the manifest of everything that is in `folder` now."""
    (folder / NAME).write_bytes(_text(_files(folder)))


def verify(folder: Path) -> None:
    """Raises `Damaged` unless `folder` holds exactly what its manifest says."""
    try:
        told, found = (folder / NAME).read_bytes(), _files(folder)
    except FileNotFoundError as error:
        raise Damaged(f"{folder} has no {NAME}: it was never finished") from error
    except OSError as error:  # a disk that cannot read its own sectors
        raise Damaged(f"{error.filename} cannot be read ({error.strerror})") from error
    try:
        wanted = json.loads(told)["files"]
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
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != NAME)
    return {path.relative_to(folder).as_posix(): _digest(path) for path in paths}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _text(files: dict) -> bytes:
    listed = json.dumps(files, indent=1, sort_keys=True)
    whole = {"files": files, "sha256": hashlib.sha256(listed.encode()).hexdigest()}
    return (json.dumps(whole, indent=1, sort_keys=True) + "\n").encode()

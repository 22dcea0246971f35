"""Folders that only their owner may write: what is found in them is run."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from cfr_jax.runtime.messages import Refused, shown


def make_private(folder: Path) -> None:
    """Makes a folder that only this user may enter, or checks the one that is there.

    Raises `Refused` if it belongs to another user than this one or root, or if others may write
    into it, and OSError if it cannot be made.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    if not hasattr(os, "geteuid"):  # Windows: folders of a user's profile are private
        return
    found = folder.stat()
    if found.st_uid not in (0, os.geteuid()):
        raise Refused(f"{shown(folder)} belongs to another user")
    if stat.S_IMODE(found.st_mode) & 0o022:
        raise Refused(f"{shown(folder)} may be written by other users")

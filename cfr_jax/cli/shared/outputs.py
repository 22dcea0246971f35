"""The output files of a command: checked before it computes anything, and drawn."""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from cfr_jax.io import formats

if TYPE_CHECKING:
    from cfr_jax.viewer import Scene

PAGE_SUFFIXES = (".html", ".htm")
PICTURE_SUFFIXES = (".png",)
RECORDING_SUFFIXES = (".rrd",)
VIEW_SUFFIXES = (*PAGE_SUFFIXES, *PICTURE_SUFFIXES, *RECORDING_SUFFIXES)


def cloud_suffixes() -> tuple[str, ...]:
    """The suffixes of files that `cfr_jax.io.write` can write."""
    return tuple(formats.by_suffix(formats.writable()))


def check_output(option: str, path: Path, suffixes: tuple[str, ...] = ()) -> None:
    """Raises a ValueError that names the option if `path` cannot be written.

    `path` must have one of the suffixes, and its folder must accept new files. The check leaves no
    trace.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{option}: got {path}, wanted a name that ends in {' '.join(suffixes)}")
    if path.exists() and not path.is_file():  # a rename would replace even a device
        kind = "a folder" if path.is_dir() else "not a regular file"
        raise ValueError(f"{option}: {path} is {kind}, wanted a file to write")
    if not path.parent.is_dir():
        raise ValueError(f"{option}: there is no folder {path.parent} to write {path.name} into")
    try:
        # Permissions say little (root, read-only mounts), so try to write.
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise ValueError(
            f"{option}: the folder {path.parent} cannot be written to: {error.strerror}"
        ) from error


def check_apart(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Raises ValueError if an output would replace an input or another output."""
    taken = {os.path.realpath(path) for path in inputs}
    for path in outputs:
        place = os.path.realpath(path)
        if place in taken:
            raise ValueError(f"{path} would be overwritten: it is an input, or is written twice")
        taken.add(place)


def can_draw() -> bool:
    """Whether pictures can be written: they need matplotlib."""
    return importlib.util.find_spec("matplotlib") is not None


def check_library(option: str, path: Path) -> None:
    """Raises a ValueError that names the option and what to install if `path` cannot be drawn."""
    suffix = path.suffix.lower()
    if suffix in PICTURE_SUFFIXES and not can_draw():
        raise ValueError(f'{option}: pictures need matplotlib: pip install "cfr_jax[viz]"')
    if suffix in RECORDING_SUFFIXES and importlib.util.find_spec("rerun") is None:
        raise ValueError(f'{option}: recordings need rerun: pip install "cfr_jax[rerun]"')


def draw(scene: Scene, paths: Iterable[Path]) -> None:
    """Draws `scene` into each file; the suffix decides between picture, recording and page."""
    from cfr_jax import viewer

    for path in paths:
        suffix = path.suffix.lower()
        if suffix in PICTURE_SUFFIXES:
            viewer.write_picture(path, scene)
        elif suffix in RECORDING_SUFFIXES:
            viewer.write_recording(path, scene)
        else:
            viewer.write_page(path, scene)

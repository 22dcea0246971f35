"""Debian packages: downloaded with apt, opened without dpkg.

A `.deb` is an `ar` archive with a few members. The member `data.tar` (compressed) holds the files.
It is read here so that a corpus can be built on machines without dpkg.
"""

from __future__ import annotations

import lzma
import os
import shutil
import subprocess
import tarfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Literal, cast
from urllib.parse import unquote

from cfr_jax.runtime.atomic import unfinished
from cfr_jax.runtime.progress import Progress

_MAGIC = b"!<arch>\n"
_HEADER = 60  # bytes: name 16, date 12, owner 6, group 6, mode 8, size 10, end marker 2


def download(package: str, folder: Path) -> Path:
    """The package's file in `folder`, downloaded with `apt-get download` unless it is there.

    Raises ValueError, saying what to do, if apt is missing or cannot download the package.
    """
    if (present := find_deb(package, folder)) is not None:
        return present
    if shutil.which("apt-get") is None:
        raise ValueError(
            f"package {package}: there is no apt-get here; download {package}_*.deb from "
            f"https://packages.debian.org/{package} and pass its folder as --debs"
        )
    beside = folder / f".{package}.part"
    beside.mkdir(parents=True, exist_ok=True)
    # apt drops its privileges for the transfer if it can, and may then lack access to our folder.
    command = ["apt-get", "-o", "APT::Sandbox::User=root", "-q", "download", package]
    done = subprocess.run(command, cwd=beside, capture_output=True, text=True)
    if done.returncode or (fetched := find_deb(package, beside)) is None:
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise ValueError(
            f"package {package}: apt-get download failed ({last}); "
            "`apt-get update` may help, or pass the folder of the .deb files as --debs"
        )
    kept = folder / fetched.name
    os.replace(fetched, kept)
    beside.rmdir()
    return kept


def version_of(deb: Path) -> str:
    """The version in the file's name, in which a colon is written as %3a."""
    return unquote(deb.name.split("_")[1])


def find_deb(package: str, folder: Path) -> Path | None:
    """`folder/package_VERSION_ARCH.deb`: the last by name if there are several, None if none."""
    found = sorted(folder.glob(f"{package}_*.deb")) if folder.is_dir() else []
    return found[-1] if found else None


def extract(
    deb: Path, wanted: Callable[[str], bool], into: Path, quiet: bool = False
) -> list[Path]:
    """Extracts the regular files of a package whose path (`usr/share/...`) is wanted into `into`.

    Returns their paths in the package's order. An existing file of the right size is kept. Raises
    ValueError if the file is not a Debian package or is truncated.
    """
    written = []
    with _data_tar(deb, quiet) as tar:
        for member in tar:
            inside = PurePosixPath(member.name)
            name = str(inside)
            if not member.isfile() or not wanted(name):
                continue
            if inside.is_absolute() or ".." in inside.parts:
                raise ValueError(f"{deb}: holds {member.name!r}, which leaves the package")
            path = into / inside
            written.append(path)
            if path.is_file() and path.stat().st_size == member.size:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            content = tar.extractfile(member)
            assert content is not None  # regular files have content
            with content, unfinished(path) as beside, open(beside, "wb") as stream:
                shutil.copyfileobj(content, stream, 1 << 20)
    return written


# "r|" reads the stream in one pass, which ends at the tar's own end marker.
_MODES: dict[str, Literal["r|", "r|gz", "r|bz2", "r|xz"]] = {
    "": "r|",
    "gz": "r|gz",
    "bz2": "r|bz2",
    "xz": "r|xz",
}


@contextmanager
def _data_tar(deb: Path, quiet: bool) -> Iterator[tarfile.TarFile]:
    try:
        with open(deb, "rb") as stream:
            name = _seek_data(stream, deb)
            kind = name.removeprefix("data.tar").removeprefix(".")
            if kind not in _MODES:
                raise ValueError(
                    f"{deb}: {name} has a compression that Python 3.11 cannot read; repack it "
                    "with `dpkg-deb`, or use the package of Debian 12"
                )
            with Progress.wrapattr(
                stream,
                "read",
                total=deb.stat().st_size,
                desc=deb.name.split("_")[0],
                disable=quiet,
                unit="B",
                unit_scale=True,
            ) as counted:
                # tqdm's stubs only know the wrapped method, but it passes on all others
                whole = cast(IO[bytes], counted)
                with tarfile.open(fileobj=whole, mode=_MODES[kind]) as tar:
                    yield tar
    except (OSError, EOFError, tarfile.TarError, lzma.LZMAError, zlib.error) as error:
        raise ValueError(f"{deb} is not a complete Debian package: {error}") from error


def _seek_data(stream: IO[bytes], deb: Path) -> str:
    """Moves to the first byte of `data.tar...` and returns that member's name."""
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise ValueError(f"{deb} is not a Debian package: it does not start with {_MAGIC!r}")
    while True:
        header = stream.read(_HEADER)
        size = header[48:58].strip()
        if len(header) < _HEADER or header[58:] != b"`\n" or not size.isdigit():
            raise ValueError(f"{deb}: holds no data.tar, or is cut off")
        name = header[:16].decode("latin1").strip().rstrip("/")
        if name.startswith("data.tar"):
            # If the tar were truncated, its last files would be missing without an error.
            if stream.tell() + int(size) > os.fstat(stream.fileno()).st_size:
                raise ValueError(f"{deb} is cut off: {name} should have {int(size)} bytes")
            return name
        stream.seek(int(size) + int(size) % 2, os.SEEK_CUR)

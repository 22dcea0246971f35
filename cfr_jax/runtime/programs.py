"""Compiles programs for given argument sizes, and keeps lowered programs between processes.

JAX's compilation cache looks up a lowered program, but tracing and lowering take longer than
loading and running. So lowered programs are kept as well, if `keep_in` names a folder for them.
They are stored in the format of `jax.export`: StableHLO, so reading one runs no code.
Everything that could change a program is part of its file name: the sources of this package, the
versions of JAX, its options that the environment sets, and the sizes of the arguments.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flax
import jax
import jaxlib
from jax import export as jax_export

from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.checksums import sealed, unsealed
from cfr_jax.runtime.entries import entry
from cfr_jax.runtime.private import make_private

_UNUSED = 30 * 24 * 3600.0  # seconds without use after which a program is deleted
_places: list[Path] = []  # the folder that programs are kept in; empty means none


def keep_in(folder: Path) -> None:
    """From now on, keeps lowered programs in `folder` until they have not been used for a month.

    Only this user may enter a folder that is made. If the folder cannot be written, programs are
    traced again in each process, without an error. Raises ValueError if the folder belongs to
    another user or others may write into it: the programs in it are run and their answers believed.
    """
    place = folder / _versions()
    for each in (folder, place):
        with contextlib.suppress(OSError):
            make_private(each)
    _places[:] = [place]


def storable(*nodes: type) -> None:
    """Registers dataclasses of arrays, so that programs that take or return them can be kept."""
    for node in nodes:
        jax_export.register_pytree_node_serialization(
            node,
            serialized_name=f"{node.__module__}.{node.__qualname__}",
            serialize_auxdata=lambda _: b"",
            deserialize_auxdata=lambda _: (),
        )


def storable_static(node: type, write: Callable[[Any], str], read: Callable[[str], Any]) -> None:
    """`storable` for a static class (`jax.tree_util.register_static`).

    `write` turns an instance into a string, and `read` turns the string back into an instance.
    """
    jax_export.register_pytree_node_serialization(
        node,
        serialized_name=f"{node.__module__}.{node.__qualname__}",
        serialize_auxdata=lambda one: write(one).encode(),
        deserialize_auxdata=lambda text: read(text.decode()),
    )


@entry
def compiled(function: Callable, *arguments: Any, **static: Any) -> Callable:
    """The compiled program of a jitted function for arguments of these shapes and types.

    It is made once per combination. With it, compiling can be timed separately from running.
    """
    leaves, structure = jax.tree.flatten(arguments)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
    return _program(function, tuple(static.items()), structure, shapes)


@functools.lru_cache(maxsize=64)
def _program(
    function: Any,
    static: tuple[tuple[str, Any], ...],
    structure: jax.tree_util.PyTreeDef,
    shapes: tuple[tuple[tuple[int, ...], Any], ...],
) -> jax.stages.Compiled:
    arguments = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    # Lambdas, and functions among the options, cannot be told apart by name, so their programs are
    # not kept.
    if _places and "<" not in f"{function.__qualname__}{static}":
        name = _digest(function.__module__, function.__qualname__, static, structure, shapes)
        path = _places[0] / f"{function.__name__}-{name}.stablehlo"
        exported = _read(path)
        if exported is None:
            exported = jax_export.export(function)(*arguments, **dict(static))
            _keep(path, exported)
        return jax.jit(exported.call).lower(*arguments).compile()
    return function.lower(*arguments, **dict(static)).compile()


def _read(path: Path) -> jax_export.Exported | None:
    """The program kept at `path`, or None if there is none or the file is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    program = unsealed(content)
    if program is None:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # marks it as used today
    return jax_export.deserialize(bytearray(program))


def _keep(path: Path, exported: jax_export.Exported) -> None:
    """Writes the program to `path`, unless the disk refuses or a type in it is not `storable`."""
    try:
        content = bytes(exported.serialize())
    except ValueError:
        return
    with contextlib.suppress(OSError):
        _throw_away_unused(path.parent.parent)
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomically(path, sealed(content))


def _throw_away_unused(folder: Path) -> None:
    for path in folder.glob(f"programs-{24 * '[0-9a-f]'}/*-{24 * '[0-9a-f]'}.stablehlo*"):
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > _UNUSED:
                path.unlink()


def _versions() -> str:
    """A folder name that depends on everything that a program depends on, except the arguments."""
    package = Path(__file__).parents[1]
    files = ((path.relative_to(package), path.stat()) for path in sorted(package.rglob("*.py")))
    return "programs-" + _digest(
        *((str(name), stat.st_size, stat.st_mtime_ns) for name, stat in files),
        jax.__version__,
        jaxlib.__version__,
        flax.__version__,
        jax.default_backend(),
        *sorted(item for item in os.environ.items() if item[0].startswith(("JAX_", "XLA_"))),
    )


def _digest(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:24]

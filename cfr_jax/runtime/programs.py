"""Programs compiled for arguments of given sizes, and kept between processes as they were lowered.

JAX's compilation cache is asked with a lowered program, and to trace and lower one takes longer
than to load and run it. So where there is a folder for them (`keep_in`), lowered programs are kept
as well, as `jax.export` writes them: StableHLO, nothing that could be run while it is read.
Whatever could change a program is part of its name: the sources of this package, the versions of
JAX, its options as far as the environment sets them, the sizes of the arguments.
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

_SHA256 = 32  # bytes, in front of each file
_UNUSED = 30 * 24 * 3600.0  # seconds after which a program is thrown away
_places: list[Path] = []  # where programs are kept; empty: nowhere


def keep_in(folder: Path) -> None:
    """From now on, lowered programs are kept in `folder`, a month after they were last used. Where
    nothing can be written, they are traced again, and nothing else happens."""
    _places[:] = [folder / _versions()]


def storable(*nodes: type) -> None:
    """Says that programs can be kept that take or answer these dataclasses of arrays."""
    for node in nodes:
        jax_export.register_pytree_node_serialization(
            node,
            serialized_name=f"{node.__module__}.{node.__qualname__}",
            serialize_auxdata=lambda _: b"",
            deserialize_auxdata=lambda _: (),
        )


def storable_static(node: type, write: Callable[[Any], str], read: Callable[[str], Any]) -> None:
    """The same for a class that is static (`jax.tree_util.register_static`), by what makes a text
    of one and one of a text."""
    jax_export.register_pytree_node_serialization(
        node,
        serialized_name=f"{node.__module__}.{node.__qualname__}",
        serialize_auxdata=lambda one: write(one).encode(),
        deserialize_auxdata=lambda text: read(text.decode()),
    )


def compiled(function: Callable, *arguments: Any, **static: Any) -> Callable:
    """The compiled program of a jitted function for arguments of these sizes, made once, so that
    compiling can be timed apart from running."""
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
    # two lambdas have one name, and so have functions among the options whose code may change
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
    """The program kept at `path`; None where there is none, or not the one that was written."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    told, content = content[:_SHA256], content[_SHA256:]
    if told != hashlib.sha256(content).digest():
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # used today
    return jax_export.deserialize(bytearray(content))


def _keep(path: Path, exported: jax_export.Exported) -> None:
    """Writes the program to `path`, if there is room, and it is made of what is `storable`."""
    try:
        content = exported.serialize()
    except ValueError:
        return
    with contextlib.suppress(OSError):
        _throw_away_unused(path.parent.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, hashlib.sha256(content).digest() + content)


def _throw_away_unused(folder: Path) -> None:
    for path in folder.glob(f"programs-{24 * '[0-9a-f]'}/*-{24 * '[0-9a-f]'}.stablehlo*"):
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > _UNUSED:
                path.unlink()


def _versions() -> str:
    """Of everything that a lowered program depends on but the arguments."""
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

"""Local refinement makes a nearly right motion precise. One file per method, and one table.

A refinement is a function `refine(source, target, initial, **options) -> Fit`. It gets two surfaces
in the unit sphere and a (4, 4) motion of the source onto the target, from which it starts
(`surfaces` has the types). To add one, write a file with such a function and add a line to the
table. `add` registers one from outside the package.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from cfr_jax.runtime.optional import require

if TYPE_CHECKING:
    from cfr_jax.refine.surfaces import Fit

DEFAULT = "own"
# What an option `refine` takes. The literals let editors complete the names in the table.
Refine = bool | Literal["own", "small_gicp", "all_points", "pyramid"] | str


@dataclass(frozen=True)
class Refinement:
    """One refinement method. Call it like the function that it names."""

    name: str
    title: str
    """A description for people."""
    home: str | Callable[..., Fit]
    """The function, or its location as "module:function", which is imported on first use."""
    traceable: bool = False
    """Whether JAX can trace it. If so, it becomes part of the network's program and gets
    ``Surface`` objects. All others run on the host and get ``HostSurface`` objects."""
    every_point: bool = False
    """Whether it gets all points of the clouds, and not only those that the network saw."""
    library: str | None = None
    """The optional library that it needs, if any."""

    def __call__(self, source: Any, target: Any, initial: Any, **options: Any) -> Fit:
        """Returns the fit found from `initial`. Raises ModuleNotFoundError if its library is
        missing, and ValueError if the function returns no `Fit`."""
        from cfr_jax.refine.surfaces import Fit

        self.require()
        found = self.function()(source, target, initial, **options)
        if not isinstance(found, Fit):  # the function may be anyone's
            raise ValueError(
                f"refine: {self.name} returned a {type(found).__name__}, wanted a "
                "cfr_jax.refine.surfaces.Fit"
            )
        return found

    def function(self) -> Callable[..., Fit]:
        """The function itself, imported if necessary."""
        if not isinstance(self.home, str):
            return self.home
        module, _, name = self.home.partition(":")
        return getattr(importlib.import_module(module), name)

    def require(self) -> None:
        """Raises ModuleNotFoundError if its library is missing, and says how to install it."""
        if self.library is not None:
            require(self.library)


_HERE = "cfr_jax.refine"
_TABLE = {
    each.name: each
    for each in (
        Refinement(
            DEFAULT,
            "the generalized ICP of cfr_jax",
            f"{_HERE}.generalized_icp:refine",
            traceable=True,
        ),
        Refinement(
            "small_gicp",
            "the generalized ICP of the library small_gicp",
            f"{_HERE}.small_gicp:refine",
            library="small_gicp",
        ),
        Refinement(
            "all_points",
            "generalized ICP on all points, by small_gicp where it is installed",
            f"{_HERE}.all_points:refine",
            every_point=True,
        ),
        Refinement(
            "pyramid",
            "the generalized ICP of cfr_jax on all points, from coarse to fine",
            f"{_HERE}.pyramid:refine",
            every_point=True,
        ),
    )
}


def names() -> tuple[str, ...]:
    """The names in the table."""
    return tuple(_TABLE)


def add(refinement: Refinement) -> None:
    """Puts a refinement into the table. Raises ValueError if its name is taken or contains a
    colon."""
    if not isinstance(refinement, Refinement):
        raise ValueError(f"refinement: got {refinement!r}, wanted a Refinement")
    if refinement.name in _TABLE or ":" in refinement.name:
        raise ValueError(
            f"name: got {refinement.name!r}, wanted a name that is not taken and has no colon"
        )
    _TABLE[refinement.name] = refinement


def named(name: str) -> Refinement:
    """The refinement with this name.

    "module:function" names any importable function, which then runs on the host. This is how
    commands and configs use a refinement that is not in the table of their process. Raises
    ValueError for any other name.
    """
    if isinstance(name, str) and name in _TABLE:
        return _TABLE[name]
    if isinstance(name, str) and ":" in name:
        return _elsewhere(name)
    raise ValueError(
        f"refine: got {name!r}, wanted True, False, {', '.join(map(repr, _TABLE))}, "
        'or "module:function"'
    )


def find(refine: Refine) -> Refinement | None:
    """The refinement that an option asks for: the named one, the default for True, or None for
    False."""
    if isinstance(refine, bool):
        return named(DEFAULT) if refine else None
    return named(refine)


def _elsewhere(place: str) -> Refinement:
    found = Refinement(place, place, place)
    try:
        found.function()
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"refine: got {place!r}, which cannot be imported: {error}") from error
    return found

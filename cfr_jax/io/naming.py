"""Which columns are x, y, z and the normals, told by the names of the columns.

All formats with named columns ask here, so that a name means the same in all of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_AXES = ("x", "y", "z")
_UNIT = re.compile(r"[\[({<]\s*([^\])}>]*?)\s*[\])}>]\s*$")
_BEFORE = (
    r"(?:pos|position|positions|pt|point|points|coord|coords|coordinate|coordinates|cartesian)"
)
_LENGTH = r"(?:um|mm|cm|dm|m|km|in|ft|meter|meters|metre|metres|millimeter|millimeters)"
_POINT = re.compile(
    rf"(?:{_BEFORE}[._:\- ]?)?([xyz])"
    rf"(?:[._:\- ]?(?:pos|position|coord|coordinate))?(?:[._\- ]({_LENGTH}))?"
)
_POINT_BY_NUMBER = re.compile(rf"{_BEFORE}[._:\-]?\[?([012])\]?")
_NORMAL = re.compile(r"(?:n|nrm|norm|normal|normals)[._:\- ]?([xyz])|normals?[._:\-]?\[?([012])\]?")
HOW_TO_SAY = "columns (--columns) gives the names in order, as in x,y,z,intensity"


@dataclass(frozen=True)
class Roles:
    """Positions of the columns x, y, z, and of the three normals if there are any."""

    points: tuple[int, ...]
    normals: tuple[int, ...] = ()


def roles_of(names: Sequence[str]) -> Roles:
    """The roles of columns with these names.

    Upper and lower case are alike, and so are `x`, `pos_x`, `x [m]` and `Points:0`. The plain names
    x, y, z come first where there are others, too. Raises ValueError where an axis is missing or
    stands there twice, and where the units in the names differ.
    """
    plain = [_plain(name) for name in names]
    points = _exact(plain, _AXES) or _matched(plain, names)
    normals = (
        _exact(plain, ("nx", "ny", "nz"))
        or _exact(plain, ("normal_x", "normal_y", "normal_z"))
        or _three([_normal_axis(name) for name in plain])
    )
    return Roles(points, normals if not set(normals) & set(points) else ())


def are_names(names: Sequence[str]) -> bool:
    """Whether these words name x, y and z, each once."""
    try:
        roles_of(names)
    except ValueError:
        return False
    return True


def checked_columns(columns: str | Iterable[str] | None) -> tuple[str, ...] | None:
    """The names that a user gave for the columns of a file, one for each.

    A string is split at commas or blanks. Raises ValueError where x, y, z are not among the names
    once each.
    """
    if columns is None:
        return None
    if isinstance(columns, str):
        columns = columns.replace(",", " ").split()
    names = tuple(columns)
    if not all(isinstance(name, str) and name.strip() for name in names):
        raise ValueError(f"columns: wanted names, as in 'x,y,z,intensity', got {names!r:.80}")
    try:
        roles_of(names)
    except ValueError as error:
        raise ValueError(f"columns: {error}") from None
    return names


def renamed(names: Sequence[str], columns: Sequence[str] | None) -> list[str]:
    """The names of a file's columns: its own, or those that the user gave.

    Columns beyond those that the user named are only numbered. Raises ValueError for more names
    than columns.
    """
    if columns is None:
        return list(names)
    if len(columns) > len(names):
        raise ValueError(
            f"columns: got {len(columns)} names ({', '.join(columns)}), the file has "
            f"{len(names)} columns"
        )
    rest = [f"column_{k + 1}" for k in range(len(columns), len(names))]
    return [*columns, *rest]


def _plain(name: str) -> str:
    return name.strip().strip("\"'").strip().lower()


def _without_unit(name: str) -> tuple[str, str]:
    unit = _UNIT.search(name)
    return (name, "") if unit is None else (name[: unit.start()].strip(), unit[1])


def _exact(plain: list[str], wanted: Sequence[str]) -> tuple[int, ...]:
    counts = [plain.count(name) for name in wanted]
    if min(counts) == 0:
        return ()
    if max(counts) > 1:
        twice = wanted[counts.index(max(counts))]
        raise ValueError(f"has {twice!r} {max(counts)} times, wanted it once; {HOW_TO_SAY}")
    return tuple(plain.index(name) for name in wanted)


def _matched(plain: list[str], names: Sequence[str]) -> tuple[int, ...]:
    """The columns whose names say x, y, z in other words."""
    found: dict[str, list[int]] = {axis: [] for axis in _AXES}
    units: dict[int, str] = {}
    for position, name in enumerate(plain):
        bare, unit = _without_unit(name)
        match = _POINT.fullmatch(bare)
        number = _POINT_BY_NUMBER.fullmatch(name)
        if match is not None:
            found[match[1]].append(position)
            units[position] = unit or match[2] or ""
        elif number is not None:
            found[_AXES[int(number[1])]].append(position)
            units[position] = ""
    missing = [axis for axis in _AXES if not found[axis]]
    listed = ", ".join(names[:12])[:120] or "no columns"
    if missing:
        raise ValueError(f"has no {' and no '.join(missing)} among {listed}; {HOW_TO_SAY}")
    twice = [axis for axis in _AXES if len(found[axis]) > 1]
    if twice:
        raise ValueError(f"several columns may be {twice[0]} among {listed}; {HOW_TO_SAY}")
    chosen = tuple(found[axis][0] for axis in _AXES)
    if len({units[position] for position in chosen}) > 1:
        raise ValueError(f"x, y, z are in different units among {listed}, wanted one")
    return chosen


def _normal_axis(name: str) -> str | None:
    match = _NORMAL.fullmatch(_without_unit(name)[0]) or _NORMAL.fullmatch(name)
    if match is None:
        return None
    return match[1] or _AXES[int(match[2])]


def _three(axes: list[str | None]) -> tuple[int, ...]:
    if any(axes.count(axis) != 1 for axis in _AXES):
        return ()
    return tuple(axes.index(axis) for axis in _AXES)

"""Columns without names: which are points and normals, and what would contradict that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cfr_jax.io.cloud import UNIT_TOLERANCE, as_float64
from cfr_jax.io.naming import HOW_TO_SAY, Roles

# More numbers than this to a point are not seen; few long rows are a cloud on its side.
_MOST_COLUMNS = 64
# Fewer rows are in any order, and whole, by chance.
_FEWEST_TO_JUDGE = 8


def roles_of_unnamed(columns: Sequence[np.ndarray]) -> tuple[Roles, tuple[str, ...]]:
    """The roles of columns (n,) without names, and notes on what was not certain.

    Three columns are x, y, z. The last three of six are normals if they look like it: vectors of
    unit length, not all of them along the axes in positive direction, as colors of 0 and 1 are.
    Of all others the first three are x, y, z, and a note says so. Raises ValueError where the
    numbers contradict that: an index or a time in front, whole numbers beside fractions.
    """
    rows, width = len(columns[0]) if columns else 0, len(columns)
    if width < 3:
        raise ValueError(
            f"wanted rows of x, y, z and perhaps more, got the shape ({rows}, {width})"
        )
    if width > _MOST_COLUMNS or (rows <= 6 and width > 4 * rows > 0 and width > 8):
        raise ValueError(
            f"got the shape ({rows}, {width}), wanted a row for each point: is it transposed (.T)?"
        )
    first = Roles((0, 1, 2))
    if width == 3:
        return first, ()
    if width == 6:
        last = are_unit(columns[3:])
        if last and not along_axes(columns[3:]):
            return Roles((0, 1, 2), (3, 4, 5)), ()
        if rows >= _FEWEST_TO_JUDGE and not last and are_unit(columns[:3]):
            raise ValueError(
                f"columns 1 to 3 are unit vectors, normals before the points? {HOW_TO_SAY}"
            )
        why = "may as well be colors or labels" if last else "are not unit vectors"
    contradiction = _contradiction(columns) if rows >= _FEWEST_TO_JUDGE else None
    if contradiction is not None:
        raise ValueError(f"{contradiction}; {HOW_TO_SAY}")
    if width == 6:
        note = (
            f"columns 4 to 6 {why} and were not taken for normals; to take them, name the "
            "columns (--columns) x,y,z,nx,ny,nz"
        )
    else:
        note = f"took the first three of {width} columns without names for x, y, z; {HOW_TO_SAY}"
    return first, (note,)


def are_unit(columns: Sequence[np.ndarray]) -> bool:
    """Whether the three columns (n,) are vectors of about unit length, all of them."""
    with np.errstate(over="ignore", invalid="ignore"):
        squares = sum(as_float64(column) ** 2 for column in columns)
    # NaN compares false: rows that are no numbers are no normals.
    return len(columns[0]) > 0 and bool(np.all(np.abs(squares - 1.0) <= 2.0 * UNIT_TOLERANCE))


def along_axes(columns: Sequence[np.ndarray]) -> bool:
    """Whether each row is (1, 0, 0), (0, 1, 0) or (0, 0, 1): colors and labels are, too."""
    return all(bool(np.all((column == 0) | (column == 1))) for column in columns)


def _contradiction(columns: Sequence[np.ndarray]) -> str | None:
    """What speaks against the first three of four columns or more being x, y, z."""
    with np.errstate(invalid="ignore"):  # infinities
        steps = np.diff(as_float64(columns[0]))
        if np.all(steps == 1) and columns[0][0] in (0, 1):
            return "column 1 counts the rows, so it is an index and not x"
        if np.all(steps > 0):
            return "column 1 grows from row to row: a time or x"
    whole = [_whole(column) for column in columns[:3]]
    varied = [_varies(column) for column in columns[:3]]
    odd = [k for k in range(3) if whole[k] and varied[k]]
    if odd and any(not whole[k] for k in range(3)):
        return (
            f"column {odd[0] + 1} holds whole numbers and others of the first three fractions, so "
            "they may not be x, y, z"
        )
    return None


def _whole(column: np.ndarray) -> bool:
    if column.dtype.kind in "iub":
        return True
    finite = column[np.isfinite(column)]
    return bool(np.all(finite == np.rint(finite)))


def _varies(column: np.ndarray) -> bool:
    finite = column[np.isfinite(column)] if column.dtype.kind == "f" else column
    return len(finite) > 0 and bool(finite.min() != finite.max())

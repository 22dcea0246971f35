"""Rows that come in blocks, joined without holding them twice."""

from __future__ import annotations

import numpy as np


class Growing:
    """An array that grows at its end, of the first type that holds all it gets, or float64.

    Memory is a ninth more than the rows at most: the system moves large arrays without a copy.
    """

    def __init__(self, kind: str, width: int | None = None) -> None:
        self._row = () if width is None else (width,)
        self._rows = np.empty((0, *self._row), kind)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def nbytes(self) -> int:
        return self._rows.nbytes

    def append(self, rows: np.ndarray) -> None:
        """Adds rows behind the others."""
        behind = self._count + len(rows)
        if self._rows.dtype != np.float64 and rows.dtype.kind == "f":
            with np.errstate(invalid="ignore"):
                cast = rows.astype(self._rows.dtype)
            if not np.array_equal(cast, rows):
                self._rows = self._rows.astype(np.float64)
        if behind > len(self._rows):
            self._rows.resize((behind + behind // 8, *self._row), refcheck=False)
        self._rows[self._count : behind] = rows
        self._count = behind

    def joined(self) -> np.ndarray:
        """All rows; nothing can be added after that."""
        self._rows.resize((self._count, *self._row), refcheck=False)
        return self._rows

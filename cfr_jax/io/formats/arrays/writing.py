"""Clouds as NPY and NPZ."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import PointCloud
from cfr_jax.io.table import Table, without_faces


def save_npy(stream: BinaryIO, cloud: PointCloud) -> list[str]:
    """One array: (n, c) if all columns have one type and no names, else a structured one."""
    table, notes = without_faces(cloud, "NPY")
    notes += _lost(table, "NPY")
    np.save(stream, _as_array(table), allow_pickle=False)
    return notes


def _as_array(table: Table) -> np.ndarray:
    kinds = {values.dtype for values in table.values}
    fields_before = table.named and table.format == "NPY"
    if len(kinds) == 1 and not fields_before and (table.is_bare or not table.named):
        if all(values.ndim == 1 for values in table.values):
            return np.stack(table.values, axis=1)
        return np.hstack(table.values)
    fields = [
        (name, values.dtype, values.shape[1:])
        for name, values in zip(unique(table.names), table.values, strict=True)
    ]
    array = np.empty(len(table.values[0]), fields)
    for (name, *_), values in zip(fields, table.values, strict=True):
        array[name] = values
    return array


def save_npz(stream: BinaryIO, cloud: PointCloud) -> list[str]:
    """The arrays `points` and, if there are any, `normals`, and one for every other column."""
    table, notes = without_faces(cloud, "NPZ")
    if table.format == "NPZ":
        arrays = dict(zip(table.names, table.values, strict=True)) | dict(table.rest or {})
        np.savez(stream, **arrays)  # type: ignore[arg-type]  # no key is called allow_pickle
        return notes
    taken = {*table.roles.points, *table.roles.normals}
    arrays = {"points": _stacked(table, table.roles.points)}
    if table.roles.normals:
        arrays["normals"] = _stacked(table, table.roles.normals)
    for k, (name, values) in enumerate(zip(unique(table.names), table.values, strict=True)):
        if k not in taken:
            arrays[name if name not in arrays else f"{name}_2"] = values
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return notes + _lost(table, "NPZ")


def _stacked(table: Table, columns: tuple[int, ...]) -> np.ndarray:
    if len(columns) == 1:
        return table.values[columns[0]]
    return np.stack([table.values[column] for column in columns], axis=1)


def _lost(table: Table, form: str) -> list[str]:
    rest = table.rest if table.format == "NPZ" and form == "NPY" else None
    return [f"left out the arrays {', '.join(rest)}: {form} holds one"] if rest else []


def unique(names: tuple[str, ...]) -> list[str]:
    """The names with a number behind those that came before."""
    seen: dict[str, int] = {}
    told = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        told.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return told

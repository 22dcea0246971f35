"""Columns mean what they say: two hundred layouts in every format are read rightly or refused."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pandas
import plyfile
import pytest
from kind_samples import npy

from cfr_jax.io import CloudFileError, CloudWarning, read

LAYOUTS = 200
COUNT = 48
OTHERS = ("id", "time", "intensity", "label", "ring", "red", "green", "blue", "curvature")
FORMATS = (
    "savetxt", "savetxt with names", "csv", "csv without names", "csv of pandas", "semicolons",
    "npy", "npy with names", "npz", "ply", "ply text", "pcd", "bin",
)  # fmt: skip


def layout(seed: int, named: bool) -> tuple[list[str], dict[str, np.ndarray]]:
    """Names of columns in a random order, and what they hold.

    Where the file will not have the names, x comes before y and y before z, as for the normals:
    axes in another order are another frame, which no number tells.
    """
    rng = np.random.default_rng(seed)
    names = [*rng.choice(OTHERS, rng.integers(0, 6), replace=False)]
    if rng.random() < 0.4:
        names += ["nx", "ny", "nz"]
    rng.shuffle(names)
    axes = ["x", "y", "z"]
    together = rng.random() < 0.6
    at = int(rng.integers(0, len(names) + 1)) if rng.random() < 0.5 else 0
    places = [at if together else int(rng.integers(0, len(names) + 1)) for _ in axes]
    if named:
        rng.shuffle(axes)
    else:
        directions = iter(("nx", "ny", "nz"))
        names = [next(directions) if name.startswith("n") else name for name in names]
        places = sorted(places, reverse=True)
        axes.reverse()  # what comes later in front of the others ends before them
    for place, axis in zip(places, axes, strict=True):
        names.insert(place, axis)
    extent = 10.0 ** rng.integers(-1, 3)
    points = rng.normal(size=(COUNT, 3)) * extent * [1, 1, 0.2]
    if rng.random() < 0.2:
        points = np.rint(points * 1000)  # millimeters
    normals = rng.normal(size=(COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = rng.integers(0, 256, (COUNT, 3)) / rng.choice([1, 255])
    held = {
        "id": np.arange(COUNT) + rng.integers(0, 2),
        "time": 1.6e9 + np.cumsum(rng.uniform(0.01, 1, COUNT)),
        "intensity": rng.uniform(0, rng.choice([1, 255]), COUNT),
        "label": rng.integers(0, 9, COUNT),
        "ring": rng.integers(0, 32, COUNT),
        "curvature": rng.uniform(0, 0.3, COUNT),
    }
    for k, (axis, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        held |= {axis: points[:, k], f"n{axis}": normals[:, k], color: colors[:, k]}
    return [str(name) for name in names], {name: np.asarray(held[name], float) for name in names}


def put(folder: Path, form: str, names: list[str], held: dict[str, np.ndarray]) -> Path:
    """The columns in one format, by the library that is known for it where there is one."""
    table = np.stack([held[name] for name in names], axis=1)
    frame = pandas.DataFrame(table, columns=names)
    path = folder / f"cloud{ENDINGS[form]}"
    if form == "savetxt":
        np.savetxt(path, table)
    elif form == "savetxt with names":
        np.savetxt(path, table, header=" ".join(names))
    elif form == "csv":
        frame.to_csv(path, index=False)
    elif form == "csv without names":
        frame.to_csv(path, index=False, header=False)
    elif form == "csv of pandas":
        frame.to_csv(path)
    elif form == "semicolons":
        frame.to_csv(path, sep=";", decimal=",", index=False)
    elif form == "npy":
        np.save(path, table)
    elif form == "npy with names":
        path.write_bytes(npy(frame.to_records(index=False)))
    elif form == "npz":
        np.savez(path, table)
    elif form.startswith("ply"):
        element = plyfile.PlyElement.describe(np.asarray(frame.to_records(index=False)), "vertex")
        plyfile.PlyData([element], text=form.endswith("text")).write(path)
    elif form == "pcd":
        width = len(names)
        head = f"VERSION .7\nFIELDS {' '.join(names)}\nSIZE{' 8' * width}\nTYPE{' F' * width}\n"
        head += f"WIDTH {COUNT}\nHEIGHT 1\nPOINTS {COUNT}\nDATA binary\n"
        path.write_bytes(head.encode() + table.tobytes())
    else:
        path.write_bytes(table.astype("<f4").tobytes())
    return path


ENDINGS = {
    "savetxt": ".txt", "savetxt with names": ".xyz", "csv": ".csv", "csv without names": ".csv",
    "csv of pandas": ".csv", "semicolons": ".csv", "npy": ".npy", "npy with names": ".npy",
    "npz": ".npz", "ply": ".ply", "ply text": ".ply", "pcd": ".pcd", "bin": ".bin",
}  # fmt: skip
NAMED = tuple(
    form for form in FORMATS if form not in ("savetxt", "csv without names", "npy", "npz", "bin")
)


@pytest.mark.parametrize("form", FORMATS)
def test_columns_of_any_layout_are_read_rightly_or_refused_in_words(form, tmp_path):
    right = refused = 0
    wrong = []
    for seed in range(LAYOUTS):
        names, held = layout(seed, form in NAMED)
        if form == "npy with names" and len(names) == 3:
            continue
        path = put(tmp_path, form, names, held)
        points = np.stack([held[axis] for axis in "xyz"], axis=1)
        if form == "bin":
            points = points.astype("f4")
        # when
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                cloud = read(path)
            except CloudFileError as error:
                refused += 1
                assert "columns" in str(error) or "rows of" in str(error), str(error)
                continue
        # then
        if np.array_equal(cloud.points, points):
            right += 1
            expected = "nx" in names and form in NAMED
            if expected != (cloud.normals is not None) and not told and "nx" not in names:
                wrong.append((seed, names, "normals"))
            if cloud.normals is not None:
                kept = np.stack([held[f"n{axis}"] for axis in "xyz"], axis=1)
                if not np.allclose(cloud.normals, kept, atol=1e-5):
                    wrong.append((seed, names, "other normals"))
        elif not told:
            wrong.append((seed, names, "points"))
        assert all(issubclass(warning.category, CloudWarning) for warning in told)
    assert wrong == []
    if form in NAMED:
        assert refused == 0 and right > 0  # names leave nothing to refuse
    else:
        assert right and refused

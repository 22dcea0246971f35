"""Text as programs really write it, all of `io_samples.points()`, by what is odd about each.

Each sample is a file name and its bytes; `io_samples` has the plain ones.
"""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pandas
from io_samples import COUNT, normals, points, table_text

XYZ = points()
LABELS = np.arange(COUNT)
LINES = [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in XYZ]
ROWS = "\n".join(LINES) + "\n"
COMMAS = ROWS.replace(" ", ",")


def frame(**more) -> pandas.DataFrame:
    """The points as a data frame, with more columns in front or behind, as given."""
    return pandas.DataFrame({"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], **more})


def saved(header: str, table: np.ndarray, delimiter: str = " ") -> bytes:
    """What `numpy.savetxt` writes."""
    stream = io.BytesIO()
    np.savetxt(stream, table, header=header, delimiter=delimiter)
    return stream.getvalue()


def numbered(line: Callable[[int, str], str]) -> bytes:
    return "".join(line(k, text) + "\n" for k, text in enumerate(LINES)).encode()


def text_kinds() -> dict[str, tuple[str, bytes]]:
    """Text that says by itself what its columns are."""
    with_id = np.c_[LABELS, XYZ]
    timed = np.c_[1.6e9 + 0.1 * LABELS, LABELS % 7, XYZ]
    comma = ROWS.replace(" ", ";").replace(".", ",")
    renamed = frame(label="tree")
    cells = {
        "count first": ("a.xyz", f"{COUNT}\n{ROWS}"),
        "pts": ("a.pts", f"{COUNT}\n" + "".join(f"{line} -7 1 2 3\n" for line in LINES)),
        "units in brackets": ("a.csv", f"x [m],y [m],z [m]\n{COMMAS}"),
        "units in parentheses": ("a.txt", f"X(m) Y(m) Z(m)\n{ROWS}"),
        "units apart from names": ("a.txt", f"x [m] y [m] z [m]\n{ROWS}"),
        "pos_x": ("a.csv", f"pos_x,pos_y,pos_z\n{COMMAS}"),
        "Points:0": ("a.csv", '"Points:0","Points:1","Points:2"\n' + COMMAS),
        "quoted numbers": ("a.csv", '"x","y","z"\n' + "".join(
            ",".join(f'"{cell}"' for cell in line.split()) + "\n" for line in LINES)),
        "sep line": ("a.csv", f"sep=;\nx;y;z\n{ROWS.replace(' ', ';')}"),
        "decimal commas": ("a.csv", f"x;y;z\n{comma}"),
        "decimal commas without names": ("a.csv", comma),
        "trailing comma": ("a.csv", COMMAS.replace("\n", ",\n")),
        "trailing comma and names": ("a.csv", "x,y,z,\n" + COMMAS.replace("\n", ",\n")),
        "commas and blanks": ("a.txt", ROWS.replace(" ", ", ")),
        "commas or blanks": ("a.txt", "".join(line.replace(" ", ",", 1) + "\n" for line in LINES)),
        "tabs": ("a.asc", "X\tY\tZ\n" + ROWS.replace(" ", "\t")),
        "byte order mark": ("a.csv", "\ufeffx,y,z\n" + COMMAS),
        "comment marks of C": ("a.asc", f"//X Y Z\n{ROWS}"),
        "blank lines": ("a.xyz", "\n\n" + ROWS.replace("\n", "\n\n")),
        "nan rows": ("a.xyz", f"nan nan nan\n{ROWS}inf 0 0\n"),
        "old Macintosh": ("a.txt", ROWS.replace("\n", "\r")),
        "Windows": ("a.txt", ROWS.replace("\n", "\r\n")),
        "labels as words": ("a.csv", renamed.to_csv(index=False)),
        "words with blanks": ("a.csv", frame(label="a tall, old tree").to_csv(index=False)),
        "pandas with its index": ("a.csv", frame(i=LABELS).to_csv()),
        "upper case": ("a.csv", frame().rename(columns=str.upper).to_csv(index=False)),
        "CloudCompare": ("a.asc", "//X Y Z Intensity\n" + "".join(f"{v} 3\n" for v in LINES)),
        "CloudCompare with its count": ("a.asc", f"//X Y Z\n{COUNT}\n{ROWS}"),
        "PTX": ("a.ptx", ptx()),
    }  # fmt: skip
    found = {key: (name, text.encode()) for key, (name, text) in cells.items()}
    found |= {
        "UTF-16": ("a.csv", ("x,y,z\n" + COMMAS).encode("utf-16")),
        "UTF-16 without mark": ("a.csv", ("x,y,z\n" + COMMAS).encode("utf-16-le")),
        "savetxt id": ("a.txt", saved("id,x,y,z", with_id, ",")),
        "savetxt time": ("a.txt", saved("time intensity x y z", timed)),
        "savetxt plain": ("a.txt", saved("", XYZ)),
        "savetxt columns said": ("a.txt", saved("columns: id x y z", with_id)),
        "xyzn": ("a.xyzn", table_text(np.c_[XYZ, normals()])),
        "xyzrgb": ("a.xyzrgb", table_text(np.c_[XYZ, np.eye(3)[LABELS % 3]])),
    }
    return found


def ptx() -> str:
    """Two scans, the second one turned by a quarter about z, with an empty cell each."""
    half = COUNT // 2
    text = ""
    for part, matrix in ((XYZ[:half], np.eye(4)), (XYZ[half:], _quarter())):
        local = np.c_[part, np.ones(half)] @ np.linalg.inv(matrix)  # of row vectors
        pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
        rows = "".join(f"{x:.17g} {y:.17g} {z:.17g} 0.5\n" for x, y, z, _ in local)
        text += f"{half + 1}\n1\n{pose}{table_text(matrix).decode()}{rows}0 0 0 0.5\n"
    return text


def _quarter() -> np.ndarray:
    return np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1.0]])

"""Writes the summary at the top of docs/results.md, and its figure, from the tables below it.

python docs/summary.py
"""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.figure import Figure

PAGE = Path(__file__).with_name("results.md")
PICTURE = Path(__file__).parent / "images" / "results.png"
BEGIN, END = "<!-- made by docs/summary.py -->\n", "<!-- end of the summary -->\n"

EXACT, ESTIMATED = "### Exact normals", "### Normals estimated"
# What the summary shows: its column, the section it is from, the column there.
COLUMNS = (
    ("CAD, RE median", EXACT, "RE median"),
    ("CAD, recall (5°, 0.1)", EXACT, "recall 5°, 0.1"),
    ("CAD, estimated normals", ESTIMATED, "recall 5°, 0.1"),
    ("Warzone 2100", "## Shapes of another game", "recall 5°, 0.1"),
    ("Kinect (5°, 0.1 m)", "## Kinect pairs", "recall 5°, 0.1 m"),
    ("LiDAR (5°, 2 m)", "## LiDAR scans", "recall 5°, 2 m"),
    ("CAD, ms per pair", EXACT, "ms / pair"),
)
LEFT_OUT = ("identity", "truth", "rpmnet")  # bounds, and what gives the same answers as another
OURS = "cfr"
INK, QUIET, LOUD = "#1b2029", "#5a6472", "#0073a8"


def main() -> None:
    text = PAGE.read_text("utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    found = summary(text)
    PAGE.write_text(before + BEGIN + in_markdown(found) + END + after, "utf-8")
    print(f"wrote {PAGE}")
    draw(found, PICTURE)
    print(f"wrote {PICTURE}")


def summary(text: str) -> dict[str, list[str]]:
    """Of each method, what `COLUMNS` name; "–" where the page has no such number."""
    sections = {
        part.partition("\n")[0]: part for part in re.split(r"^(?=##)", text, flags=re.MULTILINE)
    }
    columns = []
    for _, heading, column in COLUMNS:
        (part,) = (part for title, part in sections.items() if title.startswith(heading))
        columns.append(column_of(part, column))
    methods = [name for name in columns[0] if name not in LEFT_OUT]
    rows = {name: [column.get(name, "–") for column in columns] for name in methods}
    return dict(sorted(rows.items(), key=lambda row: -float(row[1][1])))


def column_of(part: str, column: str) -> dict[str, str]:
    """The values of a column in the first table of a section that has it, by method.

    Rows of methods without given normals are called NAME_estimated there, and NAME here.
    """
    for table in re.findall(r"^\| method \|.*\n\|.*\n(?:\|.*\n)+", part, flags=re.MULTILINE):
        head, _, *rows = ([cell.strip() for cell in line.strip("|\n ").split("|")]
                          for line in table.splitlines())  # fmt: skip
        if column in head:
            place = head.index(column)
            return {row[0].removesuffix("_estimated"): row[place] for row in rows}
    raise ValueError(f"no table with a column {column!r} in {part[:60]!r}")


def in_markdown(found: dict[str, list[str]]) -> str:
    head = " | ".join(title for title, _, _ in COLUMNS)
    lines = [f"| method | {head} |", "| --- |" + " ---: |" * len(COLUMNS)]
    lines += [f"| {name} | {' | '.join(values)} |" for name, values in found.items()]
    return "\n" + "\n".join(lines) + "\n\n"


def draw(found: dict[str, list[str]], path: Path) -> None:
    """Time against recall, with exact and with estimated normals."""
    figure = Figure(figsize=(8.4, 4.4), facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    for name, values in found.items():
        time, exact, estimated = float(values[6]), float(values[1]), values[2]
        color = LOUD if name.startswith(OURS) else QUIET
        axes.plot(time, exact, "o", color=color, ms=7)
        if estimated != "–":
            axes.plot([time, time], [exact, float(estimated)], color=color, lw=0.8, zorder=0)
            axes.plot(time, float(estimated), "o", mfc="white", mec=color, ms=7)
        crowded = any(  # by another method on the right
            1 < float(other[6]) / time < 1.25 and abs(float(other[1]) - exact) < 0.04
            for other in found.values()
        )
        side = {"ha": "right", "xytext": (-7, 3)} if crowded else {"ha": "left", "xytext": (7, 3)}
        style = {"textcoords": "offset points", "fontsize": 9, "color": INK}
        axes.annotate(name, (time, exact), **side, **style)
    axes.set_xscale("log")
    ticks = (30, 50, 100, 200, 400)
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set(xlim=(25, 700), ylim=(0, 1.04))
    axes.set_xlabel("ms per pair on two CPU cores", color=QUIET)
    axes.set_ylabel("pairs within 5° and 0.1", color=QUIET)
    axes.spines[["top", "right"]].set_visible(False)
    axes.text(0.99, 0.02, "filled: exact normals; open: estimated ones", fontsize=9, color=QUIET,
              transform=axes.transAxes, ha="right")  # fmt: skip
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()

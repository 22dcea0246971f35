"""Compares two builds of a corpus shape by shape, matched by name."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.data.making.shapes import mean_nearest, name_share

_MEASURED = 200  # shapes whose points are compared, chosen by a hash of their names


@dataclass(frozen=True)
class Comparison:
    """Counts are numbers of shapes. Distances are in units of the unit sphere's radius.

    "Ours" and "here" mean the first build, "theirs" and "there" the second.
    """

    ours: dict[str, int]  # split → shapes
    theirs: dict[str, int]
    common: dict[str, int]  # "our split / their split" → shapes
    crossed: list[str]  # in the test here but not there, or the other way around
    renamed: dict[str, list[str]]  # name → category here and category there, if they differ
    only_ours: dict[str, int]  # category → shapes
    only_theirs: dict[str, dict[str, str]]  # category → name → why it was left out here
    distance: dict[str, float]  # mean distance to the nearest point, quantiles over shapes
    normals: dict[str, float]  # mean |cosine| between normals of nearest points, quantiles

    def asdict(self) -> dict[str, Any]:
        return asdict(self)

    def __str__(self) -> str:
        kept = sum(self.common.values())
        lines = [f"shapes      {sum(self.ours.values())} here, {sum(self.theirs.values())} there"]
        lines += [f"in both     {kept}, of these {len(self.renamed)} in another category"]
        lines += [f"  {pair}: {shapes}" for pair, shapes in sorted(self.common.items())]
        lines += [f"crossed     {len(self.crossed)} between seen and unseen halves"]
        only = sum(self.only_ours.values())
        lines += [f"only here   {only}", f"only there  {sum(map(len, self.only_theirs.values()))}"]
        for what, quantiles in (("distance", self.distance), ("normals", self.normals)):
            shown = ", ".join(f"{key} {value:.4f}" for key, value in quantiles.items())
            lines += [f"{what:11s} {shown}"]
        return "\n".join(lines)


def compare(ours: Path, theirs: Path) -> Comparison:
    """Compares two folders of `train.h5`, `val.h5` and `test.h5`.

    Raises ValueError if a folder has none of them.
    """
    here, there = _read(ours), _read(theirs)
    rows = {name: (split, row) for split, corpus in here.items()
            for row, name in enumerate(corpus.names)}  # fmt: skip
    reasons = _reasons(ours / "left_out.tsv")
    common: Counter[str] = Counter()
    crossed, renamed, both = [], {}, []
    only_theirs: dict[str, dict[str, str]] = {}
    for split, corpus in there.items():
        for row, name in enumerate(corpus.names):
            category = corpus.categories[corpus.labels[row]]
            if name not in rows:
                why = reasons.get(name, "not in the sources, or of no category")
                only_theirs.setdefault(category, {})[name] = why
                continue
            our_split, our_row = rows.pop(name)
            common[f"{our_split} / {split}"] += 1
            if (our_split == "test") != (split == "test"):
                crossed.append(name)
            our_category = here[our_split].categories[here[our_split].labels[our_row]]
            if our_category != category:
                renamed[name] = [our_category, category]
            both.append((name_share(name, "measure"), (our_split, our_row), (split, row)))
    only_ours = Counter(
        here[split].categories[here[split].labels[row]] for split, row in rows.values()
    )
    distances, cosines = [], []
    for _, (our_split, our_row), (split, row) in sorted(both)[:_MEASURED]:
        points, normals = here[our_split][our_row]
        their_points, their_normals = there[split][row]
        distances.append(mean_nearest(points, their_points))
        nearest = cKDTree(their_points).query(points)[1]
        cosines.append(float(np.abs((normals * their_normals[nearest]).sum(axis=1)).mean()))
    return Comparison(
        ours={split: len(corpus) for split, corpus in here.items()},
        theirs={split: len(corpus) for split, corpus in there.items()},
        common=dict(common),
        crossed=sorted(crossed),
        renamed=renamed,
        only_ours=dict(sorted(only_ours.items())),
        only_theirs=dict(sorted(only_theirs.items())),
        distance=_quantiles(distances),
        normals=_quantiles(cosines),
    )


def _read(folder: Path) -> dict[str, Corpus]:
    paths = {split: folder / f"{split}.h5" for split in ("train", "val", "test")}
    found = {split: read_corpus(path) for split, path in paths.items() if path.is_file()}
    if not found:
        raise ValueError(f"no train.h5, val.h5 or test.h5 in {folder}")
    return found


def _reasons(path: Path) -> dict[str, str]:
    if not path.is_file():
        return {}
    return dict(line.split("\t", 1) for line in path.read_text().splitlines())


def _quantiles(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    marks = {"least": 0.0, "median": 0.5, "p95": 0.95, "most": 1.0}
    return {name: float(np.quantile(values, share)) for name, share in marks.items()}

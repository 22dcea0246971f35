"""ModelNet40 as the field distributes it, and the three splits registration papers make of it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from cfr_jax.data.corpus import Corpus, read_corpus

Split = Literal["train", "val", "test"]

SEEN = 20  # of the 40 categories; the others are met only in the test
WHERE = (
    "Get modelnet40_ply_hdf5_2048.zip (415 MB; "
    "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip, or the mirror "
    "https://rpmnet.s3.us-east-2.amazonaws.com/modelnet40_ply_hdf5_2048.zip) and unpack it. Its "
    "folder holds shape_names.txt, train_files.txt, test_files.txt, ply_data_train0.h5 to "
    "ply_data_train4.h5, ply_data_test0.h5 and ply_data_test1.h5."
)


def read_modelnet40(folder: str | Path, split: Split) -> Corpus:
    """One of the published splits of the folder `modelnet40_ply_hdf5_2048`.

    `train` holds the train files and `val` the test files of the first 20 categories by alphabet,
    `test` the test files of the other 20: shapes of a kind never trained on. Shapes keep the order
    of the lists, which is the order that `fixed_pair` counts in; labels go on numbering all 40.
    Raises ValueError where something is missing, and says where to get it.
    """
    if split not in get_args(Split):
        raise ValueError(f"split is {split!r}, wanted one of {get_args(Split)}")
    folder = Path(folder)
    corpus = read_corpus(_listed(folder, "train" if split == "train" else "test"))
    categories = sorted(corpus.categories)
    if len(categories) != 2 * SEEN:
        raise ValueError(
            f"{folder / 'shape_names.txt'} lists {len(categories)} categories, wanted 40. {WHERE}"
        )
    return corpus.of_categories(categories[SEEN:] if split == "test" else categories[:SEEN])


def _listed(folder: Path, half: str) -> list[Path]:
    """The files of a list, whose lines carry a folder of the machine where they were made."""
    for needed in (f"{half}_files.txt", "shape_names.txt"):
        if not (folder / needed).is_file():
            raise ValueError(f"{folder} has no {needed}. {WHERE}")
    listed = folder / f"{half}_files.txt"
    files = [folder / Path(line).name for line in listed.read_text().split()]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise ValueError(f"{folder} lacks {missing or 'all files'} of {listed.name}. {WHERE}")
    return files

"""ModelNet40 in its usual HDF5 form, and the three splits that registration papers use."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import text

Split = Literal["train", "val", "test"]

_LARGEST_LIST = 1 << 20  # bytes
SEEN = 20  # of the 40 categories are seen in training; the others appear only in the test
WHERE = (
    "Download modelnet40_ply_hdf5_2048.zip (415 MB; "
    "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip, or the mirror "
    "https://rpmnet.s3.us-east-2.amazonaws.com/modelnet40_ply_hdf5_2048.zip) and unpack it. Its "
    "folder holds shape_names.txt, train_files.txt, test_files.txt, ply_data_train0.h5 to "
    "ply_data_train4.h5, ply_data_test0.h5 and ply_data_test1.h5."
)


def read_modelnet40(folder: str | Path, split: Split) -> Corpus:
    """One of the published splits of the folder `modelnet40_ply_hdf5_2048`.

    For the first 20 categories in alphabetical order, `train` holds the shapes of the training
    files and `val` those of the test files. `test` holds the shapes of the test files in the other
    20 categories, which are never trained on. Shapes keep the order of the file lists, and
    `fixed_pair` counts in that order. Labels still refer to all 40 categories. Raises ValueError if
    something is missing, and says where to get it.
    """
    if split not in get_args(Split):
        raise ValueError(f"split: got {split!r}, wanted one of {get_args(Split)}")
    folder = Path(folder)
    corpus = read_corpus(_listed(folder, "train" if split == "train" else "test"))
    categories = sorted(corpus.categories)
    if len(categories) != 2 * SEEN:
        raise ValueError(
            f"{folder / 'shape_names.txt'} lists {len(categories)} categories, wanted 40. {WHERE}"
        )
    return corpus.of_categories(categories[SEEN:] if split == "test" else categories[:SEEN])


def _listed(folder: Path, half: str) -> list[Path]:
    """The files in a list. Its lines start with a folder of the machine that the list comes from,
    so only their names are used."""
    for needed in (f"{half}_files.txt", "shape_names.txt"):
        if not (folder / needed).is_file():
            raise ValueError(f"{folder} has no {needed}. {WHERE}")
    listed = folder / f"{half}_files.txt"
    try:
        lines = text(listed, _LARGEST_LIST).split()
    except Refused as error:
        raise Refused(f"{shown(listed)} {error}. {WHERE}") from error
    files = [folder / Path(line).name for line in lines]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise ValueError(f"{folder} lacks {missing or 'all files'} of {listed.name}. {WHERE}")
    return files

"""A pair of clouds to register, and the files that hold many pairs.

`CsvPairs` and `Hdf5Pairs` read a `Pair` only when it is accessed.
"""

from cfr_jax.data.pairs.csv_pairs import CsvPairs
from cfr_jax.data.pairs.hdf5_pairs import Hdf5Pairs
from cfr_jax.data.pairs.pair import Pair, PairFile, among, with_truth

__all__ = ["CsvPairs", "Hdf5Pairs", "Pair", "PairFile", "among", "with_truth"]

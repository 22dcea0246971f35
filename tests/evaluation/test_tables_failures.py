"""A row that answers nothing says why."""

import numpy as np

from cfr_jax.evaluation.drawing import tables
from cfr_jax.evaluation.measuring import Measured


def row(failures, answered=0):
    errors = np.full((3, 1), np.nan)
    errors[:answered] = 1.0
    return Measured(
        name="rgm",
        errors={"err_r": errors, "err_t": errors},
        seconds=np.full(3, np.nan),
        failures=failures,
        about={},
        started=None,
    )


def test_a_method_that_fails_on_all_pairs_for_one_reason_says_so_in_its_row():
    large = dict.fromkeys(range(3), "ValueError: RGM stores scores of all pairs of points")

    assert tables._failed(row(large)) == "3: ValueError: RGM stores scores of all pairs of points"
    assert tables._failed(row(large | {2: "too late"})) == "3"
    assert tables._failed(row({2: "too late"}, answered=2)) == "1"
    assert tables._failed(row({}, answered=3)) == "0"

"""`align` refined by the library small_gicp, where it is installed."""

import sys

import numpy as np
import pytest
import solids

from cfr_jax.alignment.align import align

TRUTH = solids.motion(25)


@pytest.fixture(scope="module")
def pair():
    return solids.two_samplings(256, TRUTH)


def test_it_refines_no_worse_than_the_network_was_and_says_how(pair):
    pytest.importorskip("small_gicp")
    plain = align(*pair, refine=False)

    found = align(*pair, refine="small_gicp")

    assert np.array_equal(found.transforms, plain.transforms)
    assert found.refined and found.steps > 0 and found.fitness >= plain.fitness - 0.02
    assert solids.degrees_between(found.transform, TRUTH) < 2


def test_without_the_library_it_says_what_to_install(pair, monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)

    with pytest.raises(ModuleNotFoundError, match="small_gicp is needed .*pip install"):
        align(*pair, refine="small_gicp")


@pytest.mark.parametrize("refine", ["icp", None, 2])
def test_another_refinement_is_refused_by_name(pair, unchecked, refine):
    with pytest.raises(ValueError, match="^refine: got "):
        align(*pair, refine=refine)

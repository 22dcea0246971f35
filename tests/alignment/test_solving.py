"""One `align` sends data to the device once, runs one program there, and fetches once."""

import dataclasses

import jax
import numpy as np
import pytest
import solids

from cfr_jax.alignment import solving
from cfr_jax.alignment.align import align, checked_params
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import planned
from cfr_jax.refine import find
from cfr_jax.runtime import programs

TRUTH = solids.motion(25)


@pytest.fixture(scope="module")
def pair():
    return solids.two_samplings(450, TRUTH)


def test_neighbors_found_on_the_device_give_the_answer_of_those_found_here(pair):
    plans = [planned(*pair, search=search) for search in (True, False)]

    here, there = (
        solving.solve_case(Case(checked_params(None), plan), refine=find(True)).solved()
        for plan in plans
    )

    assert plans[1].source.neighbors is None and plans[1].target.neighbors is None
    assert plans[0].source.neighbor_count == plans[1].source.neighbor_count == 64
    np.testing.assert_allclose(there.transform, here.transform, atol=1e-5)
    for name, value in vars(here.clues.network).items():
        np.testing.assert_allclose(getattr(there.clues.network, name), value, atol=1e-4)


def test_an_accelerator_is_left_the_search_for_neighbors(pair, monkeypatch):
    wanted = align(*pair, second_look=False)
    seen = []
    solve = solving.solve_case

    def watched(case, **options):
        seen.append(case.plan)
        return solve(case, **options)

    monkeypatch.setattr("cfr_jax.alignment.align.solve_case", watched)
    monkeypatch.setattr("cfr_jax.alignment.align.on_accelerator", lambda: True)

    found = align(*pair, second_look=False)

    assert seen[0].source.neighbors is None
    assert found.neighbors == wanted.neighbors
    np.testing.assert_allclose(found.transform, wanted.transform, atol=1e-5)


def test_one_upload_one_program_and_one_fetch_answer_a_pair(pair, monkeypatch):
    align(*pair, second_look=False)  # compiles the program
    calls = []

    def counted(module, name, of=object):
        function = getattr(module, name)

        def watched(*arguments, **options):
            if arguments and isinstance(arguments[0], of):
                calls.append(name)
            return function(*arguments, **options)

        monkeypatch.setattr(module, name, watched)

    counted(jax, "device_put")
    counted(jax, "device_get")
    counted(programs, "compiled")
    for name in ("asarray", "array"):  # JAX's guard refuses these fetches only on an accelerator
        counted(np, name, jax.Array)

    with jax.transfer_guard("disallow"):  # forbids implicit transfers
        found = align(*pair, second_look=False)

    assert calls == ["device_put", "compiled", "device_get"]
    assert solids.degrees_between(found.transform, TRUTH) < 2


def test_what_was_found_lies_in_host_memory(pair):
    case = Case(checked_params(None), planned(*pair))

    found = solving.solve_case(case, refine=find(True)).solved()

    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(found))
    assert dataclasses.is_dataclass(found) and case.seconds["run"] > 0

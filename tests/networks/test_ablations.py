"""The paper's savings undone one by one, each against the reference that undoes it, too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import authors, cfr, clouds

from cfr_jax.networks.cfr.iterations import iterations_of
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.cfr.registration import Settings, register
from cfr_jax.weights.conversion import from_state_dict

K = 8
ITERATIONS = 2


@pytest.fixture(scope="module")
def pair():
    return clouds.random_pair(0, 40, 44)


@pytest.fixture(scope="module")
def state():
    return authors.random_state_dict(2, iterations=ITERATIONS)


def both(pair):
    sides = ((pair.x, pair.nx), (pair.y, pair.ny))
    return tuple(jnp.asarray(np.concatenate(side, axis=1)) for side in sides)


def answer(params, pair, **changes):
    return register(params, *both(pair), settings=Settings(neighbors=K, **changes)).transforms


def reference(state, pair, **changes):
    wanted = cfr.trace(state, *pair[:4], iterations=ITERATIONS, neighbors=K, **changes)
    return wanted.transforms


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ({"passes": 5}, {"passes": 5}),
        ({"repeat_annealing": True}, {"anneal_again": True}),
        ({"repeat_extraction": True}, {"extract_again": True}),
    ],
)
def test_each_saving_undone_is_the_reference_without_it(state, pair, ours, theirs):
    found = answer(from_state_dict(state), pair, **ours)

    np.testing.assert_allclose(found, reference(state, pair, **theirs), atol=1e-5)
    assert np.abs(found - reference(state, pair)).max() > 1e-4  # and it is another answer


def test_sinkhorn_in_log_space_gives_the_same_answer(state, pair):
    found = answer(from_state_dict(state), pair, match="log space")

    np.testing.assert_allclose(found, reference(state, pair), atol=1e-5)


def test_one_light_layer_for_all_iterations_answers_as_equal_ones_of_their_own(state, pair):
    params = from_state_dict(state)
    first = {name: leaf[:1] for name, leaf in params["cascade"].items()}
    alike = {name: jnp.repeat(leaf, ITERATIONS, axis=0) for name, leaf in first.items()}

    shared = answer(params | {"cascade": first}, pair)

    np.testing.assert_allclose(shared, answer(params | {"cascade": alike}, pair), atol=1e-5)


def test_a_shared_layer_is_a_fifth_of_the_light_parameters():
    own, shared = (
        jax.eval_shape(lambda one=one: init_params(jax.random.key(0), 5, one))
        for one in (False, True)
    )

    assert iterations_of(shared) == iterations_of(own) == 5
    for name in own["cascade"]:
        assert shared["cascade"][name].shape == (1, *own["cascade"][name].shape[1:])

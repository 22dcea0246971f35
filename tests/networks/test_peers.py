"""DCP, FMR and RGM against float64 references, with random weights under the authors' names."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import clouds, peer_authors
from oracle import dcp as dcp_oracle
from oracle import fmr as fmr_oracle
from oracle import rgm as rgm_oracle

from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks import table
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.peers import fmr, rgm
from cfr_jax.weights.conversion import from_state_dict

N, M, WIDTH = 60, 55, 32
STATES = {
    "dcp v1": lambda: peer_authors.random_dcp_state_dict(0, version=1, width=WIDTH),
    "dcp v2": lambda: peer_authors.random_dcp_state_dict(0, version=2, width=WIDTH),
    "fmr": lambda: peer_authors.random_fmr_state_dict(0),
    "rgm": lambda: peer_authors.random_rgm_state_dict(0, width=WIDTH),
}
# How far two programs in float32 may be apart. The Jacobian of FMR is of finite differences, which
# make a hundred times as much of every rounding.
LOOSE = {"dcp": 2e-5, "fmr": 1e-4}
REFERENCES = {
    "dcp": lambda state, x, y: dcp_oracle.register(state, x, y)[None],
    "fmr": fmr_oracle.register,
    "rgm": lambda state, x, y: rgm_oracle.register(state, x, y)[None],
}


# The hard assignments of random weights may turn on a rounding: RGM is compared in float64, and by
# its soft assignments.
@pytest.fixture(params=["dcp v1", "dcp v2", "fmr"])
def named(request):
    """Name of the network, the state dict, the parameters."""
    state = STATES[request.param]()
    return request.param.split()[0], state, from_state_dict(state)


def cloud(points, mask=None, k=19):
    points = jnp.asarray(points)
    k = min(k, len(points) - 1)
    found = jnp.asarray(nearest_on_host(np.asarray(points), k))
    return Cloud(points, jnp.zeros_like(points), found, mask)


@functools.partial(jax.jit, static_argnums=0)
def answer(name, params, source, target):
    record = table.named(name)
    return jnp.stack(
        [step.transform for step in record.unroll(params, source, target, record.validated)]
    )


def test_it_answers_as_the_reference(named):
    name, state, params = named
    pair = clouds.random_pair(3, N, M)

    found = answer(name, params, cloud(pair.x), cloud(pair.y))

    wanted = REFERENCES[name](state, pair.x, pair.y)
    np.testing.assert_allclose(found, wanted, atol=LOOSE[name] / 2)


@pytest.mark.parametrize("name", ["fmr", "rgm"])
def test_it_answers_as_the_reference_to_all_digits_in_float64(x64, name):
    state = STATES[name]()
    pair = clouds.random_pair(3, N, M)
    sides = [cloud(points.astype(np.float64)) for points in (pair.x, pair.y)]

    found = answer(name, in_float64(state), *sides)

    np.testing.assert_allclose(found, REFERENCES[name](state, pair.x, pair.y), atol=1e-9)


def test_the_decoder_of_fmr_is_that_of_the_reference(x64):
    state = STATES["fmr"]()
    points = clouds.random_pair(3, N, M).x.astype(np.float64)

    remade = fmr.FMR().apply({"params": in_float64(state)}, jnp.asarray(points))

    wanted = fmr_oracle.decode(state, fmr_oracle.encode(state, points))
    np.testing.assert_allclose(remade, wanted, atol=1e-9)


def in_float64(state):
    with jax.enable_x64(False):
        params = from_state_dict(state)
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float64), params)


def test_neither_padding_nor_a_batch_changes_the_answers(named):
    # given two pairs, each cloud followed by rows that do not count
    name, _, params = named
    pairs = [clouds.random_pair(seed, N, M) for seed in (3, 4)]
    sides = [(cloud(pair.x), cloud(pair.y)) for pair in pairs]
    padded = [
        tuple(with_padding(side, more) for side, more in zip(pair, (7, 9), strict=True))
        for pair in sides
    ]

    # when
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)
    together = jax.vmap(lambda pair: answer(name, params, *pair))(batch)

    # then
    for found, side in zip(together, sides, strict=True):
        np.testing.assert_allclose(found, answer(name, params, *side), atol=LOOSE[name])


def with_padding(plain, more):
    n = len(plain.points)
    wrong = jnp.full((more, 3), 0.4)
    return Cloud(
        jnp.concatenate([plain.points, wrong]),
        jnp.zeros((n + more, 3)),
        jnp.pad(plain.neighbors, ((0, more), (0, 0))),
        jnp.arange(n + more) < n,
    )


@pytest.mark.parametrize("slack", [True, False])
def test_soft_assignments_of_rgm_are_those_of_the_reference(slack):
    state = STATES["rgm"]()
    pair = clouds.random_pair(5, M, M)
    wanted = rgm_oracle.soft_assignment(state, pair.x, pair.y, slack=slack)

    params = from_state_dict(state)
    network = rgm.module_of(params, rgm.RGMSettings(slack=slack)).bind({"params": params})
    source, target = cloud(pair.x), cloud(pair.y)
    found = network(source, target)
    padded = network(with_padding(source, 7), with_padding(target, 9))

    np.testing.assert_allclose(np.exp(found), wanted, atol=1e-5)
    np.testing.assert_allclose(np.exp(padded)[:M, :M], wanted, atol=1e-5)
    assert not np.exp(padded)[M:].any() and not np.exp(padded)[:, M:].any()
    assert wanted.max() > 0.05  # not spread evenly: an entry would have 1 / 55


def test_fmr_registers_without_its_decoder():
    params = from_state_dict(STATES["fmr"]())
    pair = clouds.random_pair(3, N, M)
    sides = cloud(pair.x), cloud(pair.y)
    without = {name: leaf for name, leaf in params.items() if name != "decoder"}

    np.testing.assert_array_equal(answer("fmr", without, *sides), answer("fmr", params, *sides))


def test_clouds_too_large_to_be_stored_in_pairs_are_refused_in_words():
    params = jax.eval_shape(lambda: table.named("dcp").fresh(jax.random.key(0), width=WIDTH))
    large = Cloud(
        *(jax.ShapeDtypeStruct((9000, c), t) for c, t in ((3, "f4"), (3, "f4"), (19, "i4")))
    )

    with pytest.raises(ValueError, match="DCP stores scores of all pairs.*at most 8192"):
        jax.eval_shape(lambda *given: answer("dcp", *given), params, large, large)


def test_fresh_parameters_have_the_sizes_of_the_published_networks():
    sizes = {}
    for title, name, given in (
        ("DCP v1", "dcp", {"version": "v1"}),
        ("DCP v2", "dcp", {}),
        ("FMR", "fmr", {}),
        ("RGM", "rgm", {}),
    ):
        made = jax.eval_shape(
            functools.partial(table.named(name).fresh, **given), jax.random.key(0)
        )
        learned = [
            leaf.size
            for path, leaf in jax.tree.leaves_with_path(made)
            if not path[-1].key.startswith("running")
        ]
        sizes[title] = sum(learned)

    # those of v1 and v2 with a constant matrix of nine numbers more
    assert sizes == {
        "DCP v1": 309_641 - 9, "DCP v2": 5_568_905 - 9, "FMR": 3_440_006, "RGM": 25_000_836,
    }  # fmt: skip

"""The same functions lower for GPUs and TPUs, here, without either: no program that only a CPU has,
and full precision wherever geometry is computed."""

import functools
import re

import jax
import jax.numpy as jnp
import pytest

from cfr_jax.alignment.solving import DeviceCloud, solve_pair
from cfr_jax.geometry import rigid
from cfr_jax.geometry.eigen import least_direction
from cfr_jax.networks import rpmnet, table
from cfr_jax.networks.cfr.modules import CHANNELS, init_params
from cfr_jax.networks.cfr.registration import Settings, encode, register
from cfr_jax.networks.inputs import Cloud, prepare
from cfr_jax.networks.peers import dcp, fmr, rgm
from cfr_jax.networks.peers.batch_norm import PAIRS
from cfr_jax.networks.sinkhorn import Form
from cfr_jax.refine import find

N, M, K, L = 40, 48, 8, 2
PLATFORMS = ("cuda", "rocm", "tpu")
# widths of learned layers, whose products may be rounded as the platform likes
LEARNED = {CHANNELS, 64, 128, 256, 512, 1024}


def shape(*sizes, dtype=jnp.float32):
    return jax.ShapeDtypeStruct(sizes, dtype)


@pytest.fixture(scope="module")
def params():
    return jax.eval_shape(lambda: init_params(jax.random.key(0), L))


def registering(params, form: Form):
    settings = Settings(neighbors=K, match=form)
    return jax.jit(lambda p, x, y: register(p, x, y, settings=settings)), (
        params, shape(N, 3), shape(M, 3),
    )  # fmt: skip


def training(params, form: Form):
    settings = Settings(neighbors=K, match=form)

    def loss(params, x, y):
        return jnp.sum(register(params, x, y, settings=settings).transform)

    return jax.jit(jax.grad(loss, (0, 1, 2))), (params, shape(N, 6), shape(M, 6))


def encoding(params, y):
    encoded = encode(params, y, settings=Settings(neighbors=K))
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(encoded) if leaf.dtype == jnp.float32)


def preparing(points):
    return jnp.sum(prepare(points, settings=Settings(neighbors=K)).normals)


def rpm_net(params, source, target):
    return sum(jnp.sum(step.transform) for step in rpmnet.unroll(
        params, source, target, rpmnet.RPMNetSettings(neighbors=K, iterations=L)
    ))  # fmt: skip


def of_rpm_net():
    params = jax.eval_shape(lambda: rpmnet.init_params(jax.random.key(0)))
    return params, *(Cloud(shape(n, 3), shape(n, 3), shape(n, K, dtype=jnp.int32)) for n in (N, M))


PEERS = {
    "dcp": dcp.DCPSettings(neighbors=K, training=True),
    "fmr": fmr.FMRSettings(iterations=L, supervised=True),
    "rgm": rgm.RGMSettings(neighbors=K, passes=L, training=True),
}


def training_peer(name):
    """The gradient of the loss of two pairs."""
    network = table.named(name)
    params = jax.eval_shape(lambda: network.fresh(jax.random.key(0)))
    sides = [Cloud(shape(2, n, 3), shape(2, n, 3), shape(2, n, K, dtype=jnp.int32)) for n in (N, M)]

    def loss(*given):
        goal = functools.partial(network.objective, settings=PEERS[name])
        return jnp.mean(jax.vmap(goal, (None, 0, 0, 0), axis_name=PAIRS)(*given).loss)

    return jax.jit(jax.grad(loss)), (params, *sides, shape(2, 4, 4))


def aligning(params):
    def cloud(n):
        return DeviceCloud(shape(n, 3), shape(n, K, dtype=jnp.int32), shape(n, dtype=bool))

    return jax.jit(lambda *a: solve_pair(*a, refine=find(True))), (params, cloud(N), cloud(M))


PROGRAMS = {
    "register, dense": lambda params: registering(params, "dense"),
    "register, streamed": lambda params: registering(params, "streamed"),
    "encode": lambda params: (jax.jit(encode), (params, shape(M, 6))),
    "gradient, dense": lambda params: training(params, "dense"),
    "gradient, streamed": lambda params: training(params, "streamed"),
    "gradient of encode": lambda params: (
        jax.jit(jax.grad(encoding, (0, 1))),
        (params, shape(M, 6)),
    ),
    "prepare": lambda params: (jax.jit(preparing), (shape(N, 3),)),
    "gradient of prepare": lambda params: (jax.jit(jax.grad(preparing)), (shape(N, 3),)),
    "RPM-Net": lambda params: (jax.jit(rpm_net), of_rpm_net()),
    "gradient of RPM-Net": lambda params: (jax.jit(jax.grad(rpm_net)), of_rpm_net()),
    "gradient of DCP": lambda params: training_peer("dcp"),
    "gradient of FMR": lambda params: training_peer("fmr"),
    "gradient of RGM": lambda params: training_peer("rgm"),
    "align": aligning,
}


@pytest.fixture(scope="module")
def lowered(params):
    """The text of a program for a platform; each program is traced once for all platforms."""

    @functools.cache
    def traced(name):
        program, arguments = PROGRAMS[name](params)
        return program.trace(*arguments)

    return lambda name, platform: traced(name).lower(lowering_platforms=(platform,)).as_text()


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("name", PROGRAMS)
def test_nothing_that_only_a_cpu_has_is_called(lowered, name, platform):
    text = lowered(name, platform)

    called = set(re.findall(r"custom_call @([\w.$]+)", text))
    assert not {name for name in called if re.search("lapack|callback|cpu|ynn|onednn", name)}
    # what is left are the libraries of the platform: eigenvalues and solutions of 6 x 6 systems
    known = {
        "cuda": "cusolver|cublas|cu_lu|Eigh|getrf",
        "rocm": "hipsolver|hipblas|hip_lu|Eigh|getrf",
        "tpu": "Eigh|LuDecomposition|Qr|tpu",
    }
    marks = "Sharding|annotate|optimization|mhlo|shape_assertion"
    assert not {n for n in called if not re.search(f"{known[platform]}|{marks}", n)}


@pytest.mark.parametrize(
    "name",
    ["gradient, dense", "gradient, streamed", "gradient of encode", "gradient of FMR", "align"],
)
def test_no_array_becomes_float64_where_a_caller_enables_it(params, name):
    """Recent GPUs compute it slowly, and TPUs emulate it."""
    program, arguments = PROGRAMS[name](params)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        text = program.trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()

    # a number of Python is a scalar of float64 until it meets an array
    assert not re.findall(r".*tensor<\d[\dx]*xf64>.*", text)


@pytest.mark.parametrize(
    "name", ["register, dense", "register, streamed", "gradient, dense", "gradient, streamed"]
)
def test_distances_and_matches_are_computed_at_full_precision(lowered, name):
    """On recent GPUs and on TPUs a product of float32 is rounded to ten bits or fewer, unless said
    otherwise."""
    text = lowered(name, "cuda")

    found = 0
    for line in text.splitlines():
        if "stablehlo.dot_general" not in line:
            continue
        operands, result = re.search(r": \((.*)\) -> tensor<([^>]*)>", line).groups()
        sizes = [tuple(map(int, re.findall(r"\d+(?=x)", part)))
                 for part in (*re.findall(r"tensor<([^>]*)>", operands), result)]  # fmt: skip
        # features that are multiplied in halves are three times as long
        full = line.count("HIGHEST") == 2 or sizes[0][-1] == 3 * CHANNELS
        # the block of affinities, made or read; and what gives the motion: 3 x 3
        geometric = any(N in s and M in s for s in sizes) or sizes[-1] == (3, 3)
        if geometric:
            found += 1
            assert full, line
        else:
            assert LEARNED & set(sum(sizes, ())) or full, line
    assert found > L  # what all iterations call stands in the text once


@pytest.mark.parametrize(
    ("function", "sizes"),
    [(rigid.nearest_rotation, [(3, 3)]), (jax.vmap(least_direction), [(N, 3, 3)])],
    ids=["rotation", "normals"],
)
def test_small_eigenproblems_are_loops_on_a_cpu_and_straight_lines_elsewhere(function, sizes):
    """A GPU would copy every number that a loop carries by a kernel of its own."""
    traced = jax.jit(function).trace(*(shape(*size) for size in sizes))

    loops = {
        platform: traced.lower(lowering_platforms=(platform,)).as_text().count("stablehlo.while")
        for platform in ("cpu", *PLATFORMS)
    }

    assert loops == {"cpu": 1, "cuda": 0, "rocm": 0, "tpu": 0}

"""What the compiled program does: as many passes as it should, nothing twice, no call back."""

import jax
import jax.numpy as jnp
import pytest
from jax.extend import core

from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.cfr.registration import Settings, register

N, M, L = 37, 41, 3


@pytest.fixture(scope="module")
def program():
    params = jax.eval_shape(lambda: init_params(jax.random.key(0), L))
    source, target = (jax.ShapeDtypeStruct((n, 6), jnp.float32) for n in (N, M))
    traced = jax.jit(register, static_argnames=("settings",))
    return traced.trace(params, source, target, settings=Settings(neighbors=8))


def equations(jaxpr):
    """All equations in the order of execution, those of inner programs where they are called."""
    for equation in jaxpr.eqns:
        inner = [
            value.jaxpr if isinstance(value, core.ClosedJaxpr) else value
            for value in equation.params.values()
            if isinstance(value, (core.ClosedJaxpr, core.Jaxpr))
        ]
        if not inner:
            yield equation
        for jaxpr in inner:
            yield from equations(jaxpr)


def of_match(program):
    """What happens to the affinities, in order: they are made, exponentiated, multiplied."""
    for equation in equations(program.jaxpr.jaxpr):
        given = [getattr(variable.aval, "shape", ()) for variable in equation.invars]
        made = equation.outvars[0].aval.shape
        if equation.primitive.name == "cond" and made == (N, M):
            yield "affinity"  # a branch for each platform
        elif equation.primitive.name == "dot_general" and (N, M) in given:
            yield "sweep"
        elif equation.primitive.name == "exp" and made == (N, M):
            yield "exp"


def test_iteration_i_runs_i_sinkhorn_passes(program):
    wanted = []
    for passes in range(1, L + 1):
        # a pass reads the block twice; then it is read for the weighted targets
        wanted += ["affinity", "exp"] + ["sweep"] * (2 * passes + 1)

    assert list(of_match(program)) == wanted


def test_nothing_as_large_as_the_match_is_repeated(program):
    compiled = program.lower().compile().as_text()

    lines = [line for line in compiled.splitlines() if f"= f32[{N},{M}]" in line]
    assert sum(" exponential(" in line for line in lines) == L
    assert sum(" dot(" in line or "__onednn$matmul" in line for line in lines) <= L


def test_nothing_calls_back_to_the_host(program):
    assert not any("callback" in e.primitive.name for e in equations(program.jaxpr.jaxpr))
    assert "callback" not in program.lower().as_text()

"""What researchers switch on: each works, or is refused in words that say why and the way out."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfr_jax as cfr

ROOT = Path(__file__).parents[2]
SMALL = cfr.Settings(neighbors=8)
TURN = np.array([[0.955, -0.296, 0, 0.1], [0.296, 0.955, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]])


def bowl(count=24):
    """A pair: points of half an ellipsoid, and the same points moved, with their normals."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] = np.abs(points[:, 2])
    normals = points / [1, 0.7, 0.4]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = points * [1, 0.7, 0.4]
    turn = np.linalg.qr(TURN[:3, :3])[0]
    turn *= np.sign(np.diag(turn @ TURN[:3, :3].T))
    source = np.hstack([points, normals])
    target = np.hstack([points @ turn.T + TURN[:3, 3], normals @ turn.T])
    return jnp.asarray(source, jnp.float32), jnp.asarray(target, jnp.float32)


SOURCE, TARGET = bowl()


def found(source=SOURCE, target=TARGET, **options):
    options = {"iterations": 1, "settings": SMALL} | options
    return cfr.register(cfr.load_params(), source, target, **options).transform


@pytest.fixture(scope="module")
def plain():
    return found()


@pytest.mark.parametrize(
    "switch",
    [
        jax.numpy_rank_promotion("raise"),
        jax.debug_nans(True),
        jax.debug_infs(True),
        jax.check_tracer_leaks(True),
        jax.enable_x64(True),
    ],
    ids=["rank promotion", "nans", "infs", "leaks", "x64"],
)
def test_register_works_and_its_gradient_is_traced_with_a_switch(switch, plain):
    with switch:
        np.testing.assert_allclose(found(), plain, atol=1e-5)  # float32, of entries up to one
        gradient = jax.grad(lambda points: jnp.sum(found(points)[0]))
        assert jax.eval_shape(gradient, SOURCE).shape == SOURCE.shape


def test_a_gradient_is_finite_under_debug_nans():
    with jax.debug_nans(True):
        gradient = jax.grad(lambda points: jnp.sum(found(points)[0]))(SOURCE)
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0


def test_ranks_are_promoted_in_our_programs_and_stay_forbidden_in_others():
    with jax.numpy_rank_promotion("raise"):
        answer = cfr.align(SOURCE[:, :3], TARGET[:, :3], second_look=False)
        with pytest.raises(ValueError, match="rank_promotion"):
            jnp.ones((2, 3)) + jnp.ones(3)
    assert answer == cfr.align(SOURCE[:, :3], TARGET[:, :3], second_look=False)


def test_nothing_is_compiled_where_jit_is_disabled(plain):
    with jax.disable_jit():
        np.testing.assert_allclose(found(), plain, atol=1e-5)


@pytest.mark.parametrize("dtype", [jnp.bfloat16, np.float16, np.float32, np.int32])
def test_clouds_of_every_type_of_number_are_taken(dtype):
    exact = [np.asarray(100 * cloud[:, :3]).astype(np.int32) for cloud in (SOURCE, TARGET)]
    source, target = (jnp.asarray(cloud, dtype) for cloud in exact)

    answer = cfr.align(source, target, second_look=False)

    wanted = cfr.align(*(cloud.astype(np.float64) for cloud in exact), second_look=False)
    assert np.array_equal(answer.transform, wanted.transform)
    assert answer.transform.dtype == np.float64


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_register_computes_in_float32_whatever_comes(dtype):
    source, target = (cloud[:, :3].astype(dtype) for cloud in (SOURCE, TARGET))
    answer = found(source, target)
    assert answer.dtype == jnp.float32
    assert np.array_equal(answer, found(source.astype(jnp.float32), target.astype(jnp.float32)))


@pytest.mark.parametrize(("form", "columns"), [("dense", 3), ("streamed", 6)])
def test_forward_mode_is_reverse_mode(form, columns):
    def transform(twist):
        moved = SOURCE[:, :columns]
        moved = moved.at[:, :3].multiply(1 + twist[None, :3])
        settings = cfr.Settings(neighbors=8, radius=2.0, match=form)
        return found(moved, TARGET[:, :columns], settings=settings)

    at = jnp.array([0.1, 0.2, 0.3])
    forward, reverse = jax.jacfwd(transform)(at), jax.jacrev(transform)(at)
    np.testing.assert_allclose(forward, reverse, atol=1e-4)
    assert np.abs(forward).max() > 0.1


def test_the_hessian_is_the_derivative_of_the_gradient():
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), cfr.load_params())
        source, target = (jnp.asarray(cloud[:, :3], jnp.float64) for cloud in (SOURCE, TARGET))
        settings = cfr.Settings(neighbors=8, radius=2.0)

        @jax.jit
        def gradient(stretch):
            def loss(stretch):
                moved = source * (1 + stretch[None])
                answer = cfr.register(params, moved, target, iterations=1, settings=settings)
                return answer.transform[0, 1]

            return jax.grad(loss)(stretch), jax.hessian(loss)(stretch)

        at, step = jnp.array([0.1, 0.2, 0.3]), 1e-5
        hessian = gradient(at)[1]
        differences = [
            (gradient(at + step * e)[0] - gradient(at - step * e)[0]) / (2 * step)
            for e in jnp.eye(3)
        ]
    np.testing.assert_allclose(hessian, np.stack(differences), atol=1e-5)
    assert np.abs(hessian).max() > 0.1


def test_answers_are_compared_by_value():
    params = cfr.load_params()
    first, second = (
        cfr.register(params, SOURCE, TARGET, iterations=1, settings=SMALL) for _ in range(2)
    )
    other = cfr.register(params, SOURCE, SOURCE, iterations=1, settings=SMALL)
    assert (first == second) is True and (first == other) is False and (first == 3) is False
    assert hash(first) == hash(second) and second in [first, other]
    target = cfr.encode(params, TARGET, settings=SMALL)
    assert target == cfr.encode(params, TARGET, settings=SMALL)


def child(code):
    given = f"import os, sys, numpy as np\nimport cfr_jax as cfr\n{textwrap.dedent(code)}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", given],
        capture_output=True,
        text=True,
        timeout=240,
        env=environment,
        cwd=ROOT,
    )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
@pytest.mark.parametrize(
    "call",
    [
        "cfr.align(x, x)",
        "cfr.register(params, x, x)",
        "cfr.encode(params, x)",
        "cfr.prepare(x)",
        "next(cfr.align_many([(x, x)]))",
        "cfr.merge([x, x])",
        "cfr.load_params()",
    ],
)
def test_a_forked_worker_is_refused_in_words(call):
    ended = child(
        f"""
        import multiprocessing
        x = np.random.default_rng(0).normal(size=(30, 3))
        params = cfr.load_params()
        def work(sent):
            try:
                {call}
            except RuntimeError as error:
                sent.send(str(error))
        fork = multiprocessing.get_context("fork")
        received, sent = fork.Pipe(False)
        worker = fork.Process(target=work, args=(sent,))
        worker.start()
        print(received.recv() if received.poll(60) else "hangs")
        worker.kill()
        """
    )
    assert 'get_context("spawn")' in ended.stdout and "forked" in ended.stdout, ended.stderr


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_workers_forked_before_the_first_call_work():
    ended = child(
        """
        cfr.align  # imported, not called
        child = os.fork()
        params = cfr.load_params()
        assert len(cfr.prepare(np.eye(3, dtype=np.float32)).points) == 3
        if child:
            assert os.waitpid(child, 0)[1] == 0
            print("both")
        """
    )
    assert ended.stdout == "both\n", ended.stderr

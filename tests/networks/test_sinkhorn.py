"""Every form of the match against the reference, over all the annealing a network may ask for."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces

from cfr_jax.networks.sinkhorn import FORMS, Affinity, form_for, match
from cfr_jax.networks.sinkhorn.affinity import by_halves
from cfr_jax.networks.sinkhorn.by_hand import Way, match_by_hand

N, M = 13, 15
# three blocks of five rows, the last of them padded; and what accelerators do
WAYS = {"streamed": Way("streamed", 5), "stored": Way("stored", 0)}
FORMS |= {
    name: functools.partial(match_by_hand, on_cpu=way, elsewhere=way) for name, way in WAYS.items()
}
# beta, alpha: diffuse, as trained, far beyond where exp(alpha beta) overflows, nothing in reach
ANNEALING = [(1e-3, 1e-3), (12.0, 0.3), (60.0, 1.0), (100.0, 2.0), (200.0, 4.0), (1e4, 1.0),
             (1e4, 0.01), (300.0, 0.0), (2.0, 50.0)]  # fmt: skip
HERE, THERE = np.arange(N) % 3 != 1, np.arange(M) % 4 != 2


@functools.cache
def compiled(form, passes):
    return jax.jit(functools.partial(FORMS[form], passes=passes))


def affinity(beta, alpha, dtype=np.float32, seed=0):
    """Affinities of unit features, and target points."""
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(N, 8)), rng.normal(size=(M, 8))
    target[:5] = source[:5] + 0.05 * rng.normal(size=(5, 8))
    source, target = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in (source, target))
    parts = (np.asarray(part, dtype) for part in (source, target, beta, alpha))
    return Affinity(*map(jnp.asarray, parts)), jnp.asarray(rng.normal(size=(M, 3)).astype(dtype))


def only(given, points, here, there):
    """The valid rows alone."""
    kept = Affinity(given.source[here], given.target[there], given.beta, given.alpha)
    return kept, points[there]


def reference(given, points, passes):
    source, target, beta, alpha = (
        np.float64(part) for part in (given.source, given.target, given.beta, given.alpha)
    )
    block = pieces.sinkhorn_log(-beta * (2 - 2 * source @ target.T - alpha), passes)
    weights = block.sum(axis=1)
    return weights, (block @ points) / (weights[:, None] + 1e-5), block.sum(axis=0)


def tolerance(form, beta, alpha):
    # the exponent is beta times a distance that float32 knows to 1e-7 and a half; and logarithms
    # beyond a thousand, which only the log form goes on working with, carry three decimals
    large = form == "log space" and beta * max(4, alpha) > 1000
    return max(1e-5, 4e-7 * beta, 2e-2 if large else 0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("passes", [1, 2, 5])
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_every_form_is_the_reference(form, passes, beta, alpha):
    given, points = affinity(beta, alpha)

    found = compiled(form, passes)(given, points)

    weights, targets, covered = reference(given, points, passes)
    atol = tolerance(form, beta, alpha)
    np.testing.assert_allclose(found.weights, weights, atol=atol)
    np.testing.assert_allclose(found.covered, covered, atol=atol)
    # where hardly anything is matched, the mean of it is a quotient of two small numbers
    np.testing.assert_allclose(found.targets * weights[:, None], targets * weights[:, None],
                               atol=3 * atol)  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_masked_points_neither_give_nor_take(form, beta, alpha):
    given, points = affinity(beta, alpha)
    junk = Affinity(
        jnp.where(HERE[:, None], given.source, 7),
        jnp.where(THERE[:, None], given.target, 7),
        given.beta,
        given.alpha,
    )

    found = compiled(form, 3)(
        junk,
        jnp.where(THERE[:, None], points, 1e3),
        source_mask=jnp.asarray(HERE),
        target_mask=jnp.asarray(THERE),
    )

    alone = compiled(form, 3)(*only(given, points, HERE, THERE))
    atol = tolerance(form, beta, alpha)
    np.testing.assert_allclose(found.weights[HERE], alone.weights, atol=atol)
    np.testing.assert_allclose(found.covered[THERE], alone.covered, atol=atol)
    np.testing.assert_allclose(found.targets[HERE], alone.targets, atol=3 * atol)
    assert not found.weights[~HERE].any() and not found.covered[~THERE].any()


@functools.cache
def slope(form, passes=3):
    def total(given, points, source_mask, target_mask):
        found = FORMS[form](
            given, points, passes=passes, source_mask=source_mask, target_mask=target_mask
        )
        pull = (jnp.sin(jnp.arange(part.size, dtype=part.dtype)) for part in found)
        return sum(jnp.sum(part.ravel() * by) for part, by in zip(found, pull, strict=True))

    return jax.jit(jax.value_and_grad(total, (0, 1)))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_gradients_are_finite_masked_or_not(form, beta, alpha):
    given, points = affinity(beta, alpha)
    everywhere = jnp.ones(N, bool), jnp.ones(M, bool)
    nowhere = jnp.zeros(N, bool), jnp.zeros(M, bool)

    for masks in (everywhere, (jnp.asarray(HERE), jnp.asarray(THERE)), nowhere):
        value, gradients = slope(form)(given, points, *masks)

        assert np.isfinite(value)
        assert all(np.isfinite(gradient).all() for gradient in jax.tree.leaves(gradients))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("passes", [1, 3])
@pytest.mark.parametrize(("beta", "alpha"), [(12.0, 0.3), (200.0, 4.0)])
def test_gradients_are_their_finite_differences(x64, form, passes, beta, alpha):
    at = affinity(beta, alpha, np.float64)
    masks = jnp.asarray(HERE), jnp.asarray(THERE)
    rng = np.random.default_rng(1)
    towards = jax.tree.map(lambda part: jnp.asarray(rng.normal(size=part.shape)), at)
    step = 1e-6

    _, gradients = slope(form, passes)(*at, *masks)

    # of each argument alone: none can hide behind a larger one
    for which in range(5):
        change = jax.tree.unflatten(
            jax.tree.structure(at),
            [
                step * part if i == which else 0 * part
                for i, part in enumerate(jax.tree.leaves(towards))
            ],
        )
        ahead, behind = (
            slope(form, passes)(*jax.tree.map(lambda a, c, s=s: a + s * c, at, change), *masks)[0]
            for s in (1, -1)
        )
        derivative = sum(
            jnp.sum(g * c) for g, c in zip(*map(jax.tree.leaves, (gradients, change)), strict=True)
        )
        np.testing.assert_allclose(derivative, (ahead - behind) / 2, rtol=1e-5, atol=1e-12)


def assert_same_slope(form, dtype, beta, alpha, atol):
    at = *affinity(beta, alpha, dtype), jnp.asarray(HERE), jnp.asarray(THERE)

    found, wanted = (jax.tree.leaves(slope(each)(*at)) for each in (form, "dense"))

    for part, expected in zip(found, wanted, strict=True):
        size = max(1, float(jnp.abs(expected).max()))
        np.testing.assert_allclose(part / size, expected / size, atol=atol, rtol=0)


@pytest.mark.parametrize("form", WAYS)
@pytest.mark.parametrize(("beta", "alpha"), ANNEALING)
def test_the_gradient_by_hand_is_that_of_the_dense_form(x64, form, beta, alpha):
    assert_same_slope(form, np.float64, beta, alpha, atol=1e-9)


@pytest.mark.parametrize("form", WAYS)
def test_the_gradient_by_hand_is_that_of_the_dense_form_in_single_precision(form):
    # at sharper annealing float32 parts each of them from the truth by more than this, equally
    assert_same_slope(form, np.float32, 12.0, 0.3, atol=1e-5)


@pytest.mark.parametrize("form", WAYS)
def test_a_batch_is_matched_like_its_pairs(form):
    pairs = [affinity(12.0, 0.3, seed=seed) for seed in (0, 1)]
    batch = jax.tree.map(lambda *parts: jnp.stack(parts), *pairs)
    masks = jnp.asarray(HERE), jnp.asarray(THERE)

    _, together = jax.jit(jax.vmap(slope(form), (0, 0, None, None)))(*batch, *masks)

    for i, pair in enumerate(pairs):
        alone = slope(form)(*pair, *masks)[1]
        for batched, single in zip(*map(jax.tree.leaves, (together, alone)), strict=True):
            np.testing.assert_allclose(batched[i], single, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("differentiated", [False, True])
def test_memory_of_the_streamed_match_grows_with_the_clouds_and_not_with_their_product(
    differentiated,
):
    def needed(n):
        shapes = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in [(n, 8), (n, 8), (), ()])
        points = jax.ShapeDtypeStruct((n, 3), jnp.float32)

        def run(given, points):
            way = Way("streamed", 16)
            found = match_by_hand(given, points, passes=3, on_cpu=way, elsewhere=way)
            return jnp.sum(found.targets) + jnp.sum(found.covered)

        program = jax.jit(jax.grad(run) if differentiated else run)
        compiled = program.lower(Affinity(*shapes), points).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    small, large = needed(1000), needed(8000)

    assert large < 10 * small
    assert large < 8000 * 8000 * 4 / 20


def test_large_blocks_are_streamed_and_small_ones_may_be():
    given, points = affinity(12.0, 0.3)

    found, wanted = (match(given, points, passes=2, form=form) for form in ("streamed", "auto"))

    for part, expected in zip(found, wanted, strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-5)
    assert form_for(5000, 5000, "cpu") == "dense" and form_for(12_000, 12_000, "cpu") == "streamed"
    assert form_for(100, 100_000, "cpu") == "dense"
    assert form_for(12_000, 12_000, "accelerator") == "dense"
    assert form_for(30_000, 30_000, "accelerator") == "streamed"


@pytest.mark.parametrize(("n", "stored"), [(6000, True), (12_000, True), (30_000, False)])
def test_an_accelerator_stores_what_a_cpu_streams(n, stored):
    shapes = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in [(n, 96), (n, 96), (), ()])
    given, points = Affinity(*shapes), jax.ShapeDtypeStruct((n, 3), jnp.float32)

    def total(given, points):
        return jnp.sum(match(given, points, passes=3).targets)

    for function in (total, jax.grad(total, (0, 1))):
        traced = jax.jit(function).trace(given, points)
        for platform in ("cpu", "cuda", "rocm", "tpu"):
            text = traced.lower(lowering_platforms=(platform,)).as_text()
            assert ("stablehlo.while" in text) == (platform == "cpu" or not stored)
            assert (f"tensor<{n}x{n}xf32>" in text) == (platform != "cpu" and stored)


def test_halves_multiply_to_the_precision_of_float32_without_being_rounded():
    rng = np.random.default_rng(3)
    source, target = (rng.normal(size=(size, 96)) for size in (200, 300))
    source, target = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in (source, target))
    source, target = np.float32(source), np.float32(target)
    factors, matmul = [], jnp.matmul

    def product(*given, **rest):
        factors.extend(np.asarray(factor) for factor in given)
        return matmul(*given, **rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jnp, "matmul", product)
        found = by_halves(jnp.asarray(source), jnp.asarray(target))

    for factor in factors:  # TF32 keeps ten of the 23 bits behind the first
        assert not (factor.copy().view(np.uint32) & 0x1FFF).any()
    wanted = np.float64(source) @ np.float64(target).T
    exact = np.float64(factors[0]) @ np.float64(factors[1])
    np.testing.assert_allclose(exact, wanted, rtol=0, atol=2.0**-24)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=3e-7)


def test_a_gpu_multiplies_features_in_halves_and_everything_else_at_full_precision():
    given, points = affinity(12.0, 0.3)

    def total(given, points):
        return jnp.sum(match(given, points, passes=2).targets)

    for function in (total, jax.grad(total)):
        traced = jax.jit(function).trace(given, points)
        for platform in ("cpu", "cuda", "rocm", "tpu"):
            text = traced.lower(lowering_platforms=(platform,)).as_text()
            products = [line for line in text.splitlines() if "stablehlo.dot_general" in line]
            rounded = [line for line in products if line.count("HIGHEST") < 2]
            assert len(rounded) == (platform == "cuda")
            assert all(f"tensor<{N}x24xf32>, tensor<24x{M}xf32>" in line for line in rounded)


@pytest.mark.parametrize("form", FORMS)
def test_no_point_finds_more_than_one_partner(form):
    given, points = affinity(30.0, 1.5, seed=2)

    found = compiled(form, 5)(given, points)

    for sums in (found.weights, found.covered):
        assert (sums >= 0).all() and (sums <= 1 + 1e-5).all()
    np.testing.assert_allclose(found.weights.sum(), found.covered.sum(), rtol=1e-5)


def test_at_least_one_pass_is_asked_for_and_a_form_that_exists(unchecked):
    given = affinity(1.0, 1.0)

    with pytest.raises(ValueError, match="^passes: got 0"):
        match(*given, passes=0)
    with pytest.raises(ValueError, match="^form: got 'fast', wanted 'auto' or one of"):
        match(*given, passes=1, form="fast")

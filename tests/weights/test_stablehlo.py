"""The exported program: the same results on any platform, without this package."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.cli import main
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.cfr.registration import Settings, register
from cfr_jax.weights.files import save_params
from cfr_jax.weights.stablehlo import export_register, load_exported, save_exported

SETTINGS = Settings(neighbors=8)
CAPACITY = 64
EXAMPLE = Path(__file__).parents[2] / "examples" / "run_exported.py"


@pytest.fixture(scope="module")
def tiny():
    return init_params(jax.random.key(0), iterations=2)


def cloud(count, seed):
    """Points on an egg, with normals, (count, 6)."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.hstack([points * [0.9, 0.6, 0.4], points]).astype(np.float32)


@pytest.fixture(scope="module")
def written(tiny, tmp_path_factory):
    """A program for clouds with normals, on three platforms."""
    exported = export_register(
        tiny,
        points=CAPACITY,
        platforms=("cpu", "cuda", "tpu"),
        normals=True,
        settings=SETTINGS,
    )
    path = tmp_path_factory.mktemp("export") / "model.stablehlo"
    save_exported(path, exported)
    return path


def test_an_exported_program_gives_the_results_of_register(tiny, written):
    # given
    source, target = cloud(48, 0), cloud(40, 1)

    # when
    loaded = load_exported(written)
    found = loaded(source, target)

    # then
    wanted = register(tiny, jnp.asarray(source), jnp.asarray(target), settings=SETTINGS)
    assert (loaded.capacity, loaded.channels) == (CAPACITY, 6)
    for name in ("transform", "transforms", "weights", "covered"):
        np.testing.assert_allclose(found[name], getattr(wanted, name), atol=1e-5)


def test_a_program_for_accelerators_has_no_calls_that_only_a_cpu_supports(tiny):
    """Also if it estimates the normals itself. LAPACK and callbacks into Python would be calls."""
    exported = export_register(
        tiny, points=CAPACITY, platforms=("cpu", "cuda", "rocm", "tpu"), settings=SETTINGS
    )
    assert exported.platforms == ("cpu", "cuda", "rocm", "tpu")
    program = exported.mlir_module()
    assert "custom_call" not in program and "stablehlo.dot_general" in program


@pytest.mark.slow
def test_a_batched_program_takes_any_number_of_pairs(tiny, written):
    # given
    exported = export_register(tiny, points=CAPACITY, normals=True, batch=True, settings=SETTINGS)
    pairs = [(cloud(48, 0), cloud(40, 1)), (cloud(64, 2), cloud(50, 3))]
    one_by_one = load_exported(written)

    # when
    padded = [
        np.stack([np.pad(pair[k], ((0, CAPACITY - len(pair[k])), (0, 0))) for pair in pairs])
        for k in (0, 1)
    ]
    counts = [np.array([len(pair[k]) for pair in pairs], np.int32) for k in (0, 1)]
    found = exported.call(padded[0], counts[0], padded[1], counts[1])

    # then
    for k, pair in enumerate(pairs):
        np.testing.assert_allclose(
            found["transforms"][k], one_by_one(*pair)["transforms"], atol=1e-5
        )


def test_clouds_that_do_not_fit_the_program_are_refused_by_name(written, unchecked):
    loaded = load_exported(written)
    fine = cloud(40, 0)
    with pytest.raises(ValueError, match="source: got 65 points, .* at most 64"):
        loaded(cloud(65, 0), fine)
    with pytest.raises(ValueError, match=r"target: got shape \(40, 3\), wanted \(n, 6\)"):
        loaded(fine, fine[:, :3])
    with pytest.raises(ValueError, match="target: got values that are not finite"):
        loaded(fine, fine * np.float32(np.nan))


def test_what_cannot_be_exported_is_refused_by_name(tiny, unchecked):
    with pytest.raises(ValueError, match="points: got 8, wanted at least 9"):
        export_register(tiny, points=8, settings=SETTINGS)
    with pytest.raises(ValueError, match="platforms: got gpu, wanted some of cpu, cuda"):
        export_register(tiny, points=64, platforms=("cpu", "gpu"), settings=SETTINGS)


def test_every_program_with_a_flipped_bit_is_refused(written, tmp_path):
    # given
    whole = written.read_bytes()
    generator = np.random.default_rng(0)
    path = tmp_path / "model.stablehlo"
    bits = {*range(8 * 64), *generator.integers(0, 8 * len(whole), 1500).tolist()}

    for bit in sorted(bits):
        # when
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)

        # then
        with pytest.raises(ValueError, match="damaged"):
            load_exported(path)


def test_a_program_without_a_digest_is_refused_and_jax_reads_it_at_the_documented_place(written):
    plain = written.with_name("plain.stablehlo")
    plain.write_bytes(written.read_bytes()[32:])
    with pytest.raises(ValueError, match="first 32 bytes are not the SHA-256 of the rest"):
        load_exported(plain)
    assert jax.export.deserialize(bytearray(plain.read_bytes())).in_avals[0].shape == (CAPACITY, 6)


def test_a_program_of_something_else_is_refused(tmp_path):
    square = jax.jit(lambda numbers: numbers**2)
    for arguments in ([jnp.ones(3)], [jnp.ones((3, 3))]):
        save_exported(tmp_path / "other.stablehlo", jax.export.export(square)(*arguments))
        with pytest.raises(ValueError, match="other.stablehlo .*not one of `register`"):
            load_exported(tmp_path / "other.stablehlo")


def example():
    spec = importlib.util.spec_from_file_location("run_exported", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_example_loads_what_is_whole_and_refuses_what_is_damaged(written, tmp_path):
    assert example().load(written).in_avals[0].shape == (CAPACITY, 6)
    damaged = bytearray(written.read_bytes())
    damaged[-100] ^= 1
    (tmp_path / "damaged.stablehlo").write_bytes(damaged)
    with pytest.raises(ValueError, match="is damaged"):
        example().load(tmp_path / "damaged.stablehlo")


@pytest.mark.parametrize("content", [b"", b"nonsense", bytes(range(256)) * 9])
def test_a_file_that_holds_no_program_is_refused_by_name(content, tmp_path):
    (tmp_path / "model.stablehlo").write_bytes(content)
    with pytest.raises(ValueError, match="model.stablehlo is (empty|not an exported program)"):
        load_exported(tmp_path / "model.stablehlo")


def test_the_command_writes_a_program_and_says_what_it_takes(tiny, tmp_path, capsys):
    # given
    save_params(tmp_path / "tiny.safetensors", tiny)
    out = tmp_path / "model.stablehlo"
    options = ["--points", "65", "--weights", str(tmp_path / "tiny.safetensors")]

    # when
    code = main(["export", *options, "--platforms", "cpu, tpu", "--out", str(out)])

    # then
    told = capsys.readouterr().out
    loaded = load_exported(out)
    assert code == 0 and "source          float32[65,3]" in told
    assert (loaded.platforms, loaded.capacity, loaded.channels) == (("cpu", "tpu"), 65, 3)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--points", "64"], "points: got 64, wanted at least 65"),
        (["--platforms", "gpu"], "platforms: got gpu"),
        (["--platforms", ""], "platforms: got"),
        (["--out", "model.onnx"], "wanted a name that ends in .stablehlo"),
    ],
)
def test_the_command_refuses_what_it_cannot_export(options, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "--out", "model.stablehlo", *options]) == 2
    assert told in capsys.readouterr().err and list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_example_needs_only_jax_and_numpy_and_uses_the_callers_frame(tiny, tmp_path):
    # given
    imported = {
        name.name.partition(".")[0]
        for node in ast.walk(ast.parse(EXAMPLE.read_text("utf-8")))
        if isinstance(node, ast.Import)
        for name in node.names
    }
    exported = export_register(tiny, points=CAPACITY, settings=SETTINGS)
    source, target = cloud(48, 0)[:, :3].astype(float), cloud(40, 1)[:, :3].astype(float)
    shift, size = np.array([5e5, -3.0, 10.0]), 250.0

    # when
    here = example().register(exported, source, target)
    far = example().register(exported, size * source, size * target + shift)

    # then
    assert imported == {"hashlib", "sys", "jax", "numpy"}
    centers = source.mean(0), target.mean(0)
    scale = max(
        np.linalg.norm(part - center, axis=1).max()
        for part, center in zip((source, target), centers, strict=True)
    )
    units = [
        jnp.asarray((part - center) / scale, jnp.float32)
        for part, center in zip((source, target), centers, strict=True)
    ]
    wanted = np.asarray(register(tiny, *units, settings=SETTINGS).transform, float)
    moved = (np.asarray(units[0]) @ wanted[:3, :3].T + wanted[:3, 3]) * scale + centers[1]
    np.testing.assert_allclose(source @ here[:3, :3].T + here[:3, 3], moved, atol=1e-4)
    np.testing.assert_allclose(far[:3, :3], here[:3, :3], atol=1e-4)
    np.testing.assert_allclose(far[:3, 3], size * here[:3, 3] + shift, atol=1e-4 * size)

"""Weights on disk: saved weights are read back, and all other files are refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load_file, save_file

from cfr_jax.networks import rpmnet, table
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.probability import KEY, Calibration, calibration_of
from cfr_jax.weights.files import load_params, network_of, read_weights, save_params, shipped


@pytest.fixture(scope="module")
def fresh():
    return jax.jit(init_params, static_argnums=1)(jax.random.key(0), 2)


@pytest.fixture
def saved(fresh, tmp_path):
    path = tmp_path / "mine.safetensors"
    save_params(path, fresh, {"made_by": "a test", "corpus": "none"})
    return path


def test_what_is_saved_comes_back_with_its_notes(fresh, saved):
    found = read_weights(saved)

    assert jax.tree.structure(found.params) == jax.tree.structure(fresh)
    for a, b in zip(jax.tree.leaves(found.params), jax.tree.leaves(fresh), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_array_equal(a, b)
    assert found.notes == {"made_by": "a test", "corpus": "none"}
    assert found.name == "mine" and len(found.sha256) == 64
    assert jax.tree.all(jax.tree.map(jnp.array_equal, load_params(str(saved)), fresh))
    assert [path.name for path in saved.parent.iterdir()] == ["mine.safetensors"]


def test_the_calibration_comes_back_with_the_weights(fresh, tmp_path):
    # given weights of ours with the calibration of others
    path = tmp_path / "calibrated.safetensors"
    fitted = calibration_of(load_params("object"))
    save_params(path, {**fresh, KEY: fitted}, {"made_by": "a test"})

    # when
    found = read_weights(path)

    # then
    assert calibration_of(found.params) == fitted and found.notes == {"made_by": "a test"}
    assert jax.tree.leaves(found.params)[0].dtype == jnp.float32
    save_params(tmp_path / "again.safetensors", found.params, found.notes)
    assert read_weights(tmp_path / "again.safetensors").sha256 == found.sha256
    # other coefficients give another digest, and weights without coefficients have none
    save_params(path, fresh, {"made_by": "a test"})
    bare = read_weights(path)
    assert calibration_of(bare.params) is None and bare.sha256 != found.sha256


@pytest.mark.parametrize(
    ("fitted", "told"),
    [
        ("nonsense", "the note is not valid JSON"),
        (
            '{"register": {"bias": 1}, "align": {"bias": 1}}',
            "register has other clues than this version",
        ),
    ],
)
def test_a_damaged_calibration_is_refused(fresh, tmp_path, monkeypatch, fitted, told):
    # given a file whose digest matches, because it was written with that note
    monkeypatch.setattr(Calibration, "write", lambda _: fitted)
    path = tmp_path / "damaged.safetensors"
    save_params(path, {**fresh, KEY: Calibration.of({"bias": 0.0}, {"bias": 0.0})})

    with pytest.raises(ValueError, match=f"^weights: .*damaged.safetensors: calibration: {told}"):
        read_weights(path)


@pytest.mark.parametrize("name", [KEY, "sha256"])
def test_reserved_names_of_notes_are_refused(fresh, tmp_path, name):
    with pytest.raises(ValueError, match=f"notes: got the reserved name '{name}'"):
        save_params(tmp_path / "w.safetensors", fresh, {name: "{}"})
    assert not list(tmp_path.iterdir())


def test_tensors_of_no_network_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    save_params(path, {"nobody": np.zeros(3, np.float32)})
    with pytest.raises(ValueError, match="other.*no known network .* tensors: nobody"):
        read_weights(path)


def test_weights_have_the_same_digest_only_if_they_are_equal(fresh, saved, tmp_path):
    other = tmp_path / "other.safetensors"
    digest = read_weights(saved).sha256

    save_params(other, fresh, {"corpus": "none", "made_by": "a test"})
    assert read_weights(other).sha256 == digest

    save_params(other, jax.tree.map(lambda leaf: leaf * 2, fresh), {"made_by": "a test"})
    assert read_weights(other).sha256 != digest


def test_any_flipped_bit_is_noticed(saved):
    content = bytearray(saved.read_bytes())
    header = 8 + int.from_bytes(content[:8], "little")
    rng = np.random.default_rng(0)
    places = [*rng.integers(0, header, 150), *rng.integers(header, len(content), 350)]

    for place in places:
        bit = 1 << int(rng.integers(8))
        content[place] ^= bit
        saved.write_bytes(content)
        with pytest.raises(ValueError, match="^weights: "):
            read_weights(saved)
        content[place] ^= bit

    saved.write_bytes(content)
    read_weights(saved)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.9999])
def test_a_truncated_file_is_refused(saved, share):
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])

    with pytest.raises(ValueError, match="is not a readable safetensors file"):
        read_weights(saved)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda tree: tree["cascade"].pop("bias"), "cascade/bias is missing"),
        (lambda tree: tree.update(extra=np.zeros(3)), "extra is .*, wanted no such tensor"),
        (lambda tree: tree["features"].update(bias_0=np.zeros(95, np.float32)), "features/bias_0"),
        (lambda tree: tree["features"].update(bias_0=np.zeros(96)), "bias_0 is float64"),
    ],
)
def test_another_network_is_refused(fresh, tmp_path, change, told):
    tree = jax.tree.map(np.asarray, fresh)
    change(tree)
    save_params(tmp_path / "other.safetensors", tree)

    with pytest.raises(ValueError, match=f"^weights: .*{told}"):
        read_weights(tmp_path / "other.safetensors")


def test_a_file_knows_which_network_it_holds(fresh, saved, tmp_path):
    # given weights of the two networks
    other = tmp_path / "other.safetensors"
    save_params(other, jax.jit(rpmnet.init_params)(jax.random.key(0)))

    # then each is read for what it is
    assert read_weights(saved).network == network_of(fresh) == "cfr"
    assert read_weights(other).network == "rpmnet"
    assert network_of(load_params(other, "rpmnet")) == "rpmnet"
    with pytest.raises(ValueError, match="other.* holds the network RPM-Net, wanted CFR$"):
        load_params(other)
    with pytest.raises(ValueError, match="mine.* holds the network CFR, wanted RPM-Net$"):
        load_params(saved, "rpmnet")


def test_weights_with_a_shared_layer_come_back(tmp_path):
    path = tmp_path / "shared.safetensors"
    save_params(path, jax.jit(init_params, static_argnums=(1, 2))(jax.random.key(0), 3, True))
    assert load_params(path)["cascade"]["kernel"].shape == (1, 96, 96)


def test_a_file_of_someone_else_is_refused(saved, tmp_path):
    path = tmp_path / "theirs.safetensors"
    save_file(load_file(saved), path)

    with pytest.raises(ValueError, match="has no digest, so cfr_jax did not write it"):
        read_weights(path)


def test_an_unknown_name_is_answered_with_the_shipped_names():
    with pytest.raises(ValueError, match="no file and no shipped weights called 'nowhere'"):
        read_weights("nowhere")


def test_a_failed_save_leaves_nothing_behind(saved):
    before = saved.read_bytes()

    with pytest.raises(Exception, match="."):
        save_params(saved, {"a": object()})

    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["mine.safetensors"]


def test_every_shipped_file_is_sound():
    for name in shipped():
        found = read_weights(name)

        assert found.name == name
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found.params))


def test_float16_rounds_large_tensors_alone_and_halves_the_file(fresh, saved, tmp_path):
    # given
    path = tmp_path / "half.safetensors"

    # when
    save_params(path, fresh, {"made_by": "a test"}, float16=True)

    # then
    found = flatten_dict(read_weights(path).params, sep="/")
    for name, wanted in flatten_dict(fresh, sep="/").items():
        given, wanted = np.asarray(found[name]), np.asarray(wanted)
        assert given.dtype == np.float32
        if wanted.size < 4096:
            np.testing.assert_array_equal(given, wanted)
        else:  # half a unit in the last of 11 digits, or of the smallest number
            assert (np.abs(given - wanted) <= np.maximum(np.abs(wanted) * 2**-11, 2**-25)).all()
            assert (given != wanted).any()
    assert path.stat().st_size < 0.55 * saved.stat().st_size
    # what was rounded once is not rounded again
    save_params(tmp_path / "again.safetensors", read_weights(path).params, float16=True)
    again = read_weights(tmp_path / "again.safetensors").params
    assert jax.tree.all(jax.tree.map(jnp.array_equal, again, read_weights(path).params))


def test_any_flipped_bit_of_a_float16_file_is_noticed(fresh, tmp_path):
    path = tmp_path / "half.safetensors"
    save_params(path, fresh, float16=True)
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(1)
    for place in rng.integers(0, len(content), 200):
        content[place] ^= 4
        path.write_bytes(content)
        with pytest.raises(ValueError, match="^weights: "):
            read_weights(path)
        content[place] ^= 4


def test_numbers_beyond_float16_are_refused_by_name_and_nothing_is_written(fresh, tmp_path):
    tree = jax.tree.map(np.array, fresh)
    tree["cascade"]["kernel"][0, 0, 0] = -65_536.0
    with pytest.raises(ValueError, match="float16: cascade/kernel holds 65536, wanted at most 655"):
        save_params(tmp_path / "half.safetensors", tree, float16=True)
    assert not list(tmp_path.iterdir())
    # in float32 they are fine
    save_params(tmp_path / "whole.safetensors", tree)
    assert read_weights(tmp_path / "whole.safetensors").params["cascade"]["kernel"].min() == -65_536


def test_the_largest_baseline_takes_less_than_twelve_megabytes(tmp_path):
    path = tmp_path / "dcp.safetensors"
    save_params(path, jax.jit(table.named("dcp").fresh)(jax.random.key(0)), float16=True)
    assert read_weights(path).network == "dcp"
    assert path.stat().st_size < 12e6


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused_with_the_right_digest(fresh, tmp_path, value):
    # given
    names = sorted(flatten_dict(fresh, sep="/"))
    path = tmp_path / "poisoned.safetensors"
    for name in names[:: len(names) // 5]:
        flat = {key: np.array(leaf) for key, leaf in flatten_dict(fresh, sep="/").items()}
        flat[name].flat[-1] = value
        tree = unflatten_dict(flat, sep="/")
        save_params(path, tree)

        # when, then
        with pytest.raises(ValueError, match=f"poisoned.*: {name} holds a number that is not fin"):
            read_weights(path)


def test_a_bias_that_claims_a_million_iterations_is_refused_before_it_is_traced(fresh, tmp_path):
    tree = jax.tree.map(np.asarray, fresh)
    tree["annealing"]["out"]["bias"] = np.zeros(4 << 20, np.float32)
    save_params(tmp_path / "long.safetensors", tree)
    with pytest.raises(ValueError, match="for 2,097,152 iterations, wanted at most 100"):
        read_weights(tmp_path / "long.safetensors")


def _with_type(path, kind, size):
    """A safetensors file of one tensor of a type, made by hand: numpy has not all of them."""
    header = {
        "cascade/kernel": {"dtype": kind, "shape": [4], "data_offsets": [0, 4 * size]},
        "__metadata__": {"sha256": "0" * 64},
    }
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(4 * size))


@pytest.mark.parametrize(
    ("kind", "size"),
    [("F8_E4M3", 1), ("F8_E5M2", 1), ("BF16", 2), ("F16", 2), ("U8", 1), ("C64", 8), ("X9", 1)],
)
def test_tensors_of_any_type_are_refused_in_words(kind, size, tmp_path):
    path = tmp_path / "typed.safetensors"
    _with_type(path, kind, size)
    with pytest.raises(ValueError, match="^weights: .*typed.safetensors") as caught:
        read_weights(path)
    assert len(str(caught.value)) <= 600


@pytest.mark.parametrize("name", ["", "no\0thing", "x" * 5000, "/dev/null", "/"])
def test_a_path_that_is_no_file_of_weights_is_refused(name):
    with pytest.raises(ValueError, match="^weights: ") as caught:
        read_weights(name)
    assert len(str(caught.value)) <= 600

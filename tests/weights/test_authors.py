"""Conversion of published checkpoints: every tensor finds its place or is named in an error."""

import sys
import types

import jax
import numpy as np
import pytest
from oracle import authors
from safetensors.numpy import save_file

from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.weights.authors import convert, from_state_dict
from cfr_jax.weights.files import network_of


def same(tree, other):
    assert jax.tree.structure(tree) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("iterations", [1, 5])
@pytest.mark.parametrize("conv_rank", [3, 4])
def test_the_tree_is_that_of_fresh_parameters(iterations, conv_rank):
    state = authors.random_state_dict(0, conv_rank=conv_rank, iterations=iterations)

    params = from_state_dict(state)

    wanted = jax.eval_shape(lambda: init_params(jax.random.key(0), iterations))
    assert jax.tree.structure(params) == jax.tree.structure(wanted)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), params) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), wanted
    )
    # every number of the checkpoint occurs exactly once, because all are different
    theirs = np.sort(np.concatenate([value.ravel() for value in state.values()]))
    ours = np.sort(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(params)]))
    np.testing.assert_array_equal(ours, theirs)


def test_iterations_are_stacked_by_number_and_not_by_name():
    state = authors.random_state_dict(0, iterations=11)
    shuffled = {name: state[name] for name in sorted(state)}  # ... nets_a.1, nets_a.10, nets_a.2

    params = from_state_dict(shuffled)

    for i in range(11):
        weight = state[f"feat_extractor_xyz.nets_a.{i}.2.weight"][..., 0]
        np.testing.assert_array_equal(params["cascade"]["kernel"][i], weight.T)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_files_without_torch_give_what_the_tensors_give(tmp_path, suffix):
    state = authors.random_state_dict(1)
    path = tmp_path / f"authors{suffix}"
    np.savez(path, **state) if suffix == ".npz" else save_file(state, path)

    same(convert(path), from_state_dict(state))


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_pytorch_file_is_read_as_tensors_alone(tmp_path, monkeypatch, wrapped):
    # torch itself is too large for the tests, so a stand-in records how it is called
    state = authors.random_state_dict(2)

    class Tensor:
        def __init__(self, value):
            self.value = value

        def to(self, dtype):
            return Tensor(self.value.astype(dtype))

        def numpy(self):
            return self.value

    def load(path, *, map_location, weights_only):
        assert map_location == "cpu" and weights_only is True
        tensors = {name: Tensor(value) for name, value in state.items()}
        return {"state_dict": tensors, "epoch": 3} if wrapped else tensors

    torch = types.SimpleNamespace(load=load, float32=np.float32)
    monkeypatch.setitem(sys.modules, "torch", torch)
    path = tmp_path / "authors.pth"
    path.write_bytes(b"")

    same(convert(path), from_state_dict(state))


def test_without_torch_the_message_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    path = tmp_path / "authors.pth"
    path.write_bytes(b"")

    with pytest.raises(ValueError, match=r'pip install "cfr_jax\[torch\]"') as caught:
        convert(path)

    assert "\n" not in str(caught.value)


def test_every_faulty_tensor_is_named():
    state = authors.random_state_dict(3)
    del state["weights_net.prepool.4.bias"]
    del state["feat_extractor_xyz.nets_b.3.0.weight"]
    state["feat_extractor.postpool.0.weight"] = np.zeros((192, 192, 1), np.float32)
    state["feat_extractor_ball.prepool.0.weight"] = np.zeros((96, 10, 1), np.float32)
    state["feat_extractor_xyz.nets_a.0.2.weight"] = np.zeros((96, 96, 1, 1, 1), np.float32)
    state["weights_net.postpool.6.bias"][4] = np.nan
    state["weights_net.postpool.1.bias"] = np.full(512, 1e300)
    state["weights_net.postpool.1.weight"] = np.ones(512, np.int64)

    with pytest.raises(ValueError) as caught:
        from_state_dict(state, "authors.pth")

    message = str(caught.value)
    assert message.startswith("authors.pth does not hold CFR: ")
    for fault in (
        "weights_net.prepool.4.bias is missing",
        "feat_extractor_xyz.nets_b.3.0.weight is missing",
        "feat_extractor.postpool.0.weight is unknown",
        "feat_extractor_ball.prepool.0.weight has shape (96, 10, 1), wanted (96, 7)",
        "feat_extractor_xyz.nets_a.0.2.weight has shape (96, 96, 1, 1, 1), wanted (96, 96)",
        "weights_net.postpool.6.bias is not finite in float32",
        "weights_net.postpool.1.bias is not finite in float32",
        "weights_net.postpool.1.weight holds int64, wanted floats",
    ):
        assert fault in message
    assert message.count(";") == 7


def test_a_gap_among_the_iterations_is_named():
    state = authors.random_state_dict(4)
    for name in [name for name in state if ".nets_a.2." in name]:
        del state[name]

    with pytest.raises(
        ValueError, match=r"nets_a\.2\.0\.weight is missing.*nets_a\.4\.0\.weight is"
    ):
        from_state_dict(state)


def test_rpmnet_is_recognized_by_its_names():
    # given a checkpoint that lacks a tensor, and another whole
    broken = authors.random_rpmnet_state_dict(0, conv_rank=4)
    del broken["feat_extractor.postpool.3.bias"]

    # then
    with pytest.raises(ValueError, match="not hold RPM-Net: feat_extractor.postpool.3.bias is mis"):
        from_state_dict(broken)
    whole = [from_state_dict(authors.random_rpmnet_state_dict(0, conv_rank=r)) for r in (3, 4)]
    assert [network_of(params) for params in whole] == ["rpmnet", "rpmnet"]
    assert jax.tree.all(jax.tree.map(np.array_equal, *whole))


@pytest.mark.parametrize("name", ["missing.npz", "authors.ckpt"])
def test_a_path_that_cannot_be_read_is_refused(tmp_path, name):
    (tmp_path / "authors.ckpt").write_bytes(b"")

    with pytest.raises(ValueError, match=f"^path: .*{name}"):
        convert(tmp_path / name)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_a_damaged_file_is_refused(tmp_path, suffix):
    path = tmp_path / f"authors{suffix}"
    path.write_bytes(b"PK\x03\x04 nothing of the kind" * 9)

    with pytest.raises(ValueError, match="is not a readable checkpoint"):
        convert(path)


def test_objects_in_a_file_are_never_unpickled(tmp_path):
    path = tmp_path / "authors.npz"
    np.savez(path, **{"weights_net.prepool.0.weight": np.array([{"an": "object"}], object)})

    with pytest.raises(ValueError, match="is not a readable checkpoint"):
        convert(path)

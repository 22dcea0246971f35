"""Conversion of published checkpoints: every tensor finds its place or is named in an error."""

import sys
import types

import jax
import numpy as np
import pytest
from oracle import authors
from safetensors.numpy import save_file

from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.weights.conversion import convert, from_state_dict
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


class Tensor:
    """What the converter asks of a tensor of PyTorch, which is too large for the tests."""

    layout = "strided"

    def __init__(self, value):
        self.value = value

    def is_floating_point(self):
        return self.value.dtype.kind == "f"

    def numel(self):
        return self.value.size

    def to(self, dtype):
        return Tensor(self.value.astype(dtype))

    def numpy(self):
        return self.value


@pytest.fixture
def torch_file(tmp_path, monkeypatch):
    """Writes a file that the stand-in for PyTorch reads as the given content."""

    def write(content, name="authors.pth"):
        def load(stream, *, map_location, weights_only):
            assert map_location == "cpu" and weights_only is True
            assert stream.read() == b"bytes"
            return content

        torch = types.SimpleNamespace(
            load=load, float32=np.float32, Tensor=Tensor, strided="strided"
        )
        monkeypatch.setitem(sys.modules, "torch", torch)
        (tmp_path / name).write_bytes(b"bytes")
        return tmp_path / name

    return write


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_pytorch_file_is_read_as_tensors_alone(torch_file, wrapped):
    state = authors.random_state_dict(2)
    tensors = {name: Tensor(value) for name, value in state.items()}

    path = torch_file({"state_dict": tensors, "epoch": 3} if wrapped else tensors)

    same(convert(path), from_state_dict(state))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ([1, 2], "holds a list, wanted a dict of tensors"),
        ({"state_dict": 3}, "holds a int, wanted a dict of tensors"),
        ({1: Tensor(np.zeros(1))}, "1 is the name of a tensor, wanted text"),
        ({"epoch": 3}, "'epoch' is no tensor"),
        ({"\x1b[2J" * 500: 3}, r"is no tensor"),
        ({}, "names of its tensors match none"),
        # of one number, as `expand` makes it: 12 GB
        ({"big": Tensor(np.broadcast_to(np.float32(0), (3 << 30,)))}, "holds 12,884,901,888 bytes"),
    ],
)
def test_a_pytorch_file_of_something_else_is_refused(torch_file, content, told):
    with pytest.raises(ValueError, match=told) as caught:
        convert(torch_file(content))
    assert len(str(caught.value)) <= 600 and "\x1b" not in str(caught.value)


def test_an_archive_that_unfolds_to_much_more_is_refused_before_it_is_unfolded(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", **{"weights_net.a": np.zeros(40 << 20, np.float32)})
    with pytest.raises(
        ValueError, match="bomb.npz .*holds 167,.* bytes of tensors, wanted at most"
    ):
        convert(tmp_path / "bomb.npz")


def test_more_iterations_than_can_be_traced_are_refused():
    state = {f"feat_extractor_xyz.nets_a.{i}.0.weight": np.zeros(1) for i in range(100_000)}
    with pytest.raises(ValueError, match="it has 100,000 iterations, wanted at most 100"):
        from_state_dict(state)


@pytest.mark.parametrize("state", [{1: np.zeros(3)}, {"a": [1.0]}, {None: np.zeros(3)}])
def test_a_state_that_is_no_dict_of_arrays_by_name_is_refused(state, unchecked):
    with pytest.raises(ValueError, match="wanted arrays under names that are text"):
        from_state_dict(state)


def test_of_many_faults_the_first_are_named_and_the_others_counted():
    state = authors.random_state_dict(0) | {f"extra_{i}": np.zeros(1) for i in range(5000)}
    with pytest.raises(ValueError, match=r"extra_0 is unknown; .*; and 4[0-9]+ more$") as caught:
        from_state_dict(state)
    assert len(str(caught.value)) <= 600


def test_without_torch_the_message_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    path = tmp_path / "authors.pth"
    path.write_bytes(b"bytes")

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

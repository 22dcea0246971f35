"""The checkpoints of DCP, FMR and RGM, of exactly the published names and shapes, as ours."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from oracle import peer_authors
from safetensors.numpy import save_file

from cfr_jax.cli import main
from cfr_jax.networks import table
from cfr_jax.weights.conversion import convert, from_state_dict
from cfr_jax.weights.files import network_of, read_weights

# What random state dict, of how many tensors; which network, and how it is made anew.
PUBLISHED = {
    "DCP v1": (functools.partial(peer_authors.random_dcp_state_dict, version=1), 31, "dcp",
               {"version": "v1"}),
    "DCP v2": (functools.partial(peer_authors.random_dcp_state_dict, version=2), 77, "dcp", {}),
    "FMR": (peer_authors.random_fmr_state_dict, 59, "fmr", {}),
    "RGM": (peer_authors.random_rgm_state_dict, 138, "rgm", {}),
}  # fmt: skip
NEEDLESS = ("num_batches_tracked", "head.reflect")


@pytest.mark.parametrize("title", PUBLISHED)
def test_every_number_of_a_published_checkpoint_finds_its_place(title):
    draw, count, name, given = PUBLISHED[title]
    state = draw(0)

    params = from_state_dict(state)

    assert len(state) == count
    assert network_of(params) == name
    wanted = jax.eval_shape(functools.partial(table.named(name).fresh, **given), jax.random.key(0))
    assert jax.tree.structure(params) == jax.tree.structure(wanted)
    assert jax.tree.map(np.shape, params) == jax.tree.map(np.shape, wanted)
    theirs = [value.ravel() for name, value in state.items() if not name.endswith(NEEDLESS)]
    ours = [np.ravel(leaf) for leaf in jax.tree.leaves(params)]
    # sums of all numbers and of their squares, each array by itself: none twice, none left out
    for power in (1, 2):
        sums = (
            sorted(float((leaf.astype(float) ** power).sum()) for leaf in of)
            for of in (theirs, ours)
        )
        np.testing.assert_allclose(*sums, rtol=1e-9)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_a_file_is_converted_by_the_command(tmp_path, suffix, capsys):
    # given
    state = peer_authors.random_dcp_state_dict(1, version=1)
    path, ours = tmp_path / f"theirs{suffix}", tmp_path / "ours.safetensors"
    state = {name: np.asarray(value) for name, value in state.items()}
    np.savez(path, **state) if suffix == ".npz" else save_file(state, path)

    # when
    code = main(["convert", str(path), "--out", str(ours)])

    # then
    assert code == 0 and "DCP" in capsys.readouterr().out
    held = read_weights(ours)
    assert held.network == "dcp" and "pointer" not in held.params
    weight = state["emb_nn.conv5.weight"][..., 0, 0]
    np.testing.assert_array_equal(held.params["embedding"]["point"]["dense"]["kernel"], weight.T)


def test_a_legacy_file_of_torch_is_read_as_tensors_alone(tmp_path):
    torch = pytest.importorskip("torch")
    state = peer_authors.random_dcp_state_dict(2, version=1)
    path = tmp_path / "dcp_v1.t7"
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
    torch.save(tensors, path, _use_new_zipfile_serialization=False)

    converted = convert(path)

    assert jax.tree.all(jax.tree.map(np.array_equal, converted, from_state_dict(state)))


@pytest.mark.parametrize("title", ["DCP v2", "FMR", "RGM"])
def test_names_are_checked_strictly(title):
    # given a tensor that is missing, one too many, and one of a wrong shape
    state = narrow(title)
    names = [name for name in state if name.endswith(".weight")]
    state[f"module.{names[0]}"] = state.pop(names[0])
    state[names[1]] = state[names[1]][:, :-1] if state[names[1]].ndim > 1 else state[names[1]][:-1]

    with pytest.raises(ValueError) as caught:
        from_state_dict(state, "theirs.pth")

    message = str(caught.value)
    assert message.startswith(f"theirs.pth does not hold {title.split()[0]}: ")
    assert f"{names[0]} is missing" in message and f"module.{names[0]} is unknown" in message
    assert f"{names[1]} has shape" in message and message.count(";") == 2


def narrow(title):
    if title == "FMR":
        return peer_authors.random_fmr_state_dict(0)
    of = {"DCP v2": peer_authors.random_dcp_state_dict, "RGM": peer_authors.random_rgm_state_dict}
    return of[title](0, width=32)

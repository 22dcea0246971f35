"""The table of networks: what is in it, and that one from outside is as good as those."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import training_samples

from cfr_jax.cli import main
from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry
from cfr_jax.evaluation.methods import methods_of
from cfr_jax.evaluation.running import run_method
from cfr_jax.evaluation.solvers.module_times import make_modules
from cfr_jax.geometry import rigid
from cfr_jax.networks import table
from cfr_jax.networks.inputs import moved_by
from cfr_jax.networks.layers import unit_rows
from cfr_jax.networks.record import Checkpoint, Network, Part, Step, places_of
from cfr_jax.networks.sinkhorn import Affinity, match
from cfr_jax.training import learner, loop
from cfr_jax.weights.files import load_params, network_of, read_weights, save_params

# --- a network from outside the package: one linear layer per iteration, fourteen numbers each ---


@dataclasses.dataclass(frozen=True)
class ToySettings:
    neighbors: int = 6
    radius: float = 0.5
    passes: int = 2


def fresh(key, iterations, shared=False):
    kernel = jax.random.normal(key, (1 if shared else iterations, 3, 4))
    beta, alpha = jnp.full(iterations, 2.0), jnp.full(iterations, 0.5)
    return {"toy": {"kernel": kernel, "beta": beta, "alpha": alpha}}


def unroll(params, source, target, settings):
    held, moved = params["toy"], source
    for i in range(iterations_of(params)):
        kernel = held["kernel"][min(i, len(held["kernel"]) - 1)]
        features = (unit_rows(cloud.points @ kernel) for cloud in (moved, target))
        affinity = Affinity(*features, held["beta"][i], held["alpha"][i])
        found = match(
            affinity,
            target.points,
            passes=settings.passes,
            source_mask=source.mask,
            target_mask=target.mask,
        )
        transform = rigid.fit_rigid(source.points, found.targets, found.weights)
        yield Step(transform, found, affinity)
        moved = moved_by(transform, source)


def recognizes(tensors):
    return "toy/kernel" in tensors


def arguments(shapes):
    return {"iterations": shapes["toy/beta"][0], "shared": shapes["toy/kernel"][0] == 1}


def trained(neighbors, iterations):
    return ToySettings(neighbors=neighbors)


def iterations_of(params):
    return len(params["toy"]["beta"])


def parts(params, settings):
    def of(source, target):
        yield Part("all of it", lambda a, b: list(unroll(params, a, b, settings)), (source, target))

    return of


def is_theirs(tensors):
    return any(name.startswith("linear.") for name in tensors)


def arguments_of_theirs(tensors):
    return {"iterations": len([name for name in tensors if name.startswith("linear.")])}


def places(tensors):
    count = arguments_of_theirs(tensors)["iterations"]
    rows = [(f"linear.{i}", "toy/kernel", None) for i in range(count)]
    rows += [(f"sharpness.{i}", "toy/beta", "toy/alpha") for i in range(count)]
    return places_of(rows, stacked=True)


TOY = Network(
    name="toy",
    title="Toy",
    settings=ToySettings,
    fresh=fresh,
    unroll=unroll,
    recognizes=recognizes,
    arguments=arguments,
    trained=trained,
    validated=ToySettings(),
    iterations=iterations_of,
    variants=("shared",),
    changeable=("passes",),
    parts=parts,
    checkpoint=Checkpoint(is_theirs, arguments_of_theirs, places),
)


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setattr(table, "_registered", {})
    table.add(TOY)
    return TOY


def a_pair():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(30, 3))
    truth = np.eye(4)
    truth[:3, 3] = [0.1, 0.0, -0.1]
    return Pair("a", source, source + truth[:3, 3], transform=truth)


# --- the table ---


def test_every_network_is_found_by_its_name_and_says_what_it_is():
    for name in table.names():
        record = table.named(name)
        assert record.name == name and record.title
        assert isinstance(record.validated, record.settings)
        assert {field.name for field in dataclasses.fields(record.settings)} >= {
            *record.changeable, "neighbors", "radius",
        }  # fmt: skip


@pytest.mark.parametrize("name", ["cfr", "rpmnet"])
def test_what_a_network_makes_it_recognizes_and_describes(name):
    record = table.named(name)
    made = jax.eval_shape(lambda: record.fresh(jax.random.key(0), iterations=3))
    shapes = {
        "/".join(str(part.key) for part in path): leaf.shape
        for path, leaf in jax.tree_util.tree_leaves_with_path(made)
    }

    assert table.recognize(shapes) is record
    again = jax.eval_shape(lambda: record.fresh(jax.random.key(1), **record.arguments(shapes)))
    assert jax.tree.map(jnp.shape, again) == jax.tree.map(jnp.shape, made)
    if record.iterations is not None:
        assert record.iterations(made) == 3


def test_an_unknown_name_and_unknown_tensors_are_told_with_what_there_is(toy):
    with pytest.raises(ValueError, match="got 'prnet', wanted one of 'cfr', 'rpmnet', .*'toy'"):
        table.named("prnet")
    titles = ", ".join(table.named(name).title for name in table.names())
    assert titles.startswith("CFR, ") and titles.endswith(", Toy")
    with pytest.raises(ValueError, match=rf"no known network \({titles}\) has .*: a, b"):
        table.recognize({"b": 1, "a": 2})


def test_what_is_no_record_is_refused(unchecked):
    with pytest.raises(ValueError, match="^record: got None, wanted a Network"):
        table.add(None)


def test_a_name_that_is_taken_stays_what_it_was(toy):
    table.add(TOY)  # the same once more is fine
    for taken in ("cfr", "toy"):
        with pytest.raises(ValueError, match=f"the name '{taken}' is taken"):
            table.add(dataclasses.replace(TOY, name=taken, title="Another"))


@pytest.mark.parametrize("field", ["unroll", "fresh", "recognizes", "parts"])
def test_a_record_refuses_functions_that_no_other_process_finds(field):
    with pytest.raises(ValueError, match=f"^{field}: network toy got .*<lambda>, wanted a func"):
        dataclasses.replace(TOY, **{field: lambda *_: []})


# --- a network from outside, wherever networks are used ---


@pytest.fixture
def run(toy, tmp_path):
    """A training of the toy by its config, and the weights that came out."""
    corpus = training_samples.write_corpus(tmp_path / "corpus.h5")
    config = training_samples.config(corpus)
    config.network, config.iterations, config.settings = "toy", 2, {"passes": 3}
    with jax.numpy_dtype_promotion("standard"):  # optax mixes
        best = loop.run(config, tmp_path / "run")
    return best, tmp_path / "run" / "weights.safetensors"


def test_it_is_trained_by_its_config_and_its_weights_are_recognized(run):
    best, path = run

    weights = read_weights(path)

    assert len(best["rotation_by_iteration"]) == 2
    assert weights.network == "toy" and network_of(weights.params) == "toy"
    assert weights.params["toy"]["kernel"].shape == (2, 3, 4)
    start = fresh(jax.random.key(0), 2)["toy"]["kernel"]
    assert np.abs(weights.params["toy"]["kernel"] - start).max() > 0  # it learned something
    with pytest.raises(ValueError, match="holds the network Toy, wanted CFR"):
        load_params(path)


def test_a_config_may_choose_its_variants_and_change_its_settings(toy):
    config = training_samples.config("nowhere.h5")
    config.network, config.iterations, config.shared = "toy", 3, True
    config.settings = {"passes": 4}

    chosen = learner.learner(config)

    assert chosen.fresh(jax.random.key(0))["toy"]["kernel"].shape == (1, 3, 4)
    assert chosen.trained(7) == ToySettings(neighbors=7, passes=4)
    assert chosen.validated == ToySettings(passes=4)
    config.settings = {"radius": 0.1}
    with pytest.raises(ValueError, match="settings: got radius, wanted some of passes for toy"):
        learner.learner(config)


def test_it_is_compared_by_a_config_in_a_process_of_its_own(toy, tmp_path):
    # given
    save_params(tmp_path / "toy.safetensors", fresh(jax.random.key(0), 2))
    options = {"refine": False, "settings": {"passes": 3}}
    own = str(tmp_path / "toy.safetensors")
    entries = {
        "mine": MethodEntry("toy", options, weights=own, modules=True, threads=1),
        "bare": MethodEntry("toy", options),
    }
    config = EvaluationConfig("Toys", {}, entries)

    # when
    (method,) = methods_of(config, ["mine"], seed=0)
    held = run_method(method, [a_pair()], tmp_path / "part.json", timeout=60.0)

    # then
    assert held.by_pair[0].failure is None
    assert np.shape(held.by_pair[0].transforms) == (2, 4, 4)
    assert held.modules["all of it"] > 0
    with pytest.raises(ValueError, match="methods.bare.weights: got none, wanted weights of Toy"):
        methods_of(config, ["bare"], seed=0)


def test_without_parts_its_modules_cannot_be_timed(toy, tmp_path):
    bare = dataclasses.replace(TOY, parts=None)
    with pytest.raises(ValueError, match="modules: the record of Toy names no parts to time"):
        make_modules(bare, "nowhere.safetensors", None, False)


def test_the_checkpoints_of_its_authors_are_converted_by_the_command(toy, tmp_path, capsys):
    # given
    rng = np.random.default_rng(0)
    theirs = {f"linear.{i}.weight": rng.normal(size=(4, 3)).astype(np.float32) for i in range(3)}
    theirs |= {f"sharpness.{i}.weight": np.float32(i) for i in range(3)}
    theirs |= {f"sharpness.{i}.bias": np.float32(0.5) for i in range(3)}
    np.savez(tmp_path / "theirs.npz", **theirs)
    ours = tmp_path / "ours.safetensors"

    # when
    code = main(["convert", str(tmp_path / "theirs.npz"), "--out", str(ours)])

    # then
    assert code == 0 and "Toy, 3 iterations" in capsys.readouterr().out
    held = read_weights(ours).params["toy"]
    np.testing.assert_array_equal(held["kernel"][1], theirs["linear.1.weight"].T)
    np.testing.assert_array_equal(held["beta"], [0, 1, 2])

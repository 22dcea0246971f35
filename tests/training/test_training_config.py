"""The config of a training: set by files and flags, checked as a whole."""

import dataclasses
import runpy
from pathlib import Path

import jax
import pytest
import training_samples as samples
from absl import flags
from ml_collections import ConfigDict, config_flags
from training_samples import config

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.training import loop
from cfr_jax.training.config import (
    DataSection,
    Phase,
    SamplingSection,
    TrainingConfig,
    TrainSection,
    checked,
)
from cfr_jax.training.task import prepare

CONFIGS = Path(__file__).parents[2] / "configs"
# ml_collections loads config files in a way that Python is about to drop
pytestmark = pytest.mark.filterwarnings("ignore:the load_module:DeprecationWarning")
SECTIONS = DataSection(), Phase(1, 2, 1, 1), SamplingSection(), TrainSection()


@pytest.fixture(scope="module")
def corpus_file(tmp_path_factory):
    return samples.write_corpus(tmp_path_factory.mktemp("corpus") / "ellipsoids.h5")


def from_command(file, *arguments):
    """The config that `train.py` would get."""
    command = ["train.py", f"--config={CONFIGS / file}", *arguments]
    values = flags.FlagValues()
    held = config_flags.DEFINE_config_file("config", flag_values=values, sys_argv=command)
    values(command)
    return checked(held.value)


def test_without_flags_a_config_is_what_its_file_says():
    assert from_command("open_cad.py") == TrainingConfig()


def test_fields_of_every_section_can_be_set_by_flags():
    found = from_command(
        "open_cad.py", "--config.train.peak_rate=3e-4", "--config.data.train=parts/train.h5",
        "--config.phases[0].steps=500", "--config.sampling.keep=(0.5, 0.9)", "--config.seed=3",
        "--config.shared", "--config.train.start_from=",
    )  # fmt: skip

    wanted = TrainingConfig(
        seed=3,
        shared=True,
        data=DataSection(train="parts/train.h5"),
        sampling=SamplingSection(keep=(0.5, 0.9)),
        train=TrainSection(peak_rate=3e-4),
    )
    wanted.phases[0].steps = 500
    assert found == wanted


def test_flags_replace_the_phases_and_the_sources_as_a_whole(unchecked):
    found = from_command(
        "own_scans.py", "--config.data.validation=val.h5",
        """--config.data.train={"a": {"kind": "clouds", "path": "b"}}""",
        """--config.phases=({"steps": 5, "points": 512, "neighbors": 32, "batch": 8},)""",
    )  # fmt: skip

    assert found.data.train == {"a": {"kind": "clouds", "path": "b"}}
    assert found.data.validation == "val.h5"
    assert found.phases == (Phase(steps=5, points=512, neighbors=32, batch=8),)


def test_flags_set_the_fields_of_a_source_by_its_name():
    found = from_command(
        "own_scans.py", "--config.data.train.scans.path=mine", "--config.data.train.pairs.repeat=2"
    )

    assert found.data.train["scans"] == {"kind": "clouds", "path": "mine", "repeat": 1}
    assert found.data.train["pairs"]["repeat"] == 2
    assert found.data.validation["scans"]["path"] == ""


@pytest.mark.parametrize("path", sorted(set(CONFIGS.glob("*.py")) - set(CONFIGS.glob("eval_*"))),
                         ids=lambda path: path.stem)  # fmt: skip
def test_every_config_of_a_training_can_be_used(path):
    made = runpy.run_path(str(path))["get_config"]()

    assert checked(made) == made


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"network": "prnet"}, "network: got 'prnet'"),
        ({"train.optimizer": "adagrad"}, "optimizer: got 'adagrad'"),
        ({"train.schedule": "step"}, "schedule: got 'step'"),
        ({"train.precision": "float16"}, "precision: got 'float16'"),
        ({"train.pairs_at_once": 0}, "pairs_at_once: got 0"),
        ({"train.workers": 0}, "workers: got 0"),
        ({"train.max_skipped": -1}, "max_skipped: got -1"),
        ({"log_every": 0}, "log_every: got 0"),
        ({"validation_pairs": 0}, "validation_pairs: got 0"),
        ({"settings": {"neighbors": 5}}, "settings: got neighbors, wanted some of .*radius"),
        ({"seed": "0"}, "seed: got '0', wanted a whole number"),
        ({"sampling.scale": [0.8, 1.2]}, "sampling.scale: got .*, wanted a tuple"),
        ({"phases": ()}, "schedule: got 0 steps"),
        (
            {"phases": ({"steps": 1, "points": 9, "neighbors": 9, "batch": 2},)},
            "neighbors: got 9, wanted .* fewer than the 9 points",
        ),
        ({"data.validation": 3}, "data.validation: got 3, wanted a path, or sources by name"),
        ({"train": {"peek_rate": 1.0}}, "train: .*'peek_rate'"),
        ({"train": 3}, "train: got 3, wanted TrainSection or a dict of its fields"),
        ({"network": "rpmnet", "settings": {"radius": 0.2}}, "settings: got radius, wanted none"),
        ({"keep_checkpoints": 0}, "keep_checkpoints: got 0"),
        ({"data.train": "nowhere.h5"}, "nowhere.h5"),
        ({"sampling.keep": (0.0, 2.0)}, "keep"),
        ({"sampling.keep": (0.5, 0.3)}, "keep: got .*the lower one first"),
        ({"sampling.angle": -5.0}, "angle, translation: got -5.0"),
    ],
)
def test_what_a_config_has_wrong_is_named(corpus_file, tmp_path, unchecked, change, wanted):
    given = config(corpus_file)
    for name, value in change.items():
        section, _, field = name.rpartition(".")
        setattr(getattr(given, section) if section else given, field, value)

    with pytest.raises(ValueError, match=wanted), jax.numpy_dtype_promotion("standard"):
        loop.run(given, tmp_path)


@pytest.mark.parametrize("section", [TrainingConfig(), *SECTIONS])
def test_a_field_that_there_is_not_cannot_be_set(section):
    with pytest.raises(AttributeError, match="has no attribute 'peek_rate'"):
        section.peek_rate = 1.0


def test_what_is_no_config_of_a_training_is_refused(tmp_path, unchecked):
    with pytest.raises(ValueError, match="config: got ConfigDict, wanted TrainingConfig"):
        prepare(ConfigDict({"seed": 0}), tmp_path)


def test_a_config_that_is_checked_stays_as_it_is_when_the_first_one_changes():
    given = TrainingConfig()

    whole = checked(given)
    given.train.peak_rate, given.phases[0].steps = 1.0, 7

    assert whole == TrainingConfig()


def test_the_config_samples_all_that_there_is_to_sample_but_what_a_phase_says():
    known = {field.name for field in dataclasses.fields(Sampling)}

    assert {field.name for field in dataclasses.fields(SamplingSection)} == known - {
        "points", "neighbors", "radius"
    }  # fmt: skip


def test_a_phase_may_be_sampled_in_its_own_way(corpus_file, tmp_path):
    given = config(corpus_file)
    given.phases[1].sampling = {"estimated_normals": 1.0}

    first, second = prepare(given, tmp_path).samplings

    assert (first.estimated_normals, second.estimated_normals) == (0.5, 1.0)
    assert first.keep == second.keep == (0.7, 0.7)
    assert first.radius == 0.3


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"sampling": {"estimated": 1.0}}, "phases: sampling: got estimated, wanted some of keep"),
        ({"sampling": {"radius": 0.2}}, "phases: sampling: got radius, wanted some of keep"),
        ({"sampling": {"near": 2.0}}, "near: got 2.0, wanted a share"),
        ({"step": 3}, "phases: .*'step'"),
        ({"steps": -1}, "phases: got -1 steps"),
        ({"points": 24.5}, "phases: points: got 24.5, wanted a whole number"),
    ],
)
def test_what_a_phase_has_wrong_is_named(corpus_file, tmp_path, unchecked, change, wanted):
    given = config(corpus_file)
    given.phases = (dataclasses.asdict(given.phases[0]) | change,)

    with pytest.raises(ValueError, match=wanted):
        prepare(given, tmp_path)

"""A whole training: it resumes bit for bit, leaves what it measured, and says why it stops."""

import copy
import json
import os
import signal

import jax
import numpy as np
import pytest
import training_samples as samples
from training_samples import assert_same, config

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.training import (
    devices,
    identity,
    learner,
    loop,
    optimizers,
    step,
    stopping,
    validation,
)
from cfr_jax.training.checkpoints import Checkpoints, SaveError
from cfr_jax.training.config import Phase
from cfr_jax.training.reporting.board import Board
from cfr_jax.training.reporting.reporter import Reporter
from cfr_jax.training.stopping import Stopped
from cfr_jax.training.task import fresh_params, prepare
from cfr_jax.weights.files import load_params, read_weights


@pytest.fixture(scope="module")
def corpus_file(tmp_path_factory):
    return samples.write_corpus(tmp_path_factory.mktemp("corpus") / "ellipsoids.h5")


class Killed(Exception):
    """Stands for the power going off."""


def run(given, folder):
    with pytest.MonkeyPatch.context() as patch, jax.numpy_dtype_promotion("standard"):
        patch.setattr(validation, "validate", samples.cheap_validation)
        # the same optimizer compiles once
        patch.setattr(optimizers, "make_optimizer", lambda *_, **__: samples.optimizer())
        return loop.run(given, folder)


@pytest.fixture(scope="module")
def whole(corpus_file, tmp_path_factory):
    """A run that nothing disturbed: its folder and its best validation."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(config(corpus_file), folder)


def state_of(workdir):
    with Checkpoints(workdir / "checkpoints", keep=2) as checkpoints:
        return checkpoints.restore(samples.fresh())[0]


def measured_by(workdir):
    """The lines of the metrics, without what depends on the time of day and the machine."""
    timed = ("time", "steps_per_second", "training_seconds", "processor_seconds")
    return [{k: v for k, v in line.items() if k not in timed} for line in lines_of(workdir)]


def lines_of(workdir):
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.fixture
def killed_in_step(monkeypatch):
    """Lets the training stop dead in the step with this number; lists the steps begun."""

    def arrange(number, error=Killed):
        begun, train_step = [], step.train_step

        def killed(*arguments, **named):
            begun.append(None)
            if len(begun) == number:
                raise error
            return train_step(*arguments, **named)

        monkeypatch.setattr(step, "train_step", killed)
        return begun

    return arrange


@pytest.fixture
def killed_config(killed_in_step, corpus_file, tmp_path):
    """Kills a run in `tmp_path` in the step with this number; its config, to go on with."""

    def arrange(number):
        killed_in_step(number)
        with pytest.raises(Killed):
            run(config(corpus_file), tmp_path)
        return config(corpus_file)

    return arrange


def test_an_interrupted_run_resumes_bit_for_bit(corpus_file, tmp_path, whole, killed_in_step):
    begun = killed_in_step(11)
    with pytest.raises(Killed):
        run(config(corpus_file), tmp_path)
    best = run(config(corpus_file), tmp_path)

    assert len(begun) == 11 + 8  # it went on after the checkpoint of step 8
    assert best == whole[1]
    first, second = (state_of(folder) for folder in (whole[0], tmp_path))
    assert int(first.step) == 16
    assert_same(first, second)
    files = (folder / "weights.safetensors" for folder in (whole[0], tmp_path))
    assert_same(*(load_params(file) for file in files))
    for one, other in zip(lines_of(whole[0]), lines_of(tmp_path), strict=True):
        assert one["step"] == other["step"]
        assert one.get("loss") == other.get("loss")


def test_the_weights_are_those_that_the_newest_checkpoint_calls_best(
    corpus_file, tmp_path, whole, monkeypatch
):
    def killed(*_, **__):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(loop, "save_params", killed)
        with pytest.raises(Killed):
            run(config(corpus_file), tmp_path)
    assert not (tmp_path / "weights.safetensors").exists()
    assert int(state_of(tmp_path).step) == 4  # the checkpoint came first

    given = config(corpus_file)
    given.phases = (Phase(steps=4, points=24, neighbors=6, batch=2),)
    best = run(given, tmp_path)  # nothing is left to do but this

    assert best["step"] == 4
    made = load_params(tmp_path / "weights.safetensors")
    assert_same(made, state_of(tmp_path).average)


def test_seconds_add_up_over_restarts(corpus_file, tmp_path, killed_in_step):
    killed_in_step(11)
    with pytest.raises(Killed):
        run(config(corpus_file), tmp_path)
    before = [line["training_seconds"] for line in lines_of(tmp_path) if "loss" in line]
    run(config(corpus_file), tmp_path)

    after = [line for line in lines_of(tmp_path) if "loss" in line]
    seconds = [line["training_seconds"] for line in after]
    assert seconds[:2] == before[:2] and len(seconds) == 4
    assert all(a < b for a, b in zip(seconds, seconds[1:], strict=False))
    spent = [line["processor_seconds"] for line in after]
    assert all(a < b for a, b in zip(spent, spent[1:], strict=False))


def test_a_finished_run_has_nothing_left_to_do(corpus_file, whole, monkeypatch):
    monkeypatch.delattr(step, "train_step")

    assert run(config(corpus_file), whole[0]) == whole[1]


def test_a_run_leaves_its_measurements_its_weights_and_a_page(whole):
    folder, best = whole

    lines = lines_of(folder)
    assert [line["step"] for line in lines if "loss" in line] == [4, 8, 12, 16]
    assert all(np.isfinite(line["loss"]) for line in lines if "loss" in line)
    measured = {line["step"]: line["validation"] for line in lines if "validation" in line}
    assert list(measured) == [4, 8, 12, 16]
    assert best["rotation_mean"] == min(found["rotation_mean"] for found in measured.values())
    made = read_weights(folder / "weights.safetensors")
    assert json.loads(made.notes["validation"]) == best
    assert json.loads(made.notes["config"])["validate_every"] == 4
    page = (folder / "summary.html").read_text()
    assert f"step {best['step']}" in page and "http" not in page and page.count("<svg") == 8


def test_weights_are_stored_in_float16_if_the_config_says_so(corpus_file, tmp_path, whole):
    # given
    given = config(corpus_file)
    given.float16 = True

    # when
    run(given, tmp_path)

    # then they are those of the same run in float32, rounded
    small, large = (folder / "weights.safetensors" for folder in (tmp_path, whole[0]))
    assert small.stat().st_size < 0.6 * large.stat().st_size
    for a, b in zip(jax.tree.leaves(load_params(small)), jax.tree.leaves(load_params(large)),
                    strict=True):  # fmt: skip
        np.testing.assert_allclose(a, b, rtol=2**-10, atol=2**-25)


def test_a_checkpoint_says_all_that_a_run_needs(whole):
    newest = max((whole[0] / "checkpoints").iterdir(), key=lambda path: int(path.name))

    about = json.loads((newest / "about.json").read_text())

    assert about["step"] == 16 and about["position"] == 32 and about["best"] == whole[1]
    assert about["config"]["train"]["optimizer"] == "adamw"
    assert about["versions"]["jax"] == jax.__version__
    assert about["random_key"] == jax.random.key_data(jax.random.key(0)).tolist()
    assert about["clock"]["seconds"] > 0 and about["clock"]["processor_seconds"] > 0


def test_another_config_goes_on_with_a_word(killed_config, tmp_path, capsys):
    changed = killed_config(6)
    changed.keep_checkpoints = 3
    capsys.readouterr()

    run(changed, tmp_path)

    told = capsys.readouterr().out
    assert "resuming at step 4" in told and "keep_checkpoints 2 → 3" in told
    assert int(state_of(tmp_path).step) == 16


def test_a_run_from_before_phases_had_samplings_goes_on_without_a_word(corpus_file, tmp_path):
    stamps = {"data.train": "a", "data.validation": "b"}
    now = identity.begin(config(corpus_file), stamps)
    before = copy.deepcopy(now) | {"step": 4}
    for phase in before["config"]["phases"]:
        assert phase.pop("sampling") == {}

    told = identity.go_on(before, now, 16, tmp_path)

    assert told == ["resuming at step 4"] and now["step"] == 4


def test_a_workdir_of_other_training_data_is_refused(tmp_path, whole):
    other = config(samples.write_corpus(tmp_path / "other.h5", shapes=5))

    with pytest.raises(ValueError, match="other data.train .*4 shapes.*5 shapes.*start_from="):
        run(other, whole[0])


def test_other_validation_pairs_forget_what_was_best(killed_config, tmp_path, capsys):
    changed = killed_config(6)
    changed.validation_pairs = 3

    best = run(changed, tmp_path)

    assert "best so far is forgotten" in capsys.readouterr().out
    assert best["step"] >= 8


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_asked_to_stop_it_saves_and_goes_on_to_the_same_end(
    corpus_file, tmp_path, whole, monkeypatch, number
):
    train_step = step.train_step

    def asked_in_step_6(state, batch, **named):
        if int(state.step) == 5:
            os.kill(os.getpid(), number)
        return train_step(state, batch, **named)

    before = signal.getsignal(number)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step, "train_step", asked_in_step_6)
        with pytest.raises(Stopped, match="stopped at step 6 of 16, all saved") as stopped:
            run(config(corpus_file), tmp_path)
    assert stopped.value.signal == number and signal.getsignal(number) == before
    assert int(state_of(tmp_path).step) == 6
    assert (tmp_path / "summary.html").is_file()

    assert run(config(corpus_file), tmp_path) == whole[1]
    assert_same(state_of(tmp_path), state_of(whole[0]))
    assert measured_by(tmp_path) == measured_by(whole[0])


@pytest.mark.parametrize("stopped_after", [3, 5])
def test_the_metrics_after_a_stop_are_those_of_a_run_that_went_on(
    corpus_file, tmp_path, whole, monkeypatch, stopped_after
):
    # given a stop between two lines of the metrics, or at one
    train_step = step.train_step

    def asked(state, batch, **named):
        if int(state.step) == stopped_after - 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return train_step(state, batch, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step, "train_step", asked)
        with pytest.raises(Stopped, match=f"stopped at step {stopped_after} of 16"):
            run(config(corpus_file), tmp_path)

    # when
    run(config(corpus_file), tmp_path)

    # then
    assert measured_by(tmp_path) == measured_by(whole[0])
    assert all(
        np.isfinite(line["steps_per_second"]) for line in lines_of(tmp_path) if "loss" in line
    )


def test_weights_to_start_from_are_measured_first_and_kept_if_no_better_come(
    corpus_file, tmp_path, whole, monkeypatch
):
    begun = whole[0] / "weights.safetensors"
    given = config(corpus_file)
    given.train.start_from = str(begun)
    found = samples.cheap_validation

    def worse_every_time(chosen, params, *others):
        same = np.array_equal(
            params["features"]["kernel_1"], load_params(begun)["features"]["kernel_1"]
        )
        return found(chosen, params, *others) | {"rotation_mean": 1.0 + (not same)}

    monkeypatch.setattr(samples, "cheap_validation", worse_every_time)
    best = run(given, tmp_path)

    assert best["step"] == 0 and best["rotation_mean"] == 1.0
    assert [line["step"] for line in lines_of(tmp_path) if "validation" in line][0] == 0
    assert_same(load_params(tmp_path / "weights.safetensors"), load_params(begun))


def test_gradients_that_stay_infinite_stop_the_run(corpus_file, tmp_path, monkeypatch):
    train_step = step.train_step

    def broken_after_four(state, batch, **named):
        if int(state.step) >= 4:
            batch = batch | {"source": batch["source"] * np.float32("nan")}
        return train_step(state, batch, **named)

    monkeypatch.setattr(step, "train_step", broken_after_four)
    with pytest.raises(
        stopping.Diverged, match="by step 8, more than .*max_skipped = 3 steps in a row.*not finite"
    ):
        run(config(corpus_file), tmp_path)

    assert int(state_of(tmp_path).step) == 4
    text = (tmp_path / "metrics.jsonl").read_text()
    last = [json.loads(line, parse_constant=pytest.fail) for line in text.splitlines()][-1]
    assert last["step"] == 8 and last["skipped"] == 4 and "loss" not in last


def test_too_many_infinite_gradients_between_two_looks_stop_it_as_well(
    corpus_file, tmp_path, monkeypatch
):
    train_step = step.train_step

    def broken_for_four(state, batch, **named):
        if 4 <= int(state.step) < 8:
            batch = batch | {"source": batch["source"] * np.float32("nan")}
        return train_step(state, batch, **named)

    monkeypatch.setattr(step, "train_step", broken_for_four)
    given = config(corpus_file)
    given.log_every = given.checkpoint_every = given.validate_every = 100
    with pytest.raises(stopping.Diverged, match="by step 16, more than train.max_skipped = 3"):
        run(given, tmp_path)

    assert not list((tmp_path / "checkpoints").glob("[0-9]*"))


def test_answers_that_are_no_numbers_are_no_validation(monkeypatch):
    found = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1, 1))
    found[1, 0, 0, 3] = np.nan
    monkeypatch.setattr(step, "predict", lambda *_, **__: jax.numpy.asarray(found))
    chosen = learner.learner(config("nowhere.h5"))

    with pytest.raises(stopping.Diverged, match="answers of the weights to 1 of 3 validation"):
        validation.validate(chosen, {}, {}, found[:, 0], devices.make_mesh())


def test_the_last_steps_are_told_though_they_are_fewer(corpus_file, tmp_path):
    given = config(corpus_file)
    given.log_every = 5

    run(given, tmp_path)

    assert [line["step"] for line in lines_of(tmp_path) if "loss" in line] == [5, 10, 15, 16]


def test_a_finished_run_stays_as_it_is_whatever_the_command_says_now(corpus_file, whole):
    file = whole[0] / "weights.safetensors"
    before = file.read_bytes()
    changed = config(corpus_file)
    changed.validation_pairs, changed.train.peak_rate = 3, 1e-4

    assert run(changed, whole[0]) == whole[1]

    assert file.read_bytes() == before


def test_a_run_cut_short_before_its_first_validation_is_validated(
    corpus_file, tmp_path, killed_in_step
):
    given = config(corpus_file)
    given.validate_every = 100
    killed_in_step(6)
    with pytest.raises(Killed):
        run(given, tmp_path)
    given.phases = (Phase(steps=4, points=24, neighbors=6, batch=2),)

    best = run(given, tmp_path)

    made = read_weights(tmp_path / "weights.safetensors")
    assert best["step"] == 4 and json.loads(made.notes["validation"]) == best


def test_asked_to_stop_while_it_logs_it_saves_before_it_stops(corpus_file, tmp_path, monkeypatch):
    measured = Reporter.measured

    def asked(self, done, skipped):
        measured(self, done, skipped)
        if done == 5:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Reporter, "measured", asked)
    given = config(corpus_file)
    given.log_every, given.checkpoint_every, given.validate_every = 5, 100, 100

    with pytest.raises(Stopped, match="all saved"):
        run(given, tmp_path)

    assert int(state_of(tmp_path).step) == 6


def test_weights_to_start_from_have_the_iterations_that_are_asked_for(corpus_file, whole):
    given = config(corpus_file)
    given.train.start_from, given.iterations = str(whole[0] / "weights.safetensors"), 2

    with pytest.raises(ValueError, match="start_from: .*was not made with .*iterations = 2"):
        fresh_params(given, learner.learner(given))


def test_the_calibration_of_weights_to_start_from_stays_behind(corpus_file):
    given = config(corpus_file)
    given.train.start_from, given.iterations = "object", 5

    params = fresh_params(given, learner.learner(given))

    assert params.keys() == {"annealing", "cascade", "features"}


def test_a_full_disk_stops_the_run_and_loses_nothing(corpus_file, tmp_path, monkeypatch, whole):
    given, finish = config(corpus_file), Checkpoints._finish

    def full_after_step_8(self, number, *rest):
        if number > 8:
            monkeypatch.setattr("cfr_jax.runtime.manifest.write", no_space)
        finish(self, number, *rest)

    def no_space(folder):
        raise OSError(28, "No space left on device", str(folder))

    def closed_in_vain(self):
        close(self)
        raise OSError("an error that comes later and must not hide the first")

    close = Board.close
    monkeypatch.setattr(Board, "close", closed_in_vain)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoints, "_finish", full_after_step_8)
        with pytest.raises(SaveError, match="step 12 .*\n?.*last good one is at step 8") as stopped:
            run(given, tmp_path)
    assert "No space left" in str(stopped.value) and "same command" in str(stopped.value)
    monkeypatch.undo()

    assert run(given, tmp_path) == whole[1]
    assert_same(state_of(tmp_path), state_of(whole[0]))


def test_neighbors_are_trained_on_within_the_radius_that_is_validated(corpus_file, tmp_path):
    given = config(corpus_file)
    given.settings = {"radius": 0.2}

    task = prepare(given, tmp_path)

    assert [sampling.radius for sampling in task.samplings] == [0.2, 0.2]
    assert task.learner.validated.radius == 0.2


def test_validation_measures_the_last_transform(corpus_file, monkeypatch):
    from cfr_jax.data import mixture

    held_out = mixture.open_mixture(str(corpus_file), corpus_file.parent, "data.validation")
    pairs = mixture.fixed_pairs(held_out, 3, Sampling(points=24, neighbors=6), 64, 0.3)
    assert pairs["source"].shape == (3, 717, 3)
    assert pairs["source_neighbors"].shape == (3, 717, 64)
    off = np.array(pairs["transform"], np.float32)[:, None].repeat(2, axis=1)
    off[:, 0, 0, 3] += 5
    off[0, 1, 0, 3] += 0.5
    monkeypatch.setattr(step, "predict", lambda *_, **__: jax.numpy.asarray(off))
    mesh = devices.make_mesh()
    chosen = learner.learner(config(corpus_file))

    found = validation.validate(chosen, {}, {}, pairs["transform"], mesh)

    np.testing.assert_allclose(found["translation_mean"], 0.5 / 3, rtol=1e-4)
    np.testing.assert_allclose(found["recall_5deg_0.1"], 2 / 3)
    assert found["rotation_mean"] < 0.1 and len(found["rotation_by_iteration"]) == 2


@pytest.mark.parametrize(
    ("done", "left"),
    [(0, [(3, 0), (5, 0)]), (2, [(3, 2), (5, 0)]), (3, [(5, 0)]), (7, [(5, 4)]), (8, [])],
)
def test_the_curriculum_goes_on_within_its_phases(done, left):
    phases = [Phase(3, 24, 6, 4), Phase(5, 24, 6, 2)]

    assert [(phase.steps, ran) for phase, ran in learner.remaining(phases, done)] == left

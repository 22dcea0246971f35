"""What a training says: clock, journal, TensorBoard, and the page at the end."""

import json
import resource
import subprocess
import sys
import time

import numpy as np
import pytest

from cfr_jax.training.losses import PairLoss
from cfr_jax.training.reporting import board, charts, log
from cfr_jax.training.reporting.summary import write_summary
from cfr_jax.viewer.scene import Scene

L = 2
VALIDATION = {
    "rotation_mean": 3.0, "rotation_median": 1.0, "translation_mean": 0.1, "recall_5deg_0.1": 0.5,
    "rotation_by_iteration": [2.0, 1.0],
}  # fmt: skip


def measured(value):
    """The losses of a step of three pairs."""
    row, each = np.full(3, value, np.float32), np.full((3, L), value, np.float32)
    return PairLoss(row, row, row, each, each, 2 * each, 3 * each)


def line(step):
    return {
        "step": step, **log.summarize([measured(1.0), measured(step)]), "learning_rate": 1e-3,
        "steps_per_second": 2.0, "skipped": 0,
    }  # fmt: skip


def test_means_are_over_pairs_and_steps():
    found = log.summarize([measured(1.0), measured(2.0)])

    assert found["loss"] == found["pose"] == 1.5
    assert found["rotation_error"] == [1.5] * L
    assert found["beta"] == [3.0] * L and found["alpha"] == [4.5] * L


def test_a_pair_that_is_not_finite_is_left_out_of_the_means():
    spoiled = measured(2.0)
    spoiled.total[1] = np.nan

    found = log.summarize([measured(1.0), spoiled])

    assert found["loss"] == found["rotation_error"][0] == pytest.approx((3 * 1.0 + 2 * 2.0) / 5)
    assert log.summarize([measured(np.inf)]) == {}


def test_the_clock_stands_still_between_stop_and_start_and_goes_on_from_before():
    clock = log.Clock(100.0, 200.0)
    clock.start()
    time.sleep(0.05)
    clock.stop()
    first = clock.read()
    time.sleep(0.1)

    assert clock.read() == first and 100.05 <= first["seconds"] < 100.1
    assert first["processor_seconds"] >= 200.0
    clock.start()
    clock.start()  # twice is once
    time.sleep(0.05)
    assert clock.read()["seconds"] >= first["seconds"] + 0.05


def test_a_journal_forgets_what_comes_after_the_step_it_goes_on_from(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n{"step": 4, "lo')

    journal = log.MetricsLog(path, 2)
    journal.write({"step": 3, "again": True})

    assert log.read_journal(path) == [{"step": 1}, {"step": 2}, {"step": 3, "again": True}]


def test_a_journal_that_begins_anew_forgets_all(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 0}\n{"step": 50}\n')  # killed before the first checkpoint

    log.MetricsLog(path, 0)

    assert log.read_journal(path) == []


@pytest.fixture(scope="module")
def about():
    return {
        "best": {"step": 4, "rotation_mean": 3.25, "rotation_median": 1.5,
                 "translation_mean": 0.04, "recall_5deg_0.1": 0.75},
        "step": 6, "skipped": 1, "position": 48, "clock": {"seconds": 7200, "processor_seconds": 1},
        "data": {"data.train": "30 shapes, ab12", "data.validation": "3 shapes, cd34"},
        "versions": {"jax": "1.2.3"}, "config": {"seed": "<b>0</b>"},
    }  # fmt: skip


def test_the_page_draws_every_curve_and_needs_nothing_from_elsewhere(tmp_path, about):
    lines = [line(2), {"step": 4, "validation": about["best"]}, line(4), line(6)]

    write_summary(tmp_path / "summary.html", lines, about)

    page = (tmp_path / "summary.html").read_text()
    assert page.count("<polyline") == 3 + 3 + 2 + 1 + 1 + 1 + L + L
    for text in ("3.25°", "2.00 h", "3 shapes", "jax 1.2.3", "step 4", "&lt;b&gt;0&lt;/b&gt;"):
        assert text in page, text
    assert "http" not in page and "<script" not in page


def test_the_page_of_a_run_without_any_measurement_is_a_page(tmp_path, about):
    write_summary(tmp_path / "summary.html", [], about | {"best": {}})

    assert "none" in (tmp_path / "summary.html").read_text()


def test_the_page_draws_as_many_iterations_as_there_are(tmp_path, about):
    lines = [line(2) | {"alpha": [1.0] * 7, "beta": [1.0] * 7}]

    write_summary(tmp_path / "summary.html", lines, about)

    page = (tmp_path / "summary.html").read_text()
    assert page.count("iteration 7") == 2


def test_the_page_and_tensorboard_draw_the_same_numbers():
    lines = [line(2), {"step": 2, "validation": VALIDATION}, line(4)]
    found = [(each["step"], charts.scalars(each)) for each in lines]

    drawn = charts.charts(lines)

    assert found[1][1] == {
        "validation/rotation_mean": 3.0, "validation/rotation_median": 1.0,
        "validation/translation_mean": 0.1, "validation/recall_5deg_0.1": 0.5,
        "validation/rotation/1": 2.0, "validation/rotation/2": 1.0,
    }  # fmt: skip
    assert found[0][1]["training/rotation_error/2"] == lines[0]["rotation_error"][1]
    errors = next(chart for chart in drawn if chart.title == "Rotation error")
    assert [curve.steps for curve in errors.curves] == [[2, 4], [2], [2]]
    assert errors.curves[0].values == [each["rotation_error"][-1] for each in (lines[0], lines[2])]
    assert errors.curves[1].values == [3.0] and errors.curves[2].values == [1.0]
    known = {value for _, numbers in found for value in numbers.values()}
    assert {value for chart in drawn for curve in chart.curves for value in curve.values} <= known


def test_a_full_disk_is_told_by_the_board_and_nothing_waits_for_it(tmp_path):
    pytest.importorskip("tensorboardX")
    written = board.Board(tmp_path / "tensorboard", 0)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, before[1]))
    try:
        for _ in range(20):  # more than a queue would hold
            with pytest.raises(OSError, match="tensorboard could not be written .*make room"):
                written.training(line(2), [measured(1.0)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    written.close()


def test_without_matplotlib_there_are_no_pictures_and_it_is_told(tmp_path, monkeypatch):
    pytest.importorskip("tensorboardX")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    found = VALIDATION

    written = board.Board(tmp_path, 0)
    cloud = np.zeros((3, 3))
    written.validation(
        2, found, [("pair_0", Scene(cloud, cloud, np.stack([np.eye(4)] * 2), ["start", "1"]))]
    )
    written.close()

    assert "cfr_jax[viz]" in written.missing
    (path,) = tmp_path.glob("events*")
    assert b"rotation_mean" in path.read_bytes() and b"pair_0" not in path.read_bytes()


def test_tensorboard_gets_scalars_histograms_and_pictures(tmp_path):
    pytest.importorskip("tensorboardX")
    pytest.importorskip("matplotlib")
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c

    written = board.Board(tmp_path, 0)
    cloud = np.random.default_rng(0).normal(size=(30, 3))
    scene = Scene(cloud, cloud, np.stack([np.eye(4)] * 2), ["start", "1"])
    found = VALIDATION
    written.training(line(2), [measured(1.0)])
    written.validation(2, found, [("pair_0", scene)])
    written.close()

    (path,) = tmp_path.glob("events*")
    content, tags = path.read_bytes(), {}
    while content:
        size = int.from_bytes(content[:8], "little")
        body, check = content[12 : 12 + size], content[12 + size : 16 + size]
        assert int.from_bytes(check, "little") == masked_crc32c(body)
        for value in Event.FromString(body).summary.value:
            tags[value.tag] = value.WhichOneof("value")
        content = content[16 + size :]
    assert tags["training/loss"] == tags["validation/rotation_mean"] == "simple_value"
    assert {tags[f"{name}/{i}"] for name in ("alpha", "beta") for i in (1, 2)} == {"histo"}
    assert tags["validation/pair_0"] == "image"


def test_without_tensorboardx_a_word_is_said_and_training_goes_on(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)

    silent = board.Board(tmp_path / "tensorboard", 0)
    silent.training(line(2), [measured(1.0)])
    silent.validation(2, {}, [])
    silent.close()

    assert silent.missing == 'no TensorBoard files: to get them, pip install "cfr_jax[train]"'
    assert not (tmp_path / "tensorboard").exists()


def test_the_bar_tells_loss_errors_speed_and_the_time_left():
    code = (
        "from cfr_jax.training.reporting.log import Bar\n"
        "bar = Bar(10, 0, shown=True)\n"
        "bar.measured({'loss': 1.5, 'rotation_error': [9, 3.25], 'translation_error': [9, 0.125]})"
        "\nbar._bar.mininterval = 0\nbar.step(5)\nbar._bar.refresh()\nbar.close()"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)

    for text in ("5 of 10 steps", "left", "loss=1.500", "RE=3.2", "TE=0.125"):
        assert text in child.stderr, child.stderr


def test_lines_are_plain_json(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log.MetricsLog(path, 0).write(line(2))

    assert json.loads(path.read_text())["loss"] == 1.5

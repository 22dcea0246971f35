"""The table of metrics: what it holds, and how one from outside is put there and shown."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
import solids

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.comparison import compare
from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry
from cfr_jax.evaluation.drawing.figures import by_iteration
from cfr_jax.evaluation.measuring import measure, summarize
from cfr_jax.evaluation.store import Record, Records


def farthest(estimates, pair):
    """How far the worst point of the source ends from where it belongs."""
    there = solids.move(pair.transform, pair.source)
    return np.array([np.linalg.norm(solids.move(t, pair.source) - there, axis=1).max()
                     for t in estimates])  # fmt: skip


TOY = metrics.Metric(
    "farthest",
    farthest,
    "farthest point",
    None,
    (
        metrics.Summary("farthest_mean", np.mean, "worst point", form=".1f"),
        metrics.Summary("farthest_max", np.max),
    ),
    each_iteration=True,
)


@pytest.fixture
def table(monkeypatch):
    """A table that is put back after the test."""
    monkeypatch.setattr(metrics, "_TABLE", dict(metrics._TABLE))
    metrics.add(TOY)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("corpus") / "test.h5"
    points = np.random.default_rng(0).normal(size=(3, 900, 3)) * [1, 0.7, 0.5]
    with h5py.File(path, "w") as file:
        file["data"] = points.astype(np.float32)
        file["normal"] = (points / np.linalg.norm(points, axis=2, keepdims=True)).astype(np.float32)
        file["label"] = np.zeros(3, np.uint8)
    data = {"kind": "corpus", "path": str(path), "protocol": "partial"}
    methods = {name: MethodEntry(name, threads=1) for name in ("identity", "truth")}
    return EvaluationConfig("title", data, methods)


def test_a_metric_from_outside_stands_in_the_table_that_evaluate_writes(table, config, tmp_path):
    text = compare(config, tmp_path, plots=False).table

    header, _, identity, truth = text.splitlines()[4:8]
    place = [cell.strip() for cell in header.split("|")].index("worst point")
    results = json.loads((tmp_path / "results.json").read_text())["methods"]["identity"]
    each = [pair["farthest"][-1] for pair in results["pairs"]]
    assert min(each) > 0.1
    assert identity.split("|")[place].strip() == f"{np.mean(each):.1f}"
    assert truth.split("|")[place].strip() == "0.0"
    assert results["numbers"]["farthest_max"]["value"] == max(each)
    assert "farthest_max" not in text


def test_a_metric_of_each_iteration_gets_a_panel(table, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    drawn = []
    monkeypatch.setattr(
        "cfr_jax.evaluation.drawing.figures.save_figure", lambda figure, path: drawn.append(figure)
    )
    points = np.random.default_rng(0).normal(size=(20, 3))
    pair = Pair("pair", points, points, transform=np.eye(4))
    ways = [solids.motion(20).tolist(), np.eye(4).tolist()]
    records = Records({"use": "cfr"}, by_pair={0: Record("", ways, 0.1)})

    by_iteration(tmp_path / "x.png", [measure("m", records, [pair])], "m")

    labels = [axes.get_ylabel() for axes in drawn[0].axes]
    assert labels[-1] == "farthest point (m): mean, median dotted" and len(labels) == 3


def test_a_metric_of_whole_shapes_is_not_measured_without_them():
    points = np.random.default_rng(0).normal(size=(20, 3))
    pair = Pair("pair", points, points, transform=np.eye(4))
    records = Records({"use": "truth"}, by_pair={0: Record("", [np.eye(4).tolist()], 0.1)})

    measured = measure("m", records, [pair])

    assert "chamfer" not in measured.errors
    assert summarize(measured, (), seed=0)["chamfer_mean"] is None


def test_a_name_is_given_once(table):
    with pytest.raises(ValueError, match="^name: got 'farthest', wanted one that is not taken"):
        metrics.add(TOY)


def test_what_is_no_metric_is_refused(unchecked):
    with pytest.raises(ValueError, match="^new: got <function .*, wanted a Metric"):
        metrics.add(metrics.err_r)


@pytest.mark.parametrize("entry", [TOY, TOY.summaries[0]], ids=lambda entry: type(entry).__name__)
def test_who_looks_an_entry_up_cannot_change_it(entry):
    with pytest.raises(dataclasses.FrozenInstanceError):
        entry.name = "nearest"


def test_a_column_says_what_its_numbers_are_multiplied_by_where_they_are():
    titles = {name: metrics.named(name).summaries[0].title for name in ("err_r", "chamfer")}

    assert titles == {"err_r": "RE mean", "chamfer": "CD mean ×1000"}


@pytest.mark.parametrize("name", ["r_mae", "r_rmse", "t_mae", "t_rmse"])
def test_pairs_are_summed_up_as_their_axes_are(name):
    (summary,) = metrics.named(name).summaries

    found = summary.statistic(np.array([3.0, 4.0]), axis=0)

    assert found == pytest.approx(3.5 if name.endswith("mae") else 12.5**0.5)


def test_all_summaries_have_names_of_their_own_and_say_which_way_is_better():
    names = [summary.name for metric in metrics.entries() for summary in metric.summaries]

    assert len(set(names)) == len(names) == 10
    assert all(metrics.lower_is_better(name) for name in names)
    assert not metrics.lower_is_better(metrics.recall(5.0, 0.1).name)


@pytest.mark.parametrize("metric", metrics.entries(), ids=lambda metric: metric.name)
def test_no_metric_finds_an_error_in_the_truth(metric):
    points = np.random.default_rng(0).normal(size=(30, 3))
    truth = solids.motion(30, translation=(0.1, 0.2, 0.3))
    moved = solids.move(truth, points)
    pair = Pair("p", points, moved, transform=truth, clean_source=points, clean_target=moved)
    wrong = solids.motion(5) @ truth

    right, off = metric.of(np.stack([truth, wrong]), pair)

    assert right < 1e-5
    assert off > 0.001

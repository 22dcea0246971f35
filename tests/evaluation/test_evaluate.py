"""The command `evaluate.py`, as a user runs it."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry
from cfr_jax.evaluation.methods import methods_of
from cfr_jax.networks import table

ROOT = Path(__file__).parents[2]
ABLATIONS = ROOT / "configs" / "eval_ablations.py"
# configs of whole merges have methods of their own: test_evaluation_multiway.py
MERGES = set((ROOT / "configs").glob("eval_merge_*.py"))
CONFIGS = sorted(set((ROOT / "configs").glob("eval_*.py")) - {ABLATIONS} - MERGES)
BY_OVERLAP = ROOT / "configs" / "eval_overlap.py"


def evaluate(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, ROOT / "evaluate.py", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=600,
    )


def read_config(path: Path):
    return read_module(path).get_config()


def read_module(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def arguments(tmp_path_factory):
    path = tmp_path_factory.mktemp("corpus") / "test.h5"
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        points = rng.normal(size=(6, 1200, 3))
        points /= np.linalg.norm(points, axis=2, keepdims=True)
        file["data"] = (points * [1, 0.7, 0.5]).astype(np.float32)
        file["normal"] = points.astype(np.float32)
        file["label"] = np.zeros(6, np.uint8)
    return (
        f"--config={ROOT / 'configs' / 'eval_open_cad.py'}",
        f"--config.data.path={path}",
        "--methods=identity,truth",
        "--config.threads=1",
    )


def test_the_same_seed_gives_the_same_table_whatever_draws_at_random(arguments, tmp_path):
    arguments = [a for a in arguments if not a.startswith(("--methods", "--config.threads"))]
    methods = "--methods=icp,icp_plane,gicp,gicp_jax,fgr,fgr_icp,ransac,kiss_matcher,cfr_align"

    runs = [
        evaluate(*arguments, methods, "--limit=2", f"--out={tmp_path / name}", "--noplots")
        for name in "ab"
    ]

    tables = [(tmp_path / name / "table.md").read_text().split("## Time")[0] for name in "ab"]
    assert tables[0] == tables[1], runs[1].stderr
    assert tables[0].count("| cfr_align |") >= 2
    found = [json.loads((tmp_path / name / "results.json").read_text()) for name in "ab"]
    for name, method in found[0]["methods"].items():
        for pair, again in zip(method["pairs"], found[1]["methods"][name]["pairs"], strict=True):
            assert pair["transforms"] == again["transforms"], name


def test_it_writes_table_results_plots_and_gallery_and_repeats_itself(arguments, tmp_path):
    # when
    first = evaluate(*arguments, "--limit=4", f"--out={tmp_path / 'a'}")
    second = evaluate(*arguments, "--limit=4", f"--out={tmp_path / 'b'}", "--noplots")

    # then
    assert first.returncode == 0, first.stderr
    tables = [(tmp_path / run / "table.md").read_text() for run in "ab"]
    assert tables[0] in first.stdout
    assert tables[0].split("## Time")[0] == tables[1].split("## Time")[0], second.stderr
    truth = next(line for line in tables[0].splitlines() if line.startswith("| truth"))
    assert truth.split("|")[2:6] == [" 0.00 ", " 0.00 ", " 0.0000 ", " 0.0000 "]
    results = json.loads((tmp_path / "a" / "results.json").read_text())
    identity = results["methods"]["identity"]
    assert [pair["index"] for pair in identity["pairs"]] == [0, 1, 2, 3]
    assert identity["numbers"]["err_r_mean"]["value"] > 10
    assert identity["started"]["threads"] == 1
    assert (tmp_path / "a" / "gallery" / "identity.png").is_file()
    assert not (tmp_path / "b" / "gallery").exists()


def test_missing_data_and_unknown_methods_are_told_in_a_line(arguments, tmp_path):
    missing = evaluate(*arguments, "--config.data.path=/nowhere.h5", f"--out={tmp_path}")
    unknown = evaluate(*arguments, "--methods=magic", f"--out={tmp_path}")
    for run, told in ((missing, "no corpus at /nowhere.h5"), (unknown, "magic not in the config")):
        assert run.returncode == 1
        assert told in run.stderr
        assert "Traceback" not in run.stderr


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_names_methods_that_exist(path):
    config = read_config(path)
    made = methods_of(config, [], seed=0)
    wanted = {"identity", "truth", "icp", "fgr", "ransac", "gicp", "cfr", "rpmnet", "rpmnet_optim"}
    if path == BY_OVERLAP:  # nine tables, of those that did best
        wanted = {"cfr_align", "fgr_icp", "kiss_matcher"}
    assert wanted <= {m.name for m in made}
    assert len(config.thresholds) == 3
    assert tuple(config.main_threshold) in [tuple(pair) for pair in config.thresholds]


@pytest.mark.parametrize(
    ("use", "options", "told"),
    [
        ("cfr", {"refined": True}, "options: cfr got refined, wanted some of refine, settings, "),
        ("cfr", {"seed": 3}, "options: cfr got seed, wanted some of refine"),
        ("cfr", {"settings": {"k": 3}}, "options.settings: got k, wanted some of neighbors, rad"),
        ("gicp", {"start": "centroid"}, "options: gicp got no distances, which it needs"),
        ("fgr", {"distance": 0.1}, "options: fgr got no feature_radius, normal_radius, which"),
        ("ransac", {"distances": 0.1}, "options: ransac got distances, wanted some of iterations"),
        ("identity", {"start": 1}, "options: identity got start, wanted none"),
        ("truth", {"start": 1}, "options: truth got start, wanted none"),
    ],
)
def test_options_that_a_method_does_not_take_are_refused_before_anything_runs(use, options, told):
    config = EvaluationConfig("title", {}, {"mine": MethodEntry(use, options)})
    with pytest.raises(ValueError, match=f"^methods.mine.{told}"):
        methods_of(config, [], seed=0)


def test_a_method_that_answered_nothing_is_an_error_after_all_others_have_run(tmp_path, arguments):
    own = tmp_path / "mine.py"
    own.write_text(
        f"import runpy\n"
        f"from cfr_jax.evaluation.config import MethodEntry\n"
        f"def get_config():\n"
        f"    config = runpy.run_path({str(CONFIGS[0].with_name('eval_open_cad.py'))!r})\n"
        f"    config = config['get_config']()\n"
        f"    config.methods['mine'] = MethodEntry('cfr', {{'through': 'luck'}})\n"
        f"    return config\n"
    )
    given = [a for a in arguments if not a.startswith(("--config=", "--methods"))]

    run = evaluate(
        f"--config={own}", *given, "--methods=mine,truth", "--limit=2", "--noplots",
        f"--out={tmp_path / 'out'}",
    )  # fmt: skip

    assert run.returncode == 1
    assert "evaluate.py: error: mine answered no pair: ValueError: through is 'luck'" in run.stderr
    assert "| truth | 0.00 |" in run.stdout
    assert json.loads((tmp_path / "out" / "results.json").read_text())["methods"]["mine"]


def test_without_normals_the_methods_are_the_same_and_none_is_given_any():
    config = read_module(ROOT / "configs" / "eval_open_cad.py")
    exact, estimated = (config.get_config(kind).methods for kind in ("exact", "estimated"))

    # all but those that take no normals, and RPM-Net, whose answers are those of `rpmnet_optim`
    without = {"identity", "truth", "icp", "gicp", "kiss_matcher", "rpmnet", "dcp", "fmr", "rgm"}
    assert set(estimated) == {f"{name}_estimated" for name in set(exact) - without}
    for name, entry in estimated.items():
        assert entry.estimated_normals is True
        assert entry.use == exact[name.removesuffix("_estimated")].use
    assert not any(entry.estimated_normals for entry in exact.values())
    assert len(methods_of(config.get_config("estimated"), [], seed=0)) == len(estimated)


def test_what_an_ablation_trains_is_what_it_measures():
    from cfr_jax.evaluation.solvers.network_solver import make_network
    from cfr_jax.training.learner import learner

    evaluations, trainings = read_module(ABLATIONS), read_module(ROOT / "configs" / "ablations.py")
    for name, variants in evaluations.ABLATIONS.items():
        config = evaluations.get_config(name)
        assert len(config.methods) == len(variants) == 2
        for method, (run, settings) in variants.items():
            entry = config.methods[method]
            made = make_network(network=table.named("cfr"), weights="object", **entry.options)
            measured = made.args[1].settings
            if run:
                assert run in evaluations.trainings(name)
                assert entry.weights == f"{evaluations.workdir(run)}/weights.safetensors"
                assert learner(trainings.get_config(run)).validated == measured, method
            for field, value in settings.items():
                assert getattr(measured, field) == value


def test_an_ablation_that_does_not_exist_is_told_in_a_line():
    command = [sys.executable, ROOT / "ablate.py", "--ablation=luck"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 1
    assert "--ablation: got 'luck', wanted one of weights, passes" in run.stderr
    assert "Traceback" not in run.stderr

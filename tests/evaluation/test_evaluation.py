"""Methods side by side: whatever one of them does, the table tells the truth about all."""

from __future__ import annotations

import dataclasses
import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from ml_collections import ConfigDict
from scipy.spatial.transform import Rotation

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import store
from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry, checked
from cfr_jax.evaluation.datasets import read_pairs
from cfr_jax.evaluation.drawing.tables import write_table
from cfr_jax.evaluation.measuring import measure, only, summarize
from cfr_jax.evaluation.methods import Method, make_baseline, methods_of
from cfr_jax.evaluation.running import run_method
from cfr_jax.evaluation.solvers.solver import Answer, clouds_of
from cfr_jax.evaluation.store import Record, Records
from cfr_jax.networks import table

ABOUT = {"use": "identity", "options": {}, "estimated_normals": False, "batch": 1, "threads": 1}


def a_pair(seed: int = 0, name: str = "fine", angle: float = 30.0, points: int = 40) -> Pair:
    rng = np.random.default_rng(seed)
    target = rng.normal(size=(points, 3))
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_rotvec([0, np.deg2rad(angle), 0]).as_matrix()
    truth[:3, 3] = [0.3, 0.0, 0.4]
    source = (target - truth[:3, 3]) @ truth[:3, :3]
    return Pair(name, source, target, transform=truth, clean_source=source, clean_target=target)


def a_corpus(path, shapes: int = 4):
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file["data"] = rng.normal(size=(shapes, 1100, 3)).astype(np.float32) / 3
        normals = rng.normal(size=(shapes, 1100, 3)).astype(np.float32)
        file["normal"] = normals
        file["label"] = np.zeros((shapes, 1), np.uint8)
    return path


def answers(pairs, transforms) -> Records:
    by_pair = {
        k: Record(store.digest(pair), np.asarray(t)[None].tolist(), 0.5)
        for k, (pair, t) in enumerate(zip(pairs, transforms, strict=True))
    }
    return Records(dict(ABOUT), by_pair=by_pair)


# A method that does what the name of the pair says; made anew in a process of its own.
def make_troublesome():
    def solve(pairs):
        for pair in pairs:
            if pair.name == "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            if pair.name == "hang":
                time.sleep(60)
            if pair.name == "raise":
                raise RuntimeError("no luck")
        bent = np.diag([1.0, 1.0, 2.0, 1.0])
        return [
            Answer((bent if pair.name == "bent" else pair.transform)[None], 0.01) for pair in pairs
        ]

    return solve


def make_missing():
    raise ModuleNotFoundError("somelib is needed: pip install somelib")


def make_failing(path):
    with open(path, "a") as file:
        file.write("once\n")
    raise ValueError("no such option")


def make_counting(path):
    def solve(pairs):
        with open(path, "a") as file:
            file.writelines(f"{pair.name}\n" for pair in pairs)
        return [Answer(np.eye(4)[None], 0.01) for _ in pairs]

    return solve


def test_a_method_that_crashes_hangs_or_raises_fails_on_that_pair_alone(tmp_path):
    # given
    names = ("fine", "crash", "hang", "raise", "bent", "fine")
    pairs = [a_pair(seed, name) for seed, name in enumerate(names)]
    method = Method("troublesome", make_troublesome, ABOUT, batch=2)

    # when
    held = run_method(method, pairs, tmp_path / "part.json", timeout=1.0)

    # then
    reasons = [held.by_pair[k].failure for k in range(6)]
    assert reasons[0] is reasons[5] is None
    assert "SIGSEGV" in reasons[1]
    assert "no answer within 1 s" in reasons[2]
    assert reasons[3] == "RuntimeError: no luck"
    assert reasons[4] == "returned a motion that is not rigid"


def test_a_method_whose_library_is_missing_is_left_out_with_the_way_out(tmp_path):
    method = Method("missing", make_missing, ABOUT)
    held = run_method(method, [a_pair()], tmp_path / "part.json", timeout=60.0)
    assert held.missing == "somelib is needed: pip install somelib"
    assert not held.by_pair


def test_a_method_that_cannot_be_sent_to_its_process_says_why(tmp_path):
    method = Method("mine", functools.partial(make_counting, lambda: None), ABOUT)
    told = r"^methods\.mine: cannot be sent to its own process \(.*lambda.*\); wanted functions"
    with pytest.raises(ValueError, match=told):
        run_method(method, [a_pair()], tmp_path / "part.json", timeout=60.0)


def test_a_method_that_cannot_be_made_is_made_once(tmp_path):
    method = Method("unmade", functools.partial(make_failing, tmp_path / "made"), ABOUT)
    held = run_method(method, [a_pair(0), a_pair(1)], tmp_path / "part.json", timeout=60.0)
    assert [held.by_pair[k].failure for k in (0, 1)] == ["ValueError: no such option"] * 2
    assert (tmp_path / "made").read_text() == "once\n"


def test_a_run_goes_on_with_the_pairs_that_have_no_answer_yet(tmp_path):
    # given a run over two pairs
    asked = tmp_path / "asked"
    pairs = [a_pair(seed, f"pair {seed}") for seed in range(4)]
    method = Method("counting", functools.partial(make_counting, asked), ABOUT)
    run_method(method, pairs[:2], tmp_path / "part.json", timeout=60.0)
    asked.unlink()

    # when it goes on with more, one of the old ones changed
    pairs[1] = dataclasses.replace(pairs[1], source=pairs[1].source + 0.01)
    held = run_method(method, pairs, tmp_path / "part.json", timeout=60.0)

    # then only what is new is asked for (the first of it twice, to warm up)
    assert set(asked.read_text().splitlines()) == {"pair 1", "pair 2", "pair 3"}
    assert list(held.by_pair) == [0, 1, 2, 3]


def test_answers_made_with_other_settings_do_not_count(tmp_path):
    path, pairs = tmp_path / "part.json", [a_pair()]
    store.save(path, answers(pairs, [np.eye(4)]))
    digests = [store.digest(pairs[0])]
    assert len(store.load(path, dict(ABOUT), digests).by_pair) == 1
    assert not store.load(path, ABOUT | {"options": {"distance": 1.0}}, digests).by_pair


def test_stored_answers_keep_every_digit(tmp_path):
    path, pair = tmp_path / "part.json", a_pair()
    store.save(path, answers([pair], [pair.transform]))
    kept = store.load(path, dict(ABOUT), [store.digest(pair)]).by_pair[0]
    np.testing.assert_array_equal(np.array(kept.transforms)[0], pair.transform)


@pytest.mark.parametrize("content", ["", "[]", '{"by_pair": 3}'])
def test_a_damaged_file_of_answers_is_refused(tmp_path, content):
    path = tmp_path / "part.json"
    path.write_text(content)
    with pytest.raises(ValueError, match="not a file of results .*remove it"):
        store.load(path, dict(ABOUT), [])


def test_identity_and_truth_have_the_errors_that_they_must():
    # given
    pairs = [a_pair(seed, angle=angle) for seed, angle in enumerate((10.0, 20.0, 60.0))]

    # when
    solve = make_baseline("identity", {}, estimated=False)
    identity = measure("identity", answers(pairs, [a.transforms[0] for a in solve(pairs)]), pairs)
    truth = measure("truth", answers(pairs, [pair.transform for pair in pairs]), pairs)

    # then
    np.testing.assert_allclose(identity.err_r[:, -1], [10, 20, 60], atol=1e-6)
    np.testing.assert_allclose(identity.err_t[:, -1], 0.5)
    assert (identity.errors["chamfer"] > 0.01).all()
    assert (truth.err_r < 1e-5).all()
    assert (truth.err_t < 1e-12).all()
    assert (truth.errors["chamfer"] < 1e-12).all()


def test_rounding_to_float32_does_not_show_in_the_angle():
    pair = a_pair(angle=33.3)
    measured = measure("rounded", answers([pair], [pair.transform.astype(np.float32)]), [pair])
    assert measured.err_r[0, 0] < 1e-5


def test_a_failure_is_a_miss_and_no_part_of_the_mean_error():
    # given: solved, failed
    pairs = [a_pair(0), a_pair(1)]
    held = answers(pairs, [pair.transform for pair in pairs])
    held.by_pair[1] = Record(store.digest(pairs[1]), failure="no luck")

    # when
    measured = measure("half", held, pairs)
    numbers = summarize(measured, [(5.0, 0.1)], seed=0)

    # then
    assert numbers["recall_5deg_0.1"].value == 0.5
    assert numbers["err_r_mean"].value < 1e-5
    assert measured.failures == {1: "no luck"}


def test_a_method_that_never_answers_has_no_errors_and_no_recall():
    pairs = [a_pair()]
    held = Records(dict(ABOUT), by_pair={0: Record("", failure="no luck")})
    numbers = summarize(measure("never", held, pairs), [(5.0, 0.1)], seed=0)
    assert numbers["err_r_mean"] is None
    assert numbers["recall_5deg_0.1"].value == 0


def test_the_table_is_the_same_but_for_the_section_on_time():
    # given two runs whose clocks differ
    pairs = [a_pair(seed) for seed in range(5)]
    about = {
        "title": "T", "data": "d", "pairs": 5, "seed": 0, "unit": "m", "thresholds": [(5.0, 2.0)],
        "commit": "c", "date": "today", "machine": "m", "versions": {"numpy": "2"}, "command": "x",
    }  # fmt: skip
    texts = []
    for seconds in (0.1, 0.2):
        held = answers(pairs, [np.eye(4)] * 5)
        held.by_pair[2] = Record("", failure="no luck")
        held.by_pair[3] = dataclasses.replace(held.by_pair[3], seconds=seconds)
        measured = measure("identity", held, pairs)
        numbers = {"identity": summarize(measured, about["thresholds"], seed=3)}
        parts = ([only(measured, np.array([0, 4]))], {"identity": numbers["identity"]})
        told = about | {"nearly_symmetric": 3}
        texts.append(write_table([measured], numbers, told, {"icp": "open3d is needed"}, *parts))

    # then
    before = [text.split("## Time")[0] for text in texts]
    assert before[0] == before[1]
    assert "| identity | 30.00 | 30.00 | 0.5000 |" in before[0]
    assert "recall 5°, 2 m" in before[0]
    assert "**icp**: not run, open3d is needed" in before[0]
    assert "**identity**, 1 pairs (2): no luck" in before[0]
    assert "3 of the pairs show shapes" in before[0]
    assert before[0].count("| identity | 30.00 | 30.00 | 0.5000 |") == 2


@pytest.mark.parametrize("kind", ["partial", "clean"])
def test_pairs_of_a_corpus_are_those_of_its_fixed_protocol(tmp_path, kind):
    from cfr_jax.data import protocol
    from cfr_jax.data.corpus import read_corpus

    # given
    path = a_corpus(tmp_path / "test.h5")
    data = {"kind": "corpus", "path": str(path), "protocol": kind}

    # when
    pairs = read_pairs(data, 3, tmp_path)

    # then
    wanted = protocol.fixed_pair(read_corpus(path), 2, getattr(protocol, kind))
    assert len(pairs) == 3
    np.testing.assert_array_equal(pairs[2].source, wanted.source)
    np.testing.assert_allclose(pairs[2].transform, wanted.transform, atol=1e-6)
    assert len(read_pairs(data, 0, tmp_path)) == 4


@pytest.mark.parametrize(
    ("change", "limit", "message"),
    [
        ({"kind": "movies"}, 1, "data.kind: got 'movies', wanted one of pair-list, pair-file"),
        ({"protocol": "hard"}, 1, "protocol: got 'hard', wanted one of clean, noise, partial"),
        ({"path": "nowhere.h5"}, 1, "no corpus at nowhere.h5"),
        ({"kind": "modelnet40", "path": "nowhere", "split": "test"}, 1, "Download modelnet40_ply"),
        ({}, -1, "limit is -1"),
    ],
)
def test_data_that_cannot_be_used_is_told(tmp_path, change, limit, message):
    data = {"kind": "corpus", "path": str(a_corpus(tmp_path / "t.h5")), "protocol": "partial"}
    with pytest.raises(ValueError, match=message):
        read_pairs(data | change, limit, tmp_path)


def test_pairs_of_some_frames_are_those_whose_both_frames_are_among_them(tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3))
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        for name, frames in (("a", (0, 3)), ("b", (3, 5)), ("c", (5, 9)), ("d", None)):
            group = file.create_group(name)
            group["source"], group["target"], group["transform"] = points, points, np.eye(4)
            if frames is not None:
                group.attrs["source_frame"], group.attrs["target_frame"] = frames
    data = {"kind": "pair-file", "path": str(tmp_path / "pairs.h5"), "frames": (3, 9)}

    assert [pair.name for pair in read_pairs(data, 0, tmp_path)] == ["b"]
    data["frames"] = ()
    assert len(read_pairs(data, 0, tmp_path)) == 4


def test_the_code_of_a_network_is_told_apart_by_every_file_that_makes_its_answers():
    """All that `evaluation.solvers.network_solver` imports of the package, and so on."""
    from cfr_jax.evaluation import methods

    loaded = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, cfr_jax.evaluation.solvers.network_solver; print(*sys.modules)",
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    package = Path(methods.__file__).parents[1]
    told = {path for pattern in methods._OURS for path in package.glob(pattern)}
    # what reads, checks and compares, but computes no answer
    apart = {"io", "data", "evaluation", "batch"}
    names = [name for name in loaded if name.startswith("cfr_jax.")]
    assert len(names) > 30
    for name in names:
        if name.split(".")[1] not in apart:
            path = package.joinpath(*name.split(".")[1:])
            path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
            assert path in told, name


def test_a_pair_without_truth_cannot_be_measured(tmp_path):
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        file["a/source"] = file["a/target"] = np.random.default_rng(0).normal(size=(9, 3))
    data = {"kind": "pair-file", "path": str(tmp_path / "pairs.h5")}
    with pytest.raises(ValueError, match="pair a has no true transform"):
        read_pairs(data, 0, tmp_path)


def test_normals_are_withheld_where_they_are_unusable_or_not_wanted():
    ones = np.tile([0.0, 0.0, 1.0], (40, 1))
    holes = ones.copy()
    holes[3] = 0
    pair = dataclasses.replace(a_pair(), source_normals=ones, target_normals=holes)
    source, target = clouds_of(pair, estimated=False)
    assert source.normals is not None
    assert target.normals is None
    assert all(cloud.normals is None for cloud in clouds_of(pair, estimated=True))


def config(**fields):
    return EvaluationConfig("t", {"kind": "corpus", "path": "nowhere.h5"}, **fields)


def test_a_config_with_an_unknown_method_is_refused():
    given = config(methods={"m": MethodEntry("magic")})
    with pytest.raises(ValueError, match="methods.m.use is 'magic'"):
        methods_of(given, [], seed=0)
    with pytest.raises(ValueError, match="methods: n not in the config, which has m"):
        methods_of(given, ["n"], seed=0)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"limit": -1}, "limit: got -1, wanted 0 or more"),
        ({"threads": -1}, "threads: got -1, wanted 0 or more"),
        ({"seed": "0"}, "seed: got '0', wanted a whole number"),
        ({"limit": True}, "limit: got True, wanted a whole number"),
        ({"limits": (15.0,)}, r"limits: got \(15.0,\), wanted degrees and a length"),
        ({"thresholds": (5.0, 0.1)}, "thresholds: got 5.0, wanted degrees and a length"),
        ({"methods": {"m": {"use": "icp"}}}, "methods.m: got .*, wanted a MethodEntry"),
    ],
)
def test_what_an_evaluation_is_told_wrong_is_named(unchecked, change, wanted):
    given = config(methods={})
    for name, value in change.items():
        setattr(given, name, value)
    with pytest.raises(ValueError, match=wanted):
        checked(given)


@pytest.mark.parametrize(
    ("fields", "wanted"),
    [
        ({"batch": 0}, "methods: batch: got 0"),
        ({"threads": "2"}, "threads: got '2', wanted a whole number or None"),
        ({"modules": 1}, "modules: got 1, wanted True or False"),
    ],
)
def test_what_a_method_is_told_wrong_is_named(unchecked, fields, wanted):
    entry = MethodEntry("cfr")
    for name, value in fields.items():
        setattr(entry, name, value)
    with pytest.raises(ValueError, match=wanted):
        checked(config(methods={"m": entry}))


def test_what_is_no_config_of_an_evaluation_is_refused(unchecked):
    with pytest.raises(ValueError, match="config: got ConfigDict, wanted EvaluationConfig"):
        checked(ConfigDict({"title": "t"}))


def test_an_option_that_is_set_for_one_method_is_that_of_no_other():
    shared = {"start": "centroid"}
    given = config(methods={"icp": MethodEntry("icp", shared), "gicp": MethodEntry("gicp", shared)})

    given.methods["icp"].options["start"] = "identity"

    assert checked(given).methods["gicp"].options == {"start": "centroid"}


def test_a_worker_imports_nothing_numerical_before_it_limits_its_threads():
    code = "import sys, cfr_jax.evaluation.worker; print({'numpy', 'jax'} & set(sys.modules))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert child.stdout.strip() == "set()", child.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no core limits on this system")
def test_a_process_keeps_to_the_cores_it_is_given():
    code = "from cfr_jax.evaluation.worker import limit_threads as l; import os; print(l(1), l(0))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert child.stdout.split() == ["1", "1"], child.stderr


def test_the_gallery_shows_best_median_and_worst_and_no_pair_twice():
    from cfr_jax.evaluation.drawing.gallery import chosen

    pairs = [a_pair(seed, angle=float(angle)) for seed, angle in enumerate(range(11))]
    measured = measure("identity", answers(pairs, [np.eye(4)] * 11), pairs)
    assert chosen(measured) == {"best": [0, 1, 2], "median": [4, 5, 6], "worst": [10, 9, 8]}
    few = measure("identity", answers(pairs[:4], [np.eye(4)] * 4), pairs[:4])
    assert chosen(few) == {"best": [0, 1, 2], "median": [], "worst": [3]}


@pytest.mark.parametrize("cascades", [1, 2])
def test_a_batch_answers_as_each_pair_alone(tmp_path, params, cascades):
    import jax.numpy as jnp

    from cfr_jax.evaluation.solvers.network_solver import make_network
    from cfr_jax.networks.cfr.registration import register
    from cfr_jax.weights.files import save_params

    # given three pairs for batches of two: the second is filled up
    save_params(tmp_path / "w.safetensors", params)
    pairs = [a_pair(seed, points=70) for seed in range(3)]
    solve = make_network(
        network=table.named("cfr"),
        weights=str(tmp_path / "w.safetensors"),
        refine=False,
        batch=2,
        cascades=cascades,
    )

    # when
    found = solve(pairs)

    # then
    assert len(found) == 3
    for pair, answer in zip(pairs, found, strict=True):
        clouds = (jnp.asarray(cloud, jnp.float32) for cloud in (pair.source, pair.target))
        alone = register(params, *clouds, cascades=cascades).transforms
        np.testing.assert_allclose(answer.transforms, alone, atol=2e-4)
        assert 0 < answer.seconds < 60


def test_clouds_of_any_size_go_through_align(monkeypatch):
    from cfr_jax.evaluation.solvers import network_solver

    # given
    class Found:
        transform, transforms = np.diag([1.0, 1, 1, 1]), np.tile(np.eye(4), (5, 1, 1))
        seconds = {"total": 3.0, "compile": 2.0}

    asked = {}

    def align(source, target, **options):
        asked.update(options, normals=source.normals)
        return Found

    monkeypatch.setattr(network_solver, "align", align)
    monkeypatch.setattr(network_solver, "load_params", lambda weights, network: {})

    # when
    solve = network_solver.make_network(
        network=table.named("cfr"),
        weights="w",
        refine=True,
        through="align",
        max_points=9,
        seed=3,
        estimated=True,
    )
    (answer,) = solve([a_pair()])

    # then the refinement is one more iteration, and compilation takes no time of the pair
    assert answer.transforms.shape == (6, 4, 4)
    assert answer.seconds == 1.0
    assert asked == {
        "params": {}, "refine": True, "initial": None, "max_points": 9, "seed": 3, "normals": None,
    }  # fmt: skip


def test_a_network_goes_through_register_or_align_and_nothing_else(unchecked):
    from cfr_jax.evaluation.solvers import network_solver

    with pytest.raises(ValueError, match="through is 'luck'"):
        network_solver.make_network(
            network=table.named("cfr"), weights="w", refine=True, through="luck"
        )
    with pytest.raises(ValueError, match="cascades is 0"):
        network_solver.make_network(
            network=table.named("cfr"), weights="w", refine=True, cascades=0
        )


def a_network(tmp_path, network: str, **options):
    """A solver with random weights, eight neighbors and two iterations, and its parameters."""
    from oracle import authors

    from cfr_jax.evaluation.solvers.network_solver import make_network
    from cfr_jax.weights.conversion import from_state_dict
    from cfr_jax.weights.files import save_params

    made = {"cfr": authors.random_state_dict, "rpmnet": authors.random_rpmnet_state_dict}[network]
    params = from_state_dict(made(0))
    save_params(tmp_path / "w.safetensors", params)
    solve = make_network(
        network=table.named(network),
        weights=str(tmp_path / "w.safetensors"),
        refine=False,
        **options,
    )
    return solve, params


SMALL = {"neighbors": 8, "iterations": 1}


def motions(unroll, params, source, target, settings):
    """What a network answers, compiled as a whole."""
    import jax
    import jax.numpy as jnp

    def solve(*clouds):
        return jnp.stack([step.transform for step in unroll(params, *clouds, settings)])

    return np.asarray(jax.jit(solve)(source, target))


def test_rpmnet_answers_a_batch_as_each_pair_alone(tmp_path):
    import jax.numpy as jnp

    from cfr_jax.networks import rpmnet
    from cfr_jax.networks.cfr.registration import Cloud

    # given
    settings = SMALL | {"optimized": False}
    solve, params = a_network(tmp_path, "rpmnet", settings=settings, batch=2)
    ones = np.tile([0.0, 0.0, 1.0], (40, 1))
    pairs = [
        dataclasses.replace(a_pair(seed), source_normals=ones, target_normals=ones)
        for seed in range(3)
    ]

    # when
    found = solve(pairs)

    # then
    for pair, answer in zip(pairs, found, strict=True):
        none = jnp.zeros((40, 1), jnp.int32)
        clouds = (
            Cloud(jnp.float32(x), jnp.float32(ones), none) for x in (pair.source, pair.target)
        )
        alone = motions(rpmnet.unroll, params, *clouds, rpmnet.RPMNetSettings(**settings))
        np.testing.assert_allclose(answer.transforms, alone, atol=2e-4)


def test_a_prepared_cloud_has_the_size_of_the_network_and_its_padding_changes_nothing(tmp_path):
    from cfr_jax.geometry import units
    from cfr_jax.networks import rpmnet
    from cfr_jax.networks.cfr.registration import Settings, prepare

    # given a pair in millimeters
    solve, params = a_network(tmp_path, "rpmnet", settings=SMALL, through="preparation")
    pair = a_pair()
    large = dataclasses.replace(pair, source=pair.source * 1e3, target=pair.target * 1e3)

    # when
    (found,) = solve([large])

    # then it is the answer for the centered clouds as they are, without padding, in millimeters
    frames = units.unit_frames(*clouds_of(pair, estimated=True), None)
    unit = [
        prepare(
            np.float32((points - center) / frames.scale),
            settings=Settings(neighbors=8),
        )
        for points, center in (
            (pair.source, frames.source_center),
            (pair.target, frames.target_center),
        )
    ]
    wanted = frames.to_caller(motions(rpmnet.unroll, params, *unit, rpmnet.RPMNetSettings(**SMALL)))
    wanted[:, :3, 3] *= 1e3
    np.testing.assert_allclose(found.transforms[:, :3, :3], wanted[:, :3, :3], atol=2e-4)
    np.testing.assert_allclose(found.transforms[:, :3, 3], wanted[:, :3, 3], atol=1.0)


@pytest.mark.parametrize("network", ["cfr", "rpmnet"])
def test_the_modules_that_are_timed_are_those_of_a_registration(tmp_path, network):
    import jax.numpy as jnp

    from cfr_jax.evaluation.solvers import module_times
    from cfr_jax.geometry import rigid
    from cfr_jax.networks import inputs, rpmnet, timed_parts
    from cfr_jax.networks.cfr import iterations

    # given the parts of a registration of one iteration
    _, params = a_network(tmp_path, network)
    settings = {"neighbors": 8}
    source, target = module_times._clouds(a_pair(), estimated=True)
    if network == "cfr":
        params["cascade"] = {name: leaf[:1] for name, leaf in params["cascade"].items()}
        out = params["annealing"]["out"]
        params["annealing"]["out"] = {name: leaf[..., [0, 5]] for name, leaf in out.items()}
        small = inputs.Settings(**settings)
        (motion,) = motions(iterations.unroll, params, source, target, small)
    else:
        small = rpmnet.RPMNetSettings(**settings, iterations=1)
        (motion,) = motions(rpmnet.unroll, params, source, target, small)

    # when the last part is run
    *_, last = table.named(network).parts(params, small)(source, target)

    # then it leaves the source where a registration does
    assert last.module == timed_parts.MOTION
    wanted = rigid.apply(jnp.asarray(motion), source.points)
    np.testing.assert_allclose(last.function(*last.arguments), wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("network", "settings"),
    [
        ("cfr", {}),
        ("cfr", {"repeat_annealing": True, "repeat_extraction": True}),
        ("rpmnet", {}),
        ("rpmnet", {"optimized": False}),
    ],
)
def test_each_module_is_counted_as_often_as_a_registration_runs_it(
    tmp_path, monkeypatch, network, settings
):
    from collections import Counter

    import flax.linen as nn
    import jax

    from cfr_jax.evaluation.solvers import module_times
    from cfr_jax.geometry import rigid
    from cfr_jax.networks import rpmnet, timed_parts
    from cfr_jax.networks.cfr import iterations

    # given how often each module of a registration is to be timed
    _, params = a_network(tmp_path, network)
    record = table.named(network)
    chosen = record.settings(neighbors=8, **settings)
    clouds = module_times._clouds(a_pair(), estimated=True)
    counted = Counter()
    for part in record.parts(params, chosen)(*clouds):
        counted[part.module] += part.times

    # when a registration is traced, with all calls noted
    ran = Counter()

    def noted(name, function):
        def run(*arguments, **options):
            ran[name] += 1
            return function(*arguments, **options)

        return run

    def note(method, arguments, options, context):
        ran[type(context.module).__name__, context.method_name] += 1
        return method(*arguments, **options)

    home = {"cfr": iterations, "rpmnet": rpmnet}[network]
    monkeypatch.setattr(home, "match", noted("match", home.match))
    monkeypatch.setattr(rigid, "fit_rigid", noted("fit", rigid.fit_rigid))
    monkeypatch.setattr(rpmnet, "find_neighbors", noted("search", rpmnet.find_neighbors))
    with nn.intercept_methods(note):
        jax.eval_shape(lambda: [step.transform for step in record.unroll(params, *clouds, chosen)])

    # then they are as many
    if network == "cfr":
        searches = len(clouds)  # they come with their neighbors
        light = ran["Cascade", "layer"] / record.iterations(params)  # layers are timed all at once
        features = ran["PointFeatures", "__call__"] + light
    else:
        searches, features = ran["search"], ran["Features", "__call__"]
    assert counted == {
        timed_parts.NEIGHBORS: searches,
        timed_parts.FEATURES: features,
        timed_parts.ANNEALING: ran["AnnealingNet", "__call__"],
        timed_parts.MATCHING: ran["match"],
        timed_parts.MOTION: ran["fit"],
    }
    assert ran["match"] == 5


def test_weights_that_are_not_there_leave_their_method_out_and_no_other(tmp_path):
    given = config(
        rpmnet_weights=str(tmp_path / "nowhere.safetensors"),
        methods={
            "rpmnet": MethodEntry("rpmnet", {"refine": False}),
            "mine": MethodEntry("cfr", {"refine": False}, weights="nobody"),
            "cfr": MethodEntry("cfr", {"refine": False}),
        },
    )
    rpmnet, mine, cfr = methods_of(given, ["rpmnet", "mine", "cfr"], seed=0)
    assert "nowhere.safetensors" in rpmnet.missing and "nobody" in mine.missing
    assert cfr.missing is None
    held = run_method(mine, [a_pair()], tmp_path / "part.json", timeout=1.0)
    assert held.missing == mine.missing and not held.by_pair

    # weights of the other network are an error, and so is a missing file that was asked for
    given.rpmnet_weights = "object"
    with pytest.raises(ValueError, match="holds the network CFR, wanted RPM-Net"):
        methods_of(given, ["rpmnet"], seed=0)
    given.weights = "nobody"
    with pytest.raises(ValueError, match="no shipped weights called 'nobody'"):
        methods_of(given, ["cfr"], seed=0)


def test_the_errors_without_some_pairs_are_those_of_the_others():
    # given two good answers and a bad one, and a failure
    pairs = [a_pair(seed) for seed in range(4)]
    held = answers(pairs, [pair.transform for pair in pairs[:2]] + [np.eye(4)] * 2)
    held.by_pair[3] = Record("", failure="no luck")

    # when
    part = only(measure("m", held, pairs), np.array([0, 2, 3]))

    # then
    numbers = summarize(part, [(5.0, 0.1)], seed=0)
    assert numbers["recall_5deg_0.1"].value == pytest.approx(1 / 3)
    assert numbers["err_r_mean"].value == pytest.approx(15, abs=1e-5)
    assert part.failures == {2: "no luck"}
    assert len(part.errors["chamfer"]) == 3

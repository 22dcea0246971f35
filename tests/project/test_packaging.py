"""What `pip install` gives: the files, the dependencies, the command."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

import cfr_jax

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "cfr_jax"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

# Where the name to import is not the name to install.
INSTALLED_AS = {
    "absl": "absl-py",
    "orbax": "orbax-checkpoint",
    "lzf": "python-neo-lzf",
    "small_gicp": "small-gicp",
    "kiss_matcher": "kiss-matcher",
    "rerun": "rerun-sdk",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    built = next(WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"]))
    with zipfile.ZipFile(built) as archive:
        yield archive


def requirement_names(requirements: list[str]) -> set[str]:
    return {re.match(r"[\w.-]+", requirement)[0] for requirement in requirements}


def third_party_imports(*, at_the_top: bool) -> set[str]:
    """Packages that files import when they are imported themselves, or only when they run."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        top = {id(node) for node in tree.body}
        for node in ast.walk(tree):
            if isinstance(node, (ast.Import, ast.ImportFrom)) and at_the_top == (id(node) in top):
                if isinstance(node, ast.Import):
                    found |= {alias.name.partition(".")[0] for alias in node.names}
                elif not node.level:
                    found.add(node.module.partition(".")[0])
    foreign = found - set(sys.stdlib_module_names) - {"cfr_jax"}
    return {INSTALLED_AS.get(name, name) for name in foreign} - {"jaxlib"}


def test_the_wheel_holds_every_file_of_the_package_but_the_baseline_and_no_other(wheel):
    # given
    kept = {
        str(path.relative_to(ROOT))
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    } - {"cfr_jax/weights/shipped/rpmnet.safetensors", "cfr_jax/weights/shipped/rpmnet.md"}

    # when
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}

    # then
    assert packed == kept


@pytest.mark.parametrize(
    "name",
    [
        "py.typed",
        "viewer/page.html",
        "cli/schemas/register.schema.json",
        "cli/schemas/batch.schema.json",
        "weights/shipped/object.json",
        "weights/shipped/held_out.npz",
        "weights/shipped/held_out.md",
        "cli/demo_pair/source.ply",
        "cli/demo_pair/target.ply",
        "cli/demo_pair/truth.json",
        "cli/demo_pair/LICENSE.md",
        "cli/demo_views/view0.ply",
        "cli/demo_views/poses.json",
        "cli/demo_views/LICENSE.md",
    ],
)
def test_the_wheel_holds_what_is_opened_at_run_time(wheel, name):
    assert wheel.getinfo(f"cfr_jax/{name}").file_size > 0 or name == "py.typed"


def test_weights_that_have_a_card_are_in_the_wheel(wheel):
    from cfr_jax.weights import cards
    from cfr_jax.weights.files import DEFAULT

    held = {name for name in wheel.namelist() if name.startswith("cfr_jax/weights/shipped/")}
    for name in {*cards.names(), DEFAULT}:
        assert {
            f"cfr_jax/weights/shipped/{name}.{end}" for end in ("safetensors", "json", "md")
        } <= held


def test_the_wheel_stays_small_enough_for_an_index(wheel):
    assert sum(info.compress_size for info in wheel.infolist()) < 10e6


def test_the_metadata_carries_version_license_and_command(wheel):
    # given
    [metadata] = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    folder = metadata.rpartition("/")[0]

    # when
    text = wheel.read(metadata).decode()
    commands = wheel.read(f"{folder}/entry_points.txt").decode()

    # then
    assert f"\nVersion: {cfr_jax.__version__}\n" in text
    assert "\nLicense-Expression: MIT\n" in text
    assert f"{folder}/licenses/LICENSE" in wheel.namelist()
    assert "cfr = cfr_jax.cli:main" in commands


def test_what_files_import_at_once_is_installed_always():
    assert third_party_imports(at_the_top=True) <= requirement_names(PROJECT["dependencies"])


def test_what_files_import_when_they_run_is_installed_by_a_dependency_or_an_extra():
    # given
    extras = PROJECT["optional-dependencies"]
    offered = {name for key in extras if key != "dev" for name in extras[key]}

    # when
    needed = third_party_imports(at_the_top=False)

    # then
    assert needed <= requirement_names([*PROJECT["dependencies"], *offered])


def test_every_requirement_has_a_lower_bound_and_no_cap():
    """`.ci/nightly` installs the lowest versions stated, `.ci/run` the newest."""
    runtime = [PROJECT["dependencies"]]
    runtime += [value for key, value in PROJECT["optional-dependencies"].items() if key != "dev"]
    stated = [each for group in runtime for each in group]
    assert len(stated) > 10
    for requirement in stated:
        assert re.match(r"[\w.-]+>=[\d.]+(;.*)?$", requirement), requirement


def test_the_source_archive_holds_what_git_holds_of_it(tmp_path):
    # given
    tracked = subprocess.run(
        ["git", "ls-files"], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout.splitlines()
    aside = (".ci/", ".gitignore")  # of the repository, not of what is published

    # when
    built = next(SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"]))
    with tarfile.open(built) as archive:
        packed = {member.name.partition("/")[2] for member in archive if member.isfile()}

    # then
    assert packed - {"PKG-INFO", ".gitignore"} == {
        name for name in tracked if not name.startswith(aside)
    }


def test_registering_imports_nothing_that_only_training_needs():
    code = (
        "import sys; from cfr_jax.cli import main; import numpy as np, cfr_jax as cfr\n"
        "x = np.random.default_rng(0).normal(size=(80, 3)); cfr.align(x, x, refine=False)\n"
        "print(sorted({'optax', 'orbax', 'ml_collections', 'h5py'} & set(sys.modules)))"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert child.stdout.strip() == "[]", child.stdout + child.stderr


def test_every_extra_that_a_message_names_exists():
    named = {
        extra
        for path in [*PACKAGE.rglob("*.py"), ROOT / "README.md"]
        for match in re.findall(
            r'pip install "(?:cfr_jax|\.)\[([\w,]+)\]"', path.read_text("utf-8")
        )
        for extra in match.split(",")
    }
    wanted = {"io", "viz", "torch", "rerun", "completion"}
    assert wanted <= named <= set(PROJECT["optional-dependencies"])


@pytest.mark.slow
@pytest.mark.parametrize("form", ["wheel", "source"])
def test_it_installs_and_runs_in_an_empty_environment(form, wheel, tmp_path):
    # given
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env/bin/python"
    what = wheel.filename if form == "wheel" else str(ROOT)

    def run(*command: str) -> str:
        child = subprocess.run(
            command, capture_output=True, text=True, cwd=tmp_path, env={"HOME": str(tmp_path)}
        )
        assert child.returncode == 0, child.stdout + child.stderr
        return child.stdout

    # when
    subprocess.run([python, "-m", "pip", "install", "--quiet", what], check=True)

    # then: from another folder than the sources
    cfr = str(tmp_path / "env/bin/cfr")
    assert run(cfr, "--version") == run(str(python), "-m", "cfr_jax", "--version")
    assert cfr_jax.__version__ in run(cfr, "--version")
    assert json.loads(run(cfr, "models", "--json"))["models"][0]["name"] == "object"
    where = run(str(python), "-c", "import cfr_jax; print(cfr_jax.__file__)")
    assert where.startswith(str(tmp_path))
    demo = Path(where.strip()).parent / "cli" / "demo_pair"
    (tmp_path / "pairs.csv").write_text(f"{demo}/source.ply,{demo}/target.ply\nnone.ply,none.ply\n")
    told = run(cfr, "batch", "pairs.csv", "--out", "results.csv", "--max-points", "300")
    assert "registered  1" in told and "failed      none.ply" in told

"""Every code block of the README and of the docs runs, or says why it does not.

Python blocks of a page run one after the other, in a process of their own and in a folder with two
sample files. `cfr …` lines of shell blocks run there, too. Other commands are not run: the file,
the target of make, or the extra that they name must exist. `<!-- not run: WHY -->` before a block
leaves it out; its `cfr` lines must still parse, and the blocks left out are counted here.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import jax
import pytest

from cfr_jax import cli, io
from cfr_jax.data.pairs import CsvPairs

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "cfr_jax" / "cli" / "demo_pair"
PAGES = {
    path.name: path
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]
}
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
    "optional-dependencies"
]
# Commands that are parsed and not run: they need what a test does not have, or take too long.
ONLY_PARSED = {"data", "calibrate", "convert", "reproduce", "completion"}
# Blocks marked `not run`, by page: whoever adds one has to say so here.
LEFT_OUT = {"files.md": 1, "gallery.md": 10, "recipes.md": 1, "notebooks.md": 1}

BLOCK = re.compile(
    r"(?P<mark><!-- not run: [^>]+ -->\n)?^```(?P<language>[^\n`]*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    left_out: bool


def blocks_of(path: Path, *languages: str) -> list[Block]:
    found = [
        Block(match["language"].strip(), match["text"], match["mark"] is not None)
        for match in BLOCK.finditer(path.read_text("utf-8"))
    ]
    return [block for block in found if block.language in languages]


def commands_in(block: Block) -> list[list[str]]:
    """The command lines of a shell block, without prompts, comments, and what follows a pipe."""
    lines = block.text.replace("\\\n", " ").splitlines()
    if block.language == "console":
        lines = [line[2:] for line in lines if line.startswith("$ ")]
    commands = []
    for line in lines:
        words = shlex.split(line, comments=True)
        ends = [k for k, word in enumerate(words) if word in ("|", "&&", "||", ">", "2>")]
        words = words[: min(ends, default=len(words))]
        if words:
            commands.append(words)
    return commands


def shell_blocks(path: Path) -> list[Block]:
    """Shell blocks: those that say so, and those without a language that hold commands."""
    known = ("cfr ", "pip ", "make ", "python ")
    return [
        block
        for block in blocks_of(path, "sh", "bash", "console", "")
        if block.language or block.text.startswith(known)
    ]


@pytest.fixture
def samples(tmp_path) -> Path:
    """A folder with the files that the pages speak of."""
    shutil.copy(DEMO / "source.ply", tmp_path / "source.ply")
    io.write(tmp_path / "target.pcd", io.read(DEMO / "target.ply"))
    # what pages call them
    for own, called in (("source.ply", "a.ply"), ("target.pcd", "b.pcd")):
        shutil.copy(tmp_path / own, tmp_path / called)
    for own, called in (("target.ply", "b.ply"), ("source.ply", "c.ply")):
        shutil.copy(DEMO / own, tmp_path / called)
    (tmp_path / "pairs.csv").write_text("source.ply,target.pcd\na.ply,b.pcd\n")
    (tmp_path / "scans").mkdir()
    for own, called in (("source.ply", "one.ply"), ("target.ply", "two.ply")):
        shutil.copy(DEMO / own, tmp_path / "scans" / called)
    return tmp_path


def commands_in_tables(path: Path) -> list[list[str]]:
    """The `cfr …` commands that fill the last cell of a row of a table."""
    return [
        shlex.split(command)
        for line in path.read_text("utf-8").splitlines()
        if line.startswith("|")
        for command in re.findall(r"\| `(cfr [^`]+)` \|$", line)
    ]


def test_the_pairs_that_a_page_lists_are_pairs(tmp_path):
    page = (ROOT / "docs" / "train-on-your-data.md").read_text("utf-8")
    (line,) = [line for line in page.splitlines() if line.count(",") == 17]
    (tmp_path / "listed.csv").write_text(line)

    assert len(CsvPairs(tmp_path / "listed.csv")) == 1


def with_blocks(select) -> list[str]:
    return [name for name, path in PAGES.items() if any(not b.left_out for b in select(path))]


@pytest.mark.slow
@pytest.mark.parametrize("name", with_blocks(lambda path: blocks_of(path, "python")))
def test_the_python_of_a_page_runs_from_top_to_bottom(name, samples):
    # given
    blocks = [b for b in blocks_of(PAGES[name], "python") if not b.left_out]
    program = "\n\n".join(block.text for block in blocks)
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "agg",
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }

    # when
    child = subprocess.run(
        [sys.executable, "-c", program], cwd=samples, env=environment, capture_output=True,
        text=True,
    )  # fmt: skip

    # then
    assert child.returncode == 0, child.stderr[-3000:]


def python_of_all_pages(folder: Path) -> list[str]:
    """Writes the Python blocks of every page as one program; returns the names of the files."""
    made = []
    for name in with_blocks(lambda path: blocks_of(path, "python")):
        blocks = [b.text for b in blocks_of(PAGES[name], "python") if not b.left_out]
        made.append(name.replace(".md", ".py").replace("-", "_"))
        (folder / made[-1]).write_text("\n\n".join(blocks))
    assert {"README.py", "quickstart.py"} <= set(made)
    return made


def checked_types(checker: list[str], folder: Path) -> subprocess.CompletedProcess:
    pytest.importorskip(checker[0])
    found = Path(sys.executable).parent  # pyright asks the first python there for the libraries
    env = os.environ | {"PATH": f"{found}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    env |= {"MYPYPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", *checker], cwd=folder, env=env, capture_output=True, text=True,
        timeout=600,
    )  # fmt: skip


CHECKERS = {
    "pyright": ["pyright"],
    "mypy": ["mypy", "--config-file=", "--follow-imports=silent", "--ignore-missing-imports",
             "--scripts-are-modules"],
}  # fmt: skip


@pytest.mark.parametrize("checker", CHECKERS)
def test_the_python_of_the_pages_has_the_types_that_the_package_says(checker, tmp_path):
    made = python_of_all_pages(tmp_path)
    child = checked_types([*CHECKERS[checker], *made], tmp_path)
    assert child.returncode == 0, child.stdout + child.stderr


@pytest.mark.parametrize("checker", CHECKERS)
def test_the_checker_of_the_pages_sees_a_wrong_type(checker, tmp_path):
    (tmp_path / "wrong.py").write_text("import cfr_jax as cfr\ncfr.register({}, 'a', 'b')\n")
    child = checked_types([*CHECKERS[checker], "wrong.py"], tmp_path)
    assert child.returncode == 1 and "wrong.py" in child.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", with_blocks(shell_blocks))
def test_the_cfr_commands_of_a_page_run(name, samples, monkeypatch):
    pytest.importorskip("matplotlib", reason="pages draw pictures")
    monkeypatch.chdir(samples)
    for block in shell_blocks(PAGES[name]):
        for command in [] if block.left_out else commands_in(block):
            run(command)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PAGES if commands_in_tables(PAGES[name])])
def test_the_cfr_commands_in_the_tables_of_a_page_run(name, samples, monkeypatch):
    monkeypatch.chdir(samples)
    pytest.importorskip("matplotlib", reason="pages draw pictures")
    for command in commands_in_tables(PAGES[name]):
        run(command)


def run(command: list[str]) -> None:
    trained = any(word.startswith("runs/") for word in command)  # by a command that is not run
    if command[0] == "cfr" and command[1] not in ONLY_PARSED and not trained:
        assert cli.main(command[1:]) in (0, 3), shlex.join(command)  # 3: not trusted, with --strict


@pytest.mark.parametrize("name", PAGES)
def test_every_command_of_a_page_names_what_there_is(name):
    blocks = [commands_in(block) for block in shell_blocks(PAGES[name])]
    for commands in [*blocks, commands_in_tables(PAGES[name])]:
        for command in commands:
            assert names_what_there_is(command), f"{name}: {shlex.join(command)}"


def names_what_there_is(command: list[str]) -> bool:
    words = [word for word in command if "=" not in word or word.startswith("-")]
    match words:
        case [] | ["cfr", "--help" | "--version" | "COMMAND", *_]:
            return True
        case ["cfr", *rest]:
            return parses(rest)
        case ["make", *targets]:
            known = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
            return set(targets) <= set(known)
        case ["pip", "download", *_]:
            return True
        case ["pip", "install", *what]:
            ours = [word for word in what if word.startswith((".", "cfr_jax"))]
            extras = re.findall(r"[\w-]+", " ".join(re.findall(r"\[(.*?)\]", " ".join(ours))))
            return set(extras) <= set(EXTRAS)
        case ["python" | "python3", "-m", "cfr_jax", *rest]:
            return parses(rest)
        case ["python" | "python3", "-m", module, *_]:
            return (ROOT / module.replace(".", "/")).with_suffix(".py").is_file()
        case ["python" | "python3", file, *_]:
            return (ROOT / file).is_file()
        case ["apt-get", "download", package]:  # of those that the corpus is made from
            makers = (ROOT / "cfr_jax/data/making").rglob("*.py")
            return any(package in maker.read_text("utf-8") for maker in makers)
        case ["curl" | "mkdir" | "take" | "tar" | "}", *_] | ["take()", "{"]:
            return True  # of the system, and a function that a page defines of them
        case ["jupyter", "lab", file]:
            return (ROOT / file).is_file()
        case _:
            return False


def parses(arguments: list[str]) -> bool:
    try:
        cli.make_parser().parse_args(arguments)
    except SystemExit as stop:
        return not stop.code
    return True


def test_blocks_that_are_left_out_are_counted():
    counted = {
        name: sum(b.left_out for b in blocks_of(path, "python", "sh", "bash", "console", ""))
        for name, path in PAGES.items()
    }
    assert {name: count for name, count in counted.items() if count} == LEFT_OUT


def test_a_mark_belongs_to_a_block():
    for name, path in PAGES.items():
        text = path.read_text("utf-8")
        marks = text.count("<!-- not run:")
        assert marks == sum(m["mark"] is not None for m in BLOCK.finditer(text)), name


def test_the_reader_of_blocks_sees_prompts_comments_pipes_and_continuations():
    text = "```console\n$ cfr a \\\n  --b 'c d'  # why\nits answer\n$ cfr e | jq .\n```\n"
    [match] = BLOCK.finditer(text)
    block = Block(match["language"], match["text"], False)
    assert commands_in(block) == [["cfr", "a", "--b", "c d"], ["cfr", "e"]]
    assert not names_what_there_is(["cfr", "register", "a", "b", "--no-such-option"])
    assert not names_what_there_is(["make", "coffee"])
    assert not names_what_there_is(["pip", "install", ".[no-such-extra]"])
    assert not names_what_there_is(["python", "missing.py"])

"""The command `cfr` as a whole: help, complaints, exit codes."""

from __future__ import annotations

import re
import subprocess
import sys
from types import SimpleNamespace

import pytest

import cfr_jax
from cfr_jax import cli
from cfr_jax.cli import main


@pytest.fixture
def failing(monkeypatch):
    """`cfr demo` as a command that raises what it is given."""

    def set_up(error):
        def run(args):
            raise error

        def add_parser(commands):
            commands.add_parser("demo").set_defaults(run=run)

        monkeypatch.setattr(cli, "_COMMANDS", (SimpleNamespace(add_parser=add_parser),))

    return set_up


def run_cfr(*arguments: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "cfr_jax", *arguments], capture_output=True, text=True, **options
    )


def test_help_imports_neither_numpy_nor_jax():
    # given
    code = """
import sys
from cfr_jax.cli import main
code = main(sys.argv[1:])
heavy = {"jax", "flax", "numpy", "scipy", "matplotlib"} & set(sys.modules)
sys.exit(code or bool(heavy))
"""
    for arguments in (["--help"], ["--version"], ["register", "--help"], ["demo", "--help"]):
        # when
        child = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True)

        # then
        assert (child.returncode, child.stderr) == (0, b""), arguments


def test_input_that_cannot_be_read_is_refused_before_jax_is_imported(tmp_path):
    code = """
import sys
from cfr_jax.cli import main
code = main(["register", "missing.ply", "missing.ply"])
sys.exit(90 if "jax" in sys.modules else code)
"""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, cwd=tmp_path)
    assert child.returncode == cli.UNUSABLE, child.stderr


def test_the_module_is_the_command():
    child = run_cfr("--version")
    assert (child.returncode, child.stdout) == (0, f"cfr_jax {cfr_jax.__version__}\n")


def test_help_lists_every_command_and_every_exit_code(capsys):
    # when
    code = main(["--help"])

    # then
    text = capsys.readouterr().out
    commands = {command.__name__.rpartition(".")[2] for command in cli._COMMANDS}
    assert code == 0 and {"register", "demo", "convert"} <= commands
    for word in (*commands, str(cli.UNUSABLE), str(cli.INTERRUPTED), str(cli.READER_GONE)):
        assert re.search(rf"\n {{2,4}}{word}\s", text), word


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["regster"],
        ["register"],
        ["register", "a.ply"],
        ["register", "a.ply", "b.ply", "c.ply"],
        ["register", "a.ply", "b.ply", "--nosuch"],
        ["register", "a.ply", "b.ply", "--seed", "x"],
        ["register", "a.ply", "b.ply", "--seed=-1"],
        ["register", "a.ply", "b.ply", "--max-points", "0"],
        ["register", "a.ply", "b.ply", "--max", "10"],
        ["convert", "a.pth"],
    ],
)
def test_a_wrong_command_line_is_told_in_few_lines(arguments, capsys):
    # when
    code = main(arguments)

    # then
    out, err = capsys.readouterr()
    assert code == 2 and out == ""
    assert err.startswith("cfr") and "error: " in err and 1 <= err.count("\n") <= 3


@pytest.mark.parametrize("error", [ValueError("one\ntwo\nthree\nfour"), OSError(28, "disk full")])
def test_a_complaint_has_at_most_three_lines_and_no_traceback(error, failing, capsys):
    # given
    failing(error)

    # when
    code = main(["demo"])

    # then
    err = capsys.readouterr().err
    assert code == 2 and err.startswith("cfr demo: error: ")
    assert err.count("\n") <= 3 and "Traceback" not in err


def test_a_fault_of_the_program_is_not_dressed_up_as_bad_input(failing):
    failing(ZeroDivisionError("a fault"))
    with pytest.raises(ZeroDivisionError):
        main(["demo"])


def test_a_complaint_can_be_traced(failing, monkeypatch):
    failing(ValueError("whence?"))
    monkeypatch.setenv("CFR_JAX_TRACEBACK", "1")
    with pytest.raises(ValueError, match="whence"):
        main(["demo"])


def test_an_interruption_is_quiet(failing, capsys):
    failing(KeyboardInterrupt())
    assert main(["demo"]) == 130
    assert capsys.readouterr() == ("", "")


def test_a_reader_that_has_gone_is_no_error(monkeypatch):
    # given a pipe that nobody reads, and Python's usual buffering
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    command = [sys.executable, "-m", "cfr_jax", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        # when
        child.stdout.close()
        err = child.stderr.read()

    # then
    assert (child.returncode, err) == (141, b"")


@pytest.mark.parametrize("stdout", ["closed", "full"])
def test_a_standard_output_that_takes_nothing_gives_no_traceback(stdout, monkeypatch):
    # given
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    redirection = {"closed": ">&-", "full": "> /dev/full"}[stdout]
    command = f'"{sys.executable}" -m cfr_jax --help {redirection}'

    # when
    child = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True)

    # then: help that found no place at all is written to standard error, by argparse
    if stdout == "full":
        assert child.returncode == 2 and "No space left" in child.stderr
    assert "Traceback" not in child.stderr and "Exception" not in child.stderr


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (["batch", "x", "--out", "y.csv", "--no-such", "own"], "cfr batch"),
        (["data", "info", "x", "--no-such"], "cfr data info"),
        (["--no-such", "batch", "x", "--out", "y.csv"], "cfr"),
    ],
)
def test_an_unknown_option_is_told_with_its_command_and_the_help_of_it(arguments, where, capsys):
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"{where}: error: unrecognized arguments: --no-such")
    assert told.endswith(f"try {where} --help\n")

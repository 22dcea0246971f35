"""Flags that several commands have."""

import argparse

import pytest

from cfr_jax.cli import make_parser
from cfr_jax.cli.shared import flags

# Elsewhere a flag of the same name may mean something else, such as the seed of pairs to make.
REGISTERING = ("register", "batch", "merge", "export")


def options_of(command):
    """The actions of a command, by their flag."""
    [commands] = [a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)]
    return {flag: a for a in commands.choices[command]._actions for flag in a.option_strings}


@pytest.mark.parametrize("flag", flags._FLAGS)
def test_a_shared_flag_is_the_same_in_every_command_that_has_it(flag):
    found = [options[flag] for options in map(options_of, REGISTERING) if flag in options]

    assert len(found) >= 2
    for action in found:
        for field in ("help", "metavar", "default", "type", "nargs", "const"):
            assert getattr(action, field) == getattr(found[0], field)


def test_a_strict_command_says_its_exit_code():
    for command in ("register", "batch", "merge"):
        assert f"exit with {flags.UNSURE} if " in options_of(command)["--strict"].help

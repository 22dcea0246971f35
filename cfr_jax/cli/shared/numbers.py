"""Whole numbers as arguments, with clear error messages."""

from __future__ import annotations

import argparse


def positive(text: str) -> int:
    """The text as a whole number of at least 1; raises ArgumentTypeError for anything else."""
    return _whole(text, 1)


def not_negative(text: str) -> int:
    """The text as a whole number of at least 0; raises ArgumentTypeError for anything else."""
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted an integer of at least {least}")
    return value

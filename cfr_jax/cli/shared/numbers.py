"""Numbers as arguments, with clear error messages."""

from __future__ import annotations

import argparse
from typing import Literal


def positive(text: str) -> int:
    """The text as a whole number of at least 1; raises ArgumentTypeError for anything else."""
    return _whole(text, 1)


def not_negative(text: str) -> int:
    """The text as a whole number of at least 0; raises ArgumentTypeError for anything else."""
    return _whole(text, 0)


def positive_real(text: str) -> float:
    """The text as a number above 0; raises ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted a number above 0")
    return value


def scale(text: str) -> float | Literal["auto"]:
    """The text as a number above 0, or "auto"; raises ArgumentTypeError for anything else."""
    if text == "auto":
        return "auto"
    try:
        return positive_real(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}, or auto") from error


def _whole(text: str, least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"got {text!r}, wanted an integer of at least {least}")
    return value

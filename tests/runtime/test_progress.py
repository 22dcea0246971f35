"""Progress as a bar on a terminal, and as plain lines elsewhere."""

from __future__ import annotations

import io
import os
import pty

from cfr_jax.runtime.progress import Progress


def told(**options):
    stream = io.StringIO()
    with Progress(total=200, desc="registering", unit=" pairs", file=stream, **options) as bar:
        for _ in range(200):
            bar.update()
    return stream.getvalue()


def test_piped_progress_is_a_few_plain_lines():
    text = told()
    assert "\r" not in text and "\x1b" not in text
    assert 1 <= text.count("\n") <= 3 and text.endswith("\n") and "\n\n" not in text
    assert "registering: 200 of 200 pairs" in text and "left" in text


def test_piped_progress_is_plain_while_another_bar_is_open():
    alone = told()
    with Progress(total=3, desc="outer", file=io.StringIO()):
        assert told() == alone


def test_piped_progress_without_a_known_end_is_plain_too():
    stream = io.StringIO()
    for _ in Progress(iter(range(5)), desc="reading", file=stream):
        pass
    assert "\r" not in stream.getvalue() and "reading: 5" in stream.getvalue()


def test_progress_that_is_turned_off_says_nothing():
    assert told(disable=True) == ""


def test_on_a_terminal_the_bar_redraws_itself():
    # given
    leader, follower = pty.openpty()
    with open(follower, "w") as terminal:
        # when
        with Progress(total=3, desc="registering", file=terminal) as bar:
            bar.update(3)
        terminal.flush()
        text = ""
        while "100%" not in text:
            text += os.read(leader, 10_000).decode()
    os.close(leader)

    # then
    assert "\r" in text

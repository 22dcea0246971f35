"""Every message that the page of symptoms quotes is one that the program can give."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "troubleshooting.md"
# A quoted span of several words is a message, unless it starts like one of these.
COMMANDS = ("cfr ", "--", "chmod ", "pip install -U ")


def messages_of(page: str) -> list[str]:
    """The messages that a page quotes: spans of several words that are no commands."""
    prose = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)
    spans = re.findall(r"`([^`\n]+)`", prose)
    return [span for span in spans if " " in span and not span.startswith(COMMANDS)]


def texts_of(program: str) -> list[str]:
    """All strings of a program but its docstrings; what a format string fills in is `…`."""
    texts, tree = [], ast.parse(program)
    told = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if id(node) in told:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = [p.value if isinstance(p, ast.Constant) else "…" for p in node.values]
            texts.append("".join(map(str, parts)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts.append(node.value)
    return texts


def is_given(message: str, texts: list[str]) -> bool:
    """Whether one of `texts` holds the message; its `…` stand for anything."""
    pattern = re.compile(".*".join(map(re.escape, message.split("…"))))
    return any(pattern.search(text) for text in texts)


def test_every_quoted_message_is_in_the_program():
    # given
    files = (ROOT / "cfr_jax").rglob("*.py")
    texts = [text for file in files for text in texts_of(file.read_text("utf-8"))]

    # when
    messages = messages_of(PAGE.read_text("utf-8"))

    # then
    assert len(messages) > 30
    assert [message for message in messages if not is_given(message, texts)] == []


def test_a_message_that_no_program_gives_is_noticed():
    program = 'raise ValueError(f"k: got {k} neighbors, " "wanted more")'
    page = "### `k: got … neighbors, wanted less`\n`k: got …, wanted more` `cfr k` `k`\n"

    messages = messages_of(page)

    assert messages == ["k: got … neighbors, wanted less", "k: got …, wanted more"]
    assert [is_given(message, texts_of(program)) for message in messages] == [False, True]

"""Messages about what came from outside: short, and safe to show on a terminal."""

from __future__ import annotations

MOST = 600  # characters of a message
_MOST_LINES = 3
_MOST_OF_A_VALUE = 200


class Refused(ValueError):
    """Something from outside cannot be used. The message says what came and what was wanted.

    It has at most three lines and 600 characters. Control characters in it are escaped, because
    names and contents of files are quoted in it.
    """

    def __init__(self, message: object):
        super().__init__(tidy(str(message)))


def shown(value: object, most: int = _MOST_OF_A_VALUE) -> str:
    """A name or value as one line of at most `most` characters, control characters escaped.

    Of a longer text, the beginning and the end are shown.
    """
    try:
        text = str(value)
    except ValueError:  # Python writes out no integer of more than 4,300 digits
        text = f"a {type(value).__name__} too long to show"
    return _shortened("".join(map(_escaped, _shortened(text, most))), most)


def tidy(message: str) -> str:
    """A message of at most three lines and 600 characters, without control characters."""
    lines = message[: 8 * MOST].split("\n")[:_MOST_LINES]
    return _shortened(escaped("\n".join(lines)), MOST)


def escaped(text: str) -> str:
    """The text with all control characters but line feeds as `\\x1b` and the like."""
    return "\n".join("".join(map(_escaped, line)) for line in text.split("\n"))


def _escaped(character: str) -> str:
    if character.isprintable() or character == "\N{NO-BREAK SPACE}":
        return character
    return character.encode("unicode_escape").decode()


def _shortened(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    end = most // 3
    return f"{text[: most - end - 1]}…{text[-end:]}"

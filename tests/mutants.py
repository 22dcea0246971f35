"""Damage to files: of any bytes, and of what is written in them, so that readers come farther."""

from __future__ import annotations

import copy
import json
import random
import re
from typing import Any

# Stand for texts that `json` does not write.
_RAW = {
    '"@deep"': "[" * 50_000,
    '"@nested"': "[" * 900 + "]" * 900,
    '"@nan"': "NaN",
    '"@infinite"': "-Infinity",
    '"@digits"': "9" * 6000,
    '"@exponent"': "1e99999",
    '"@surrogate"': '"\\ud800"',
    '"@nothing"': "",
}
STRANGE = (
    None, True, False, 0, 1, -1, 3, 2**31, 2**53 + 1, 2**63 - 1, 2**63, 2**64, -(10**30), 10**400,
    0.0, -0.0, 0.5, 1e-320, 1e16, -1e300, "", "a", "1", "nan", "\x1b[2J\x07", "a\0b", "a\nb\r\nc",
    "../" * 50, "/dev/zero", "=1+1", "\u202e\u2028", "x" * 5000, [], {}, [[]], [None], [1, 2, 3],
    [[1, 0, 0, 0]] * 4, {"a": 1}, {"": {}}, *(raw.strip('"') for raw in _RAW),
)  # fmt: skip

_PART = 1 << 16  # bytes


def mutate(data: bytes, generator: random.Random) -> bytes:
    """One to three damages, more of them in the first bytes, where headers are."""
    damaged = bytearray(data)
    for _ in range(generator.choice((1, 1, 1, 2, 3))):
        size = len(damaged)
        reach = generator.choice((size, size, min(size, 400)))
        at = generator.randrange(reach) if reach else 0
        kind = generator.choice(
            ("flip", "flip", "cut", "insert", "swap", "repeat", "digit", "digit", "word", "extreme")
        )
        if size < 16 or kind == "cut":
            del damaged[at:]
        elif kind == "flip":
            damaged[at] ^= 1 << generator.randrange(8)
        elif kind == "insert":
            damaged[at:at] = generator.randbytes(generator.choice((1, 2, 4, 100)))
        elif kind == "swap":
            other = generator.randrange(size)
            damaged[at], damaged[other] = damaged[other], damaged[at]
        elif kind == "repeat":
            length = generator.choice((1, 8, 64, 512))
            damaged[at:at] = damaged[at : at + length] * generator.choice((1, 3))
        elif kind == "digit":
            digits = [match.start() for match in re.finditer(rb"[0-9]", damaged)]
            headers = [digit for digit in digits if digit < 400]
            if digits:
                where = generator.choice(headers if headers and at < 400 else digits)
                damaged[where : where + 1] = generator.choice(
                    (b"9", b"0", b"-1", b"99999999", b"1e300", b"nan", b"", b"x")
                )
        elif kind == "word":
            length = generator.choice((2, 4, 8))
            value = generator.choice((0, 1, 2 ** (8 * length - 1), 2 ** (8 * length) - 1))
            damaged[at : at + length] = value.to_bytes(length, "little")
        else:  # counts and lengths just beyond what is there
            damaged[at : at + 4] = (generator.choice((size, 50_000, 1 << 24))).to_bytes(4, "little")
    return bytes(damaged)


def mutate_part(data: bytes, generator: random.Random) -> bytes:
    """As `mutate`, within 64 KB at the start, at the end, or anywhere: for large files."""
    if generator.random() < 0.1:
        return data[: generator.randrange(len(data))]
    last = max(len(data) - _PART, 0)
    at = generator.choice((0, 0, last, generator.randrange(last + 1)))
    return data[:at] + mutate(data[at : at + _PART], generator) + data[at + _PART :]


def mutate_json(value: Any, generator: random.Random) -> bytes:
    """JSON of the value after one to three changes of its members."""
    holder = [json.loads(json.dumps(value))]
    for _ in range(generator.choice((1, 1, 2, 3))):
        _change(holder, generator)
    text = json.dumps(holder[0])
    for mark, raw in _RAW.items():
        text = text.replace(mark, raw)
    data = text.encode()
    return mutate(data, generator) if generator.random() < 0.1 else data


def _change(holder: list, generator: random.Random) -> None:
    """Changes one member somewhere below the only member of `holder`."""
    places = list(_places(holder))
    parent, key = generator.choice(places)
    kind = generator.choice(("replace",) * 5 + ("delete", "repeat", "rename", "swap", "wrap"))
    if kind == "replace" or (kind in ("delete", "repeat", "rename") and parent is holder):
        parent[key] = copy.deepcopy(generator.choice(STRANGE))
    elif kind == "delete":
        del parent[key]
    elif kind == "repeat" and isinstance(parent, list):
        parent[key:key] = [parent[key]] * generator.choice((1, 1, 3, 2000))
    elif kind in ("repeat", "rename"):
        if isinstance(parent, dict):
            parent[generator.choice(("", "a", key + " ", "\x1b", "x" * 3000))] = parent.pop(key)
    elif kind == "swap":
        other, place = generator.choice(places)
        if other[place] is not parent and not _holds(other[place], parent):
            if not _holds(parent[key], other):
                parent[key], other[place] = other[place], parent[key]
    else:
        parent[key] = [parent[key]] if generator.random() < 0.5 else {"value": parent[key]}


def _places(value: Any) -> Any:
    """Every member below the value: what holds it, and where."""
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])


def _holds(value: Any, other: Any) -> bool:
    return value is other or any(holder[key] is other for holder, key in _places(value))


_CELLS = (
    "", " ", "a.ply", "#", "source", "1", "nan", "-1e400", "0x10", "1_0", "=cmd", '"', '""', '"a',
    "\0", "\r", "\n", "\x1b[31m", "\u2028", "\ufeff", "x" * 5000, "y" * 140_000, "/dev/zero", "..",
    "é", "١", ";", "1e308", ",,,", "\t",
)  # fmt: skip


def mutate_table(rows: list[list[str]], generator: random.Random) -> bytes:
    """Comma-separated text of the rows after some changes of cells and lines."""
    rows = [list(row) for row in rows]
    for _ in range(generator.choice((1, 2, 4))):
        row = generator.randrange(len(rows))
        kind = generator.choice(("cell",) * 4 + ("insert", "delete", "repeat", "line"))
        place = generator.randrange(len(rows[row]) + 1)
        if kind == "cell" and rows[row]:
            rows[row][place % len(rows[row])] = generator.choice(_CELLS)
        elif kind == "insert":
            rows[row].insert(place, generator.choice(_CELLS))
        elif kind == "delete":
            del rows[row][place:]
        elif kind == "repeat":
            rows[row:row] = [list(rows[row])] * generator.choice((1, 2, 3000))
        else:
            rows[row] = [generator.choice(_CELLS)]
    text = generator.choice(("\n", "\n", "\n", "\r\n", "\r")).join(map(",".join, rows))
    data = text.encode(generator.choice(("utf-8",) * 8 + ("utf-16", "utf-8-sig")))
    return mutate(data, generator) if generator.random() < 0.2 else data

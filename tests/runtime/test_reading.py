"""One opener for users' files: regular ones, whole, within memory; and messages that are safe."""

from __future__ import annotations

import json
import os
import random
import socket
import sys

import pytest

from cfr_jax.runtime import reading
from cfr_jax.runtime.messages import MOST, Refused, shown, tidy

KINDS = ("folder", "pipe", "device", "endless device", "socket", "kernel", "endless kernel")


def place_of(kind, folder):
    """A path to something that is no file of data."""
    path = folder / "it"
    match kind:
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/null")
        case "endless device":
            path.symlink_to("/dev/zero")
        case "socket":
            os.chdir(folder)  # names of sockets are short
            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind("it")
        case "kernel":
            path.symlink_to("/proc/self/status")
        case "endless kernel":
            path.symlink_to("/proc/kmsg")
    return path


@pytest.mark.skipif(sys.platform != "linux", reason="files of the kernel")
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_of_data_is_refused_in_words(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = place_of(kind, tmp_path)
    with pytest.raises(Refused, match="is a folder|is not a regular file|is empty|cannot be read"):
        reading.contents(path)


@pytest.mark.parametrize("name", ["missing", "x" * 5000, "nu\0ll", "\udcff", "a/" * 3000])
def test_a_name_that_no_file_has_is_refused_in_words(name, tmp_path):
    with pytest.raises(Refused, match="cannot be read|is no name of a file"):
        reading.contents(tmp_path / name)


def test_a_sparse_file_larger_than_memory_is_refused_before_it_is_read(tmp_path):
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(1 << 42)
    with pytest.raises(Refused, match="is too large: [0-9,]+ bytes, wanted at most"):
        reading.contents(tmp_path / "sparse")


def test_a_file_is_read_whole_up_to_the_size_that_is_wanted(tmp_path):
    (tmp_path / "file").write_bytes(bytes(range(256)))
    assert reading.contents(tmp_path / "file", most=256) == bytes(range(256))
    with pytest.raises(Refused, match="is too large: 256 bytes, wanted at most 255"):
        reading.contents(tmp_path / "file", most=255)


def test_text_may_start_with_a_byte_order_mark_and_must_be_text(tmp_path):
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbfa\xc3\xa4")
    assert reading.text(tmp_path / "file") == "aä"
    (tmp_path / "file").write_bytes(b"abc\xff")
    with pytest.raises(Refused, match=r"is no text in UTF-8 \(byte 3\)"):
        reading.text(tmp_path / "file")


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("9223372036854775807", 2**63 - 1),
        ("-9223372036854775808", -(2**63)),
        ("9223372036854775808", 2.0**63),
        ("-9223372036854775809", -(2.0**63)),
        ("1" + "0" * 400, float("inf")),
        ("-1" + "0" * 5000, float("-inf")),
        ("1e999", float("inf")),
    ],
)
def test_integers_beyond_64_bits_become_floats(text, wanted):
    found = reading.parse_json(text)
    assert found == wanted and type(found) is type(wanted)


@pytest.mark.parametrize(
    "text", ["", "{", "NaN", "[Infinity]", "[" * 200_000, b"\xff", b"\x00\x00", "1 2", "nul"]
)
def test_what_is_no_json_is_refused(text):
    with pytest.raises(Refused):
        reading.parse_json(text)


def test_json_of_ours_comes_back_as_it_was():
    value = {"a": [1, -2.5e-300, True, None, "ä\u2028"], "b": {"c": 2**53}}
    assert reading.parse_json(json.dumps(value)) == value


def test_messages_are_short_and_safe_whatever_they_quote():
    # given
    generator = random.Random(0)
    letters = "ab \n\r\t\x00\x1b[31m\x7f\x85\u2028\u202e\ud800\U0001f600é"

    for _ in range(300):
        # when
        text = "".join(generator.choices(letters, k=generator.choice((0, 5, 700, 20_000))))
        message, name = str(Refused(text)), shown(text)

        # then
        assert len(message) <= MOST and len(name) <= 200
        assert message.count("\n") <= 2 and "\n" not in name
        assert all(letter.isprintable() for letter in message.replace("\n", "") + name)


def test_short_messages_and_names_stay_as_they_are():
    assert tidy("a.ply: is empty\nwanted é") == "a.ply: is empty\nwanted é"
    assert shown("scan 01.ply") == "scan 01.ply"
    assert shown(10**5000) == "a int too long to show"

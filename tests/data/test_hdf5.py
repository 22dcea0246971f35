"""HDF5 from strangers: only what lies in the file is read, and the process stays its own master."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time

import h5py
import numpy as np
import pytest

from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.hdf5 import child, reading
from cfr_jax.data.layout import recognize
from cfr_jax.data.pairs import Hdf5Pairs

CLOUD = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)


def write_pair(path, **members):
    """A file of one pair; each member is values, or a function that makes it in the group."""
    with h5py.File(path, "w") as file:
        group = file.create_group("pair")
        for name, value in ({"source": CLOUD, "target": CLOUD} | members).items():
            if callable(value):
                value(group, name)
            elif value is not None:
                group[name] = value
    return path


def link(kind, *arguments):
    return lambda group, name: group.__setitem__(name, kind(*arguments))


def external(place):
    """Values that lie in another file, as raw bytes."""

    def make(group, name):
        size = CLOUD.nbytes
        group.create_dataset(name, CLOUD.shape, CLOUD.dtype, external=[(str(place), 0, size)])

    return make


def virtual(place):
    def make(group, name):
        layout = h5py.VirtualLayout(CLOUD.shape, CLOUD.dtype)
        layout[:] = h5py.VirtualSource(str(place), "data", CLOUD.shape)
        group.create_virtual_dataset(name, layout)

    return make


def sized(shape, kind, **options):
    """An array of which nothing was ever written."""
    return lambda group, name: group.create_dataset(name, shape, kind, **options)


def strangers(folder):
    """Members that are not what they should be, by kind, and what is said of them."""
    secret = folder / "secret.bin"
    secret.write_bytes(bytes(CLOUD.nbytes))
    with h5py.File(folder / "other.h5", "w") as file:
        file["data"] = CLOUD
    return {
        "external values": (external(secret), "lies in other files"),
        "external values in a pipe": (external(folder / "pipe"), "lies in other files"),
        "an external link": (link(h5py.ExternalLink, "other.h5", "data"), "is an external link"),
        "a link to a pipe": (link(h5py.ExternalLink, "pipe", "data"), "is an external link"),
        "a soft link": (link(h5py.SoftLink, "/pair/target"), "is a soft link"),
        "a soft link to itself": (link(h5py.SoftLink, "/pair/source"), "is a soft link"),
        "a dangling link": (link(h5py.SoftLink, "/nowhere"), "is a soft link"),
        "virtual values": (virtual(folder / "other.h5"), "made of other arrays"),
        "a group": (lambda group, name: group.create_group(name), "is no array"),
        "a type": (lambda group, name: group.__setitem__(name, np.dtype("f4")), "is no array"),
        "no space": (lambda group, name: group.__setitem__(name, h5py.Empty("f4")), "is no array"),
        "texts": (["a", "b"], "wanted numbers"),
        "fixed texts": (np.array([b"a", b"b"]), "wanted numbers"),
        "records": (np.zeros(3, "f4,f4,f4"), "wanted numbers"),
        "complex numbers": (CLOUD + 1j, "wanted numbers"),
        "lists": (sized((3,), h5py.vlen_dtype(np.float32)), "wanted numbers"),
        "references": (sized((3,), h5py.ref_dtype), "wanted numbers"),
        "a shape of terabytes": (sized((10**12, 3), "f4", chunks=(1000, 3)), "unfolds to more"),
        "a packed shape of gigabytes": (
            sized((10**9, 3), "f4", chunks=(10**6, 3), compression="gzip"),
            "unfolds to more",
        ),
        "a chunk of gigabytes": (
            sized((9, 3), "f4", chunks=(3 * 10**7, 30), maxshape=(None, None)),
            "unfolds to more",
        ),
    }


KINDS = (
    "external values", "external values in a pipe", "an external link", "a link to a pipe",
    "a soft link", "a soft link to itself", "a dangling link", "virtual values", "a group",
    "a type", "no space", "texts", "fixed texts", "records", "complex numbers", "lists",
    "references", "a shape of terabytes", "a packed shape of gigabytes", "a chunk of gigabytes",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("member", ["source", "target", "source_normals", "transform", "overlap"])
def test_a_member_of_a_pair_that_is_not_what_it_should_be_is_refused(kind, member, tmp_path):
    # given
    os.mkfifo(tmp_path / "pipe")
    made, told = strangers(tmp_path)[kind]
    path = write_pair(tmp_path / "pairs.h5", **{member: made})

    # when, then
    with pytest.raises(ValueError, match=f"pairs.h5 .*{member} .*{told}") as caught:
        Hdf5Pairs(path)[0]
    assert len(str(caught.value)) <= 600


@pytest.mark.parametrize(
    ("kind", "member"),
    [
        (kind, member)
        for member in ("data", "normal", "label", "names")
        for kind in KINDS
        if (member, kind) not in {("names", "texts"), ("names", "fixed texts")}
    ],
)
def test_a_member_of_a_corpus_that_is_not_what_it_should_be_is_refused(kind, member, tmp_path):
    # given
    os.mkfifo(tmp_path / "pipe")
    made, told = strangers(tmp_path)[kind]
    if member == "names":
        told = "wanted a list of texts" if told == "wanted numbers" else told
    members = {"data": CLOUD[None], "normal": CLOUD[None], "label": np.zeros(1, np.uint8)}
    with h5py.File(tmp_path / "corpus.h5", "w") as file:
        for name, value in (members | {member: made}).items():
            if callable(value):
                value(file, name)
            else:
                file[name] = value

    # when, then
    with pytest.raises(ValueError, match=f"corpus.h5 .*{member} .*{told}"):
        read_corpus(tmp_path / "corpus.h5")


@pytest.mark.parametrize("kind", KINDS)
def test_members_that_nobody_needs_are_not_opened(kind, tmp_path):
    made, _ = strangers(tmp_path)[kind]
    path = write_pair(tmp_path / "pairs.h5", extra=made)
    np.testing.assert_array_equal(Hdf5Pairs(path)[0].source, CLOUD)


@pytest.mark.parametrize(
    ("labels", "told"),
    [
        (np.array([10**9]), "label 1000000000 is larger than 65535"),
        (np.array([-1]), "label -1 is negative"),
        (np.array([2**64 - 1], np.uint64), "label 18446744073709551615 is larger"),
        (np.array([0.0]), "`label` is float64, wanted integers"),
        (np.array([np.nan]), "`label` is float64, wanted integers"),
        (np.array([True]), "`label` is bool, wanted integers"),
        (np.zeros((0,), int), "0 labels for 1 shapes"),
        (np.array(0), None),
    ],
)
def test_labels_are_integers_in_a_range(labels, told, tmp_path):
    with h5py.File(tmp_path / "corpus.h5", "w") as file:
        file["data"] = file["normal"] = CLOUD[None]
        file["label"] = labels
    if told is None:
        assert read_corpus(tmp_path / "corpus.h5").categories == ("0",)
    else:
        with pytest.raises(ValueError, match=told):
            read_corpus(tmp_path / "corpus.h5")


@pytest.mark.parametrize("scale", [np.ones(3), "one", h5py.Empty("f4"), np.array([1j])])
def test_a_scale_that_is_no_number_is_refused(scale, tmp_path):
    with h5py.File(tmp_path / "corpus.h5", "w") as file:
        file["data"] = file["normal"] = CLOUD[None]
        file["label"] = np.zeros(1, int)
        file["normal"].attrs["scale"] = scale
    with pytest.raises(ValueError, match="normal has a scale that is no number"):
        read_corpus(tmp_path / "corpus.h5")


@pytest.mark.parametrize("frame", [np.arange(2), "first", h5py.Empty("i4")])
def test_frames_that_are_no_numbers_are_refused(frame, tmp_path):
    path = write_pair(tmp_path / "pairs.h5")
    with h5py.File(path, "a") as file:
        file["pair"].attrs["source_frame"] = frame
    with pytest.raises(ValueError, match="the group has a source_frame that is no number"):
        Hdf5Pairs(path).frames(0)


def test_links_among_the_pairs_are_passed_over(tmp_path):
    path = write_pair(tmp_path / "pairs.h5")
    with h5py.File(path, "a") as file:
        file["loop"] = h5py.SoftLink("/loop")
        file["away"] = h5py.ExternalLink("other.h5", "/pair")
        file["again"] = file["pair"]
    assert Hdf5Pairs(path).names == ("again", "pair")
    assert recognize(path).kind.name == "pair-file"


def test_texts_that_unfold_to_much_more_than_the_file_are_refused(tmp_path):
    with h5py.File(tmp_path / "corpus.h5", "w") as file:
        file.create_dataset("names", data=["x" * 5000] * 3, dtype=h5py.string_dtype())
    with pytest.raises(ValueError, match="names has a text of 5,000 characters"):
        reading.read(tmp_path / "corpus.h5", texts=["names"])


@pytest.mark.parametrize("offset", [0, 512, 1024, 65536])
def test_the_signature_is_found_after_a_block_of_something_else(offset, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w", userblock_size=offset) as file:
        file["data"] = CLOUD
    assert reading.is_hdf5(tmp_path / "a.h5")
    np.testing.assert_array_equal(
        reading.read(tmp_path / "a.h5", arrays=["data"]).arrays["data"], CLOUD
    )


def test_what_is_no_hdf5_file_is_told_without_starting_the_reader(tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "text").write_text("abc")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "text", tmp_path / "none"):
        assert not reading.is_hdf5(path)
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "none"):
        with pytest.raises(ValueError, match="is a folder|is not a regular|cannot be read"):
            reading.read(path)


def test_the_reader_answers_in_this_process_as_in_its_own(tmp_path):
    path = write_pair(tmp_path / "pairs.h5")
    request = {"path": str(path), "group": "pair", "groups": False, "budget": 1 << 20}
    request |= {"arrays": ["target", "none"], "texts": [], "attributes": []}
    before = child._limit_memory
    child._limit_memory = lambda spare: None
    try:
        header, (target,) = child.answer(request)
    finally:
        child._limit_memory = before
    assert json.loads(json.dumps(header["names"])) == ["source", "target"]
    np.testing.assert_array_equal(target, CLOUD)


def reader_process():
    return reading._reader._started()


def test_a_read_that_does_not_end_is_ended(tmp_path, monkeypatch):
    # given
    path = write_pair(tmp_path / "pairs.h5")
    pairs = Hdf5Pairs(path)
    monkeypatch.setattr(reading, "_SECONDS", 0.5)
    os.kill(reader_process().pid, signal.SIGSTOP)

    # when
    with pytest.raises(ValueError, match="pairs.h5 could not be read within 1 s|within 0 s"):
        pairs[0]

    # then the next one is fine
    monkeypatch.undo()
    np.testing.assert_array_equal(pairs[0].source, CLOUD)


def test_a_crash_of_the_library_is_told(tmp_path):
    path = write_pair(tmp_path / "pairs.h5")
    pairs = Hdf5Pairs(path)
    process = reader_process()
    os.kill(process.pid, signal.SIGSTOP)
    threading.Timer(0.5, os.kill, (process.pid, signal.SIGKILL)).start()
    with pytest.raises(ValueError, match="pairs.h5 is damaged: the HDF5 library crashed on it"):
        pairs[0]
    np.testing.assert_array_equal(pairs[0].source, CLOUD)


def test_an_interrupted_read_does_not_answer_the_next_one(tmp_path, monkeypatch):
    # given
    path = write_pair(tmp_path / "pairs.h5", target=CLOUD + 1)
    whole = reading._exactly

    def interrupted(stream, size):
        if size > 8:
            raise KeyboardInterrupt
        return whole(stream, size)

    monkeypatch.setattr(reading, "_exactly", interrupted)

    # when
    with pytest.raises(KeyboardInterrupt):
        reading.read(path, group="pair", arrays=["source"])
    monkeypatch.undo()

    # then
    found = reading.read(path, group="pair", arrays=["target"]).arrays
    np.testing.assert_array_equal(found["target"], CLOUD + 1)


_ABANDONED = """
import os, signal, sys, threading, time
from cfr_jax.data.hdf5 import reading
reading.read(sys.argv[1])
os.kill(reading._reader._process.pid, signal.SIGSTOP)
threading.Thread(target=reading.read, args=(sys.argv[1],), daemon=True).start()
time.sleep(0.5)
print("left", flush=True)
"""


def test_a_process_that_leaves_a_read_ends_cleanly(tmp_path):
    path = write_pair(tmp_path / "pairs.h5")
    began = time.monotonic()
    left = subprocess.run(
        [sys.executable, "-c", _ABANDONED, str(path)], capture_output=True, text=True, timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    assert left.returncode == 0 and left.stdout == "left\n" and time.monotonic() - began < 25


_FORKED = """
import os, sys
from cfr_jax.data.hdf5 import reading
for _ in range(3):
    reading.read(sys.argv[1], group="pair", arrays=["source"])
parent = reading._reader._process.pid
child = os.fork()
for _ in range(20):
    assert reading.read(sys.argv[1], group="pair", arrays=["source"]).arrays["source"].size == 27
if not child:
    assert reading._reader._process.pid != parent
    reading._reader.close()
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


def test_after_a_fork_each_process_has_its_own_reader(tmp_path):
    path = write_pair(tmp_path / "pairs.h5")
    subprocess.run(
        [sys.executable, "-c", _FORKED, str(path)], check=True, timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip


def test_many_threads_read_at_once(tmp_path):
    path = write_pair(tmp_path / "pairs.h5", target=CLOUD + 1)
    wrong = []

    def work(name, wanted):
        for _ in range(30):
            found = reading.read(path, group="pair", arrays=[name]).arrays
            if list(found) != [name] or not np.array_equal(found[name], wanted):
                wrong.append(name)

    threads = [
        threading.Thread(target=work, args=case)
        for case in [("source", CLOUD), ("target", CLOUD + 1)] * 3
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []

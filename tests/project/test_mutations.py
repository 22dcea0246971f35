"""Damaged files at every door but that of clouds (`test_io_mutations`): used as they are, or
refused in words, fast and small. Where a digest stands, nothing damaged is believed.

A process of its own tries them, so that a crash or a runaway allocation is a failure, and not the
end of the tests. `python tests/project/test_mutations.py '{"hdf5": 1000}' SEED` tries more of a
kind.
"""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import mutants
import numpy as np
import pytest
from peak_memory import memory, reset_peak

PACKAGE = Path(__file__).parents[2] / "cfr_jax"
SHORT = 100  # of each kind; a tenth of it where making one takes long
LONG = {
    "initial": 40_000,
    "view": 40_000,
    "pair list": 20_000,
    "journal": 40_000,
    "hdf5": 20_000,
    "weights": 10_000,
    "checkpoint": 20_000,
    "exported": 8_000,
    "authors": 2_000,
}
SECONDS = 1.0  # of the processor
BYTES, BYTES_PER_BYTE = 64 << 20, 4
_ADDRESS_SPACE = 16 << 30  # ends a runaway allocation before it takes the machine
_MOTION = [[0.0, -1.0, 0.0, 0.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 3.0], [0, 0, 0, 1]]


class Door:
    """A kind of file: how damaged ones are made, and how they are read.

    `make` writes one damaged file, and returns its path and whether reading may succeed. Where that
    is False, success means that damage was believed.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        raise NotImplementedError

    def read(self, path: Path) -> Any:
        raise NotImplementedError

    def write(self, name: str, data: bytes) -> Path:
        path = self.folder / name
        path.write_bytes(data)
        return path


class Initial(Door):
    """--initial: text, .npy and .json."""

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        kind = generator.choice(("txt", "npy", "json", "result"))
        if kind == "txt":
            rows = [[str(entry) for entry in row] for row in _MOTION]
            return self.write("t.txt", mutants.mutate_table(rows, generator)), True
        if kind == "json":
            return self.write("t.json", mutants.mutate_json(_MOTION, generator)), True
        if kind == "result":
            held = {"fitness": 1.0, "transform": _MOTION}
            return self.write("t.json", mutants.mutate_json(held, generator)), True
        path = self.folder / "t.npy"
        shape = generator.choice(
            [(4, 4)] * 3 + [(16,), (), (0,), (4,), (1, 4, 4), (2, 8), (300, 300)]
        )
        dtype = generator.choice(("<f8", ">f4", "f2", "g", "i1", "u8", "?", "c8", "U3", "S4", "V7"))
        np.save(path, np.zeros(shape, dtype))
        data = path.read_bytes()
        if generator.random() < 0.5:
            data = mutants.mutate(data, generator)
        else:
            old = generator.choice((b"'<f8'", b"(4, 4)", b"False", b"shape", b"{", b"'", b","))
            data = data.replace(old, generator.choice(
                (b"'O'", b"(10000000000000, 8)", b"(-1, 4)", b"1" * 4500, b"[" * 3000, b"", b"\0",
                 b"__import__('os')", b"'<M8[s]'", b"(True, 16)", b"None")))  # fmt: skip
        path.write_bytes(data)
        return path, True

    def read(self, path: Path) -> Any:
        from cfr_jax.cli.shared.transforms import read_transform

        found = read_transform(path)
        assert found.shape == (4, 4) and found.dtype == np.float64 and np.isfinite(found).all()


class View(Door):
    """The JSON of a result, read with its clouds, and made a scene."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        points = np.random.default_rng(0).normal(size=(40, 3))
        for role in ("source", "target"):
            np.savetxt(folder / f"{role}.xyz", points)
        cloud = {"name": "c", "points": 40, "used": 40}
        self.document = {
            "format": "cfr_jax/register/1",
            "source": cloud | {"path": "source.xyz"}, "target": cloud | {"path": "target.xyz"},
            "transform": _MOTION, "transforms": [_MOTION] * 3, "initial": None, "refined": True,
            "confidence": 0.5, "fitness": 0.25, "inlier_rmse": 0.1, "inlier_distance": 0.5,
            "warnings": ["small"], "seed": 0, "alternatives": [], "seconds": {"run": 1.0},
        }  # fmt: skip

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        return self.write("result.json", mutants.mutate_json(self.document, generator)), True

    def read(self, path: Path) -> Any:
        from cfr_jax.cli.shared import saved

        document = saved.read_result(path)
        paths = {
            role: saved.find_cloud(document, role, path, None) for role in ("source", "target")
        }
        saved.as_scene(document, **saved.read_clouds(document, paths))


class PairList(Door):
    """A list of pairs, recognized and opened as `cfr batch` does."""

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        (self.folder / "a.ply").touch()
        motion = [str(entry) for row in _MOTION for entry in row]
        rows = [["source", "target"], ["a.ply", "b.ply"], ["# c"], ["a.ply", "c.xyz", *motion]]
        return self.write("pairs.csv", mutants.mutate_table(rows, generator)), True

    def read(self, path: Path) -> Any:
        from cfr_jax.batch.jobs import jobs_of
        from cfr_jax.data.layout import recognize

        jobs, _ = jobs_of(recognize(path))
        assert len({job.key for job in jobs}) == len(jobs) > 0


class JournalFile(Door):
    """A journal of a batch. With a wrong checksum it is never believed."""

    made_with = {"weights": "0" * 64, "seed": 0}

    def __init__(self, folder: Path):
        super().__init__(folder)
        from cfr_jax.batch import checked_lines
        from cfr_jax.batch.journal import Journal

        self.checked_lines, self.journal = checked_lines, Journal
        header = {"format": "cfr_jax/batch/2", "made_with": self.made_with}
        record = {"source": "a", "target": "b", "repeat": 0, "error": None, "transform": _MOTION}
        self.values = [header, record, record | {"source": "c"}, record | {"error": "is empty"}]
        self.lines = [checked_lines.line_of(value) for value in self.values]

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        lines = list(self.lines)
        row = generator.randrange(len(lines))
        if generator.random() < 0.4:
            damaged = mutants.mutate(b"".join(lines), generator)
            return self.write("j.jsonl", damaged), self._only_whole_lines(damaged)
        changed = mutants.mutate_json(self.values[row], generator)
        if generator.random() < 0.5:  # with a checksum that fits, as somebody might write it
            check = self.checked_lines._check(changed).encode()
            lines[row] = changed[:-1] + b', "check": "' + check + b'"}\n'
            return self.write("j.jsonl", b"".join(lines)), True
        lines[row] = changed + b"\n"
        data = b"".join(lines)
        return self.write("j.jsonl", data), self._only_whole_lines(data)

    def _only_whole_lines(self, data: bytes) -> bool:
        """Whether every line is one that was written, but for one that a kill cut short."""
        *whole, _ = data.split(b"\n")
        return all(line + b"\n" in self.lines for line in whole)

    def read(self, path: Path) -> Any:
        with self.journal(path, self.made_with) as held:
            for key in held:
                assert held[key]["source"] == key[0]


class Hdf5(Door):
    """Corpora and files of pairs, as `recognize` and the readers of both see them."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        with h5py.File(folder / "other.h5", "w") as file:
            file["data"] = np.zeros((9, 3), np.float32)
        self.cloud = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
        self.whole = {}
        for name in ("corpus.h5", "pairs.h5"):
            self._build(folder / name, random.Random(0), strange=0.0)
            self.whole[name] = (folder / name).read_bytes()

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        name = generator.choice(tuple(self.whole))
        if generator.random() < 0.5:
            return self.write(name, mutants.mutate(self.whole[name], generator)), True
        (self.folder / name).unlink(missing_ok=True)
        self._build(self.folder / name, generator, strange=0.4)
        return self.folder / name, True

    def _build(self, path: Path, generator: random.Random, strange: float) -> None:
        members: dict[str, Any] = {"source": self.cloud, "target": self.cloud}
        members |= {"transform": np.eye(4), "overlap": 0.5}
        if path.name == "corpus.h5":
            members = {"data": self.cloud[None], "normal": self.cloud[None]}
            members |= {"label": np.zeros((1, 1), np.uint8), "names": ["a"]}
        with h5py.File(path, "w") as file:
            place = file if path.name == "corpus.h5" else file.create_group("pair")
            for name, value in members.items():
                if generator.random() < strange:
                    self._strange(place, name, generator)
                else:
                    place[name] = value
            held = "normal" in place.keys() and place.get("normal", getlink=True)
            owner = place["normal"] if isinstance(held, h5py.HardLink) else place
            if generator.random() < 0.9:
                value = generator.choice((0.5, 3, "a", np.ones(3), np.nan, h5py.Empty("f4")))
                for name in ("scale", "source_frame", "target_frame"):
                    owner.attrs[name] = 1 / 127 if not strange else value

    def _strange(self, place: Any, name: str, generator: random.Random) -> None:
        shape = generator.choice(
            [(), (0,), (1,), (9, 3), (1, 9, 3), (1, 0, 3), (9, 4), (300, 300, 3), (2, 2, 2, 2)]
        )
        kind = generator.choice("f2 f4 f8 >f4 i1 u8 ? c8 S5 V3 f4,i4".split())
        size = generator.choice((1, 10**3, 10**9, 2**40))
        options = generator.choice(({}, {"compression": "gzip"}, {"compression": "lzf"}))
        match generator.choice(
            ("values",) * 4 + ("size", "link", "type", "text", "lost", "virtual")
        ):
            case "values":
                filled = generator.choice((0, 1, 255, 1e30, np.nan))
                with np.errstate(all="ignore"), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    values = np.zeros(shape, kind)
                    if values.dtype.kind in "fiuc":
                        values += np.asarray(filled).astype(values.dtype)
                place[name] = values
            case "size":
                chunks = (generator.choice((1, 10**4, 10**7)), 3)
                place.create_dataset(
                    name, (size, 3), "f4", chunks=chunks, maxshape=(None, 3), **options
                )
            case "link":
                place[name] = generator.choice(
                    (h5py.SoftLink("/pair"), h5py.SoftLink(f"/{name}"), h5py.SoftLink("."),
                     h5py.ExternalLink("other.h5", "data"), h5py.ExternalLink("/dev/zero", "/"))
                )  # fmt: skip
            case "type":
                place[name] = generator.choice((np.dtype("f4"), h5py.Empty("f4")))
            case "text":
                texts = ["a", "x" * generator.choice((1, 5000, 10**6))]
                place.create_dataset(name, data=texts, dtype=h5py.string_dtype())
            case "virtual":
                layout = h5py.VirtualLayout((9, 3), "f4")
                layout[:] = h5py.VirtualSource("other.h5", "data", (9, 3))
                place.create_virtual_dataset(name, layout)

    def read(self, path: Path) -> Any:
        from cfr_jax.data.corpus import read_corpus
        from cfr_jax.data.layout import recognize
        from cfr_jax.data.pairs import Hdf5Pairs

        recognize(path)
        if path.name == "corpus.h5":
            assert np.isfinite(read_corpus(path).points).all()
            return
        pairs = Hdf5Pairs(path)
        for row in range(min(len(pairs), 3)):
            pairs.frames(row)
            assert np.isfinite(pairs[row].source).all()


class Weights(Door):
    """Weights: never believed with a wrong digest, and sound with the right one."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        from cfr_jax.weights import files

        self.files = files
        self.params = files.load_params("object")
        files.save_params(folder / "w.safetensors", self.params, {"made_by": "a test"})
        self.whole = (folder / "w.safetensors").read_bytes()

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        kind = generator.choice(("bytes", "header", "values"))
        length = int.from_bytes(self.whole[:8], "little")
        if kind == "bytes":
            damaged = mutants.mutate(self.whole, generator)
            return self.write("w.safetensors", damaged), damaged == self.whole
        if kind == "header":
            header = json.loads(self.whole[8 : 8 + length])
            text = mutants.mutate_json(header, generator)
            damaged = len(text).to_bytes(8, "little") + text + self.whole[8 + length :]
            # another order of the same members, or a member that nobody reads, changes nothing
            return self.write("w.safetensors", damaged), True
        from flax.traverse_util import flatten_dict, unflatten_dict

        flat = {name: np.array(leaf) for name, leaf in flatten_dict(
            self.files.uncalibrated(self.params), sep="/").items()}  # fmt: skip
        for _ in range(generator.choice((1, 2))):
            name = generator.choice(sorted(flat))
            match generator.choice(("value", "shape", "type", "drop", "rename", "add")):
                case "value":
                    value = generator.choice((np.nan, np.inf, -np.inf, 3e38, 1e-45))
                    flat[name].flat[generator.randrange(flat[name].size)] = value
                case "shape":
                    shapes = ((), (0,), (7,), (2, 3, 4), (10**6,), (1, 1, 96, 96))
                    flat[name] = np.zeros(generator.choice(shapes), np.float32)
                case "type":
                    kind = generator.choice("f2 f8 i1 u8 ?".split())
                    flat[name] = flat[name].astype(kind)
                case "drop":
                    del flat[name]
                case "rename":
                    other = generator.choice(("a", "cascade/x", "features/neighbor_0", "é" * 300))
                    flat[other] = flat.pop(name)
                case _:
                    flat[f"extra_{generator.random()}"] = np.zeros(3, np.float32)
        self.files.save_params(
            self.folder / "w.safetensors", unflatten_dict(flat, sep="/"), {"made_by": "a test"}
        )
        return self.folder / "w.safetensors", True

    def read(self, path: Path) -> Any:
        import jax

        for leaf in jax.tree.leaves(self.files.read_weights(path).params):
            assert leaf.dtype == np.float32 and np.isfinite(leaf).all()


class Checkpoint(Door):
    """A checkpoint's files and its manifest: whatever was changed is noticed."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        from cfr_jax.runtime import manifest

        self.manifest = manifest
        self.place = folder / "100"
        self._fresh()

    def _fresh(self) -> None:
        import shutil

        shutil.rmtree(self.place, ignore_errors=True)
        (self.place / "state" / "d").mkdir(parents=True)
        for name, data in (
            ("state/a", bytes(range(256))),
            ("state/d/empty", b""),
            ("about", b"{}"),
        ):
            (self.place / name).write_bytes(data)
        self.manifest.write(self.place)

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        self._fresh()
        before = self._content()
        names = ["state/a", "state/d/empty", "about", "manifest.json", "state/new"]
        path = self.place / generator.choice(names)
        kind = generator.choice(("bytes", "json", "remove", "pipe", "device", "folder"))
        if kind == "json":
            path = self.place / "manifest.json"
            value = json.loads(path.read_bytes())
            path.write_bytes(mutants.mutate_json(value, generator))
        elif kind == "bytes":
            path.write_bytes(mutants.mutate(path.read_bytes() if path.exists() else b"", generator))
        else:
            path.unlink(missing_ok=True)
            if kind == "pipe":
                os.mkfifo(path)
            elif kind == "device":
                path.symlink_to("/dev/zero")
            elif kind == "folder":
                path.mkdir()
        return self.place, self._content() == before

    def _content(self) -> dict[str, bytes | str]:
        return {
            str(path.relative_to(self.place)): path.read_bytes() if path.is_file() else "no file"
            for path in self.place.rglob("*")
            if not path.is_dir()
        }

    def read(self, path: Path) -> Any:
        self.manifest.verify(path)


class Exported(Door):
    """An exported program: nothing that was changed after it was sealed is loaded."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        import jax
        import jax.numpy as jnp

        from cfr_jax.runtime.checksums import sealed
        from cfr_jax.weights import stablehlo

        def program(a: Any, n: Any, b: Any, m: Any) -> dict[str, Any]:
            return {"transform": a.T @ b * n * m}

        cloud, count = jax.ShapeDtypeStruct((8, 3), jnp.float32), jax.ShapeDtypeStruct((), "i4")
        exported = jax.export.export(jax.jit(program))(cloud, count, cloud, count)
        self.plain = bytes(exported.serialize())
        self.sealed, self.stablehlo = sealed, stablehlo

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        whole = self.sealed(self.plain)
        if generator.random() < 0.8:
            damaged = mutants.mutate(whole, generator)
            return self.write("m.stablehlo", damaged), damaged == whole
        return self.write("m.stablehlo", self.sealed(mutants.mutate(self.plain, generator))), True

    def read(self, path: Path) -> Any:
        loaded = self.stablehlo.load_exported(path)
        assert isinstance(loaded.capacity, object) and loaded.platforms is not None


class Authors(Door):
    """Checkpoints of the authors, as .npz and .safetensors."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        from oracle.authors import random_state_dict
        from safetensors.numpy import save_file

        self.state = random_state_dict(0, iterations=1)
        np.savez(folder / "a.npz", **self.state)
        save_file(self.state, folder / "a.safetensors")
        self.whole = {name: (folder / name).read_bytes() for name in ("a.npz", "a.safetensors")}

    def make(self, generator: random.Random) -> tuple[Path, bool]:
        name = generator.choice(tuple(self.whole))
        if generator.random() < 0.5:
            return self.write(name, mutants.mutate(self.whole[name], generator)), True
        state: dict[str, Any] = dict(self.state)
        key = generator.choice(sorted(state))
        state[key] = generator.choice(
            (np.zeros(0), np.array("a"), np.full(state[key].shape, np.nan), np.zeros(10**6),
             np.zeros((3, 3), np.int8), np.zeros(state[key].shape, np.complex64))
        )  # fmt: skip
        state[generator.choice(("é", "x" * 5000, "feat_extractor_xyz.nets_a.99999999.0.bias"))] = (
            np.zeros(1)
        )
        save = generator.choice((np.savez, np.savez_compressed))
        save(self.folder / "a.npz", **state)
        return self.folder / "a.npz", True

    def read(self, path: Path) -> Any:
        from cfr_jax.weights.conversion import convert

        convert(path)


DOORS: dict[str, Callable[[Path], Door]] = {
    "initial": Initial,
    "view": View,
    "pair list": PairList,
    "journal": JournalFile,
    "hdf5": Hdf5,
    "weights": Weights,
    "checkpoint": Checkpoint,
    "exported": Exported,
    "authors": Authors,
}


def run_cases(kind: str, cases: int, seed: int) -> dict[str, Any]:
    """Tries that many damaged files, and tells what was wrong about how that went."""
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", category=ResourceWarning)  # of archives that numpy leaves
    failures: list[str] = []
    refused, slowest, largest = 0, 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        door = DOORS[kind](Path(folder))
        for warm in range(20):  # what is loaded only once is no cost of a case
            path, _ = door.make(random.Random(f"warm {warm}"))
            try:
                door.read(path)
            except ValueError:
                pass
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        for case in range(cases):
            path, may_be_read = door.make(random.Random(f"{seed} {case}"))
            where = f"{kind}, seed {seed}, case {case}"
            before, start = reset_peak(), time.process_time()
            try:
                door.read(path)
                if not may_be_read:
                    failures.append(f"{where}: damage was believed")
            except ValueError as error:
                refused += 1
                said = str(error)
                if len(said) > 600 or said.count("\n") > 2:
                    failures.append(f"{where}: said too much: {said[:300]!r}")
                elif not all(letter.isprintable() or letter == "\n" for letter in said):
                    failures.append(f"{where}: said control characters: {said[:300]!r}")
                elif not _is_ours(error):
                    failures.append(f"{where}: {type(error).__name__}: {said[:300]}")
            except BaseException as error:
                failures.append(f"{where}: {type(error).__name__}: {str(error)[:300]}")
            seconds, grown = time.process_time() - start, memory("VmHWM") - before
            size = path.stat().st_size
            if seconds > SECONDS:
                failures.append(f"{where}: took {seconds:.1f} s")
            if grown > BYTES + BYTES_PER_BYTE * size:
                failures.append(f"{where}: took {grown >> 20} MiB for {size} bytes")
            slowest, largest = max(slowest, seconds), max(largest, grown)
        os.chdir("/")
    return {"failures": failures, "refused": refused, "cases": cases, "slowest": slowest,
            "largest": largest}  # fmt: skip


def _is_ours(error: BaseException) -> bool:
    """Whether it was raised here: those of other libraries are not meant for users."""
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return place is not None and PACKAGE in Path(place.tb_frame.f_code.co_filename).parents


def in_a_child(cases: dict[str, int], seed: int) -> list[dict[str, Any]]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = subprocess.run(
        [sys.executable, __file__, json.dumps(cases), str(seed)],
        capture_output=True, text=True, timeout=7200, env=environment,
    )  # fmt: skip
    assert child.returncode == 0, child.stderr[-2000:]
    return [json.loads(line) for line in child.stdout.splitlines()]


def assert_sound(outcomes: list[dict[str, Any]], cases: dict[str, int]) -> None:
    assert [failure for outcome in outcomes for failure in outcome["failures"]] == []
    assert [outcome["cases"] for outcome in outcomes] == list(cases.values())
    for outcome in outcomes:
        assert outcome["cases"] // 3 < outcome["refused"]  # the damage was not nothing


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux tells it")
def test_damaged_files_are_refused_in_words():
    cases = {kind: SHORT // 10 if kind in ("authors", "weights") else SHORT for kind in DOORS}
    assert_sound(in_a_child(cases, 0), cases)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux tells it")
@pytest.mark.parametrize("kind", DOORS)
def test_many_damaged_files_are_refused_in_words(kind):
    assert_sound(in_a_child({kind: LONG[kind]}, 1), {kind: LONG[kind]})


if __name__ == "__main__":
    for kind, cases in json.loads(sys.argv[1]).items():
        print(json.dumps({"kind": kind} | run_cases(kind, cases, int(sys.argv[2]))), flush=True)

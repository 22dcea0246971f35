"""The open corpus: shapes from games and simulators that Debian packages, in 45 categories.

Anybody can rebuild it, byte for byte, from four packages of Debian 12. `open_cad_categories.txt`
derives the categories from the names of the meshes. 21 of them are unseen: they are not used for
training or for choosing checkpoints.
"""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from pathlib import Path

from cfr_jax.data.making.build import Report, build
from cfr_jax.data.making.furniture import FurnitureLibrary, content_of
from cfr_jax.data.making.meshes import parse_pmd, read_mesh
from cfr_jax.data.making.packages import download, extract, find_deb, version_of
from cfr_jax.data.making.samples import Item
from cfr_jax.io.mesh import Mesh
from cfr_jax.runtime.atomic import write_atomically

UNSEEN = (
    "aircraft armour_tack bathroom building_asian building_celtic building_nile commercial "
    "detail_greek door_window_fixture head helmet_crest house_farm human lamp low_plant palm seat "
    "shield_fitting statue tent_stall vehicle"
).split()

_PMD = ".dae.cached.pmd"


@dataclass(frozen=True)
class Origin:
    """A package, and which of its files hold meshes."""

    package: str
    version: str
    files: str  # regular expression for their paths
    credit: str


SOURCES = (
    Origin(
        "0ad-data",
        "0.0.26-1",
        r"mods/public/public\.zip$",
        "0 A.D., Wildfire Games, CC-BY-SA-3.0",
    ),
    Origin(
        "flightgear-data-models",
        "1:2020.3.16+dfsg-1",
        r"flightgear/Models/.*\.ac$",
        "FlightGear, Curtis L. Olson and the FlightGear team, GPL-2+",
    ),
    Origin(
        "flightgear-data-ai",
        "1:2020.3.16+dfsg-1",
        r"flightgear/AI/.*\.ac$",
        "FlightGear, Curtis L. Olson and the FlightGear team, GPL-2+",
    ),
    Origin(
        "sweethome3d-furniture",
        "1.8-1",
        r"\.sh3f$",
        "Sweet Home 3D: libraries KatorLegaz and Reallusion CC-BY-3.0 US, Scopia and "
        "BlendSwap-CC-BY CC-BY-3.0, BlendSwap-CC-0 CC0",
    ),
)


def build_open_cad(out: Path, debs: Path | None = None, quiet: bool = False) -> Report:
    """Writes `train.h5`, `val.h5`, `test.h5`, the lists of categories, and the credits into `out`.

    The packages are `.deb` files in the folder `debs`, or are downloaded with apt if it is None.
    The build needs 2 GB of disk space next to `out`. Raises ValueError if a package cannot be
    found.
    """
    work = out.with_name(f".{out.name}.packages")
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        items: list[Item] = []
        versions = {}
        for source in SOURCES:
            paths, version = unpack(source, work, debs, quiet)
            versions[source.package] = version
            if version != source.version:
                print(
                    f"{source.package}: this is version {version}; the corpus was made from "
                    f"{source.version}, so shapes may differ"
                )
            items += source_items(source.package, paths, stack)
        if not items:
            raise ValueError("the packages hold no mesh of any category")
        items.sort(key=lambda item: item.name)
        report = build(items, out, UNSEEN, quiet=quiet, categories=categories())
    seen = [category for category in categories() if category not in UNSEEN]
    left_out = "".join(f"{name}\t{why}\n" for name, why in sorted(report.left_out.items()))
    for name, text in (
        ("seen_categories.txt", "".join(f"{name}\n" for name in seen)),
        ("unseen_categories.txt", "".join(f"{name}\n" for name in UNSEEN)),
        ("left_out.tsv", left_out),
        ("CREDITS.md", credits_text(versions)),
    ):
        write_atomically(out / name, text.encode())
    shutil.rmtree(work, ignore_errors=True)
    return report


def credits_text(versions: Mapping[str, str]) -> str:
    """The credits that must stay with a corpus made from packages of these versions."""
    lines = (f"- {s.credit} (Debian package `{s.package}` {versions[s.package]})" for s in SOURCES)
    return "\n".join(
        ["# Credits", "", "The point clouds are sampled from meshes of", "", *lines, ""]
    )


def unpack(
    source: Origin, work: Path, debs: Path | None, quiet: bool = False
) -> tuple[list[Path], str]:
    """Unpacks the package's mesh files into `work`; returns their paths and its version.

    A second call finds the files there and does not unpack them again.
    """
    done = work / f"{source.package}.json"
    if done.is_file():
        found = json.loads(done.read_text())
        return [work / inside for inside in found["files"]], found["version"]
    if debs is None:
        deb = download(source.package, work)
    elif (found := find_deb(source.package, debs)) is not None:
        deb = found
    else:
        raise ValueError(f"--debs: no {source.package}_*.deb in {debs}")
    wanted = re.compile(source.files)
    into = work / source.package
    paths = sorted(extract(deb, lambda name: wanted.search(name) is not None, into, quiet))
    if not paths:
        raise ValueError(f"{deb} holds no file like {source.files}: is it another version?")
    version = version_of(deb)
    files = [path.relative_to(work).as_posix() for path in paths]
    write_atomically(done, json.dumps({"version": version, "files": files}).encode())
    if debs is None:
        deb.unlink()
    return paths, version


def source_items(package: str, paths: list[Path], stack: ExitStack) -> Iterator[Item]:
    """The meshes of a package that belong to a category. Archives stay open as long as `stack`."""
    for path in paths:
        if path.suffix == ".zip":
            archive = stack.enter_context(zipfile.ZipFile(path))
            yield from _game_items(archive)
        elif path.suffix == ".sh3f":
            library = stack.enter_context(FurnitureLibrary(path))
            yield from _furniture_items(library, path.stem)
        else:
            inside = path.as_posix().split("/flightgear/", 1)[1]
            folder, rest = inside.split("/", 1)
            rule_source = {"Models": "models", "AI": "ai"}[folder]
            rest = rest.removesuffix(".ac")
            if category := category_of(rule_source, rest):
                name = f"flightgear-{rule_source}:{rest}"
                stamp = str(path.stat().st_size)
                yield Item(name, category, partial(read_mesh, path), stamp=stamp)


def _game_items(archive: zipfile.ZipFile) -> Iterator[Item]:
    for info in archive.infolist():
        entry = info.filename
        inside = entry.removeprefix("art/meshes/").removesuffix(_PMD)
        if not (entry.startswith("art/meshes/") and entry.endswith(_PMD)):
            continue
        if category := category_of("0ad", inside):
            name = f"0ad:{inside}"
            # Games model many small things with few faces.
            yield Item(
                name,
                category,
                partial(_game_mesh, archive, entry, name),
                least_faces=50,
                stamp=str(info.CRC),
            )


def _game_mesh(archive: zipfile.ZipFile, entry: str, name: str) -> Mesh:
    return parse_pmd(content_of(archive, entry), name)


def _furniture_items(library: FurnitureLibrary, stem: str) -> Iterator[Item]:
    stamp = str(library.path.stat().st_size)
    for piece in library.pieces:
        path = f"{stem}/{piece.identifier}"
        if category := category_of("furniture", f"{path}|{piece.name}|{piece.category}"):
            name = f"sweethome3d:{path}"
            yield Item(name, category, partial(library.mesh, piece), stamp=stamp)


def category_of(source: str, path: str) -> str | None:
    """The category of a mesh by the rules in `open_cad_categories.txt`, or None to leave it out."""
    for category, pattern in _rules()[source]:
        if pattern.search(path):
            return None if category == "-" else category
    return None


def categories() -> list[str]:
    """All categories that the rules name, sorted. Labels are indices into this list."""
    return sorted({rule[0] for rules in _rules().values() for rule in rules} - {"-"})


@cache
def _rules() -> dict[str, list[tuple[str, re.Pattern[str]]]]:
    rules: dict[str, list[tuple[str, re.Pattern[str]]]] = {}
    text = files("cfr_jax.data.making").joinpath("open_cad_categories.txt").read_text()
    for line in text.splitlines():
        if line and not line.startswith("#"):
            category, source, pattern = line.split(maxsplit=2)
            rules.setdefault(source, []).append((category, re.compile(pattern, re.IGNORECASE)))
    return rules

"""The meshes of a folder on their way into a corpus, each with its category."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.data.making.meshes import read_mesh
from cfr_jax.data.making.samples import Item
from cfr_jax.io.formats import by_suffix
from cfr_jax.io.mesh import Mesh
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import text

_LARGEST_LIST = 1 << 24  # bytes


def folder_items(
    folder: Path, least_faces: int = 20, files: str = "*", classes: Path | None = None
) -> list[Item]:
    """The meshes in a folder and its subfolders, without hidden files.

    The category of a mesh is the name of the top-level subfolder, or of the folder itself if it
    lies there. With `classes`, a file as `read_classes` reads it, only the meshes that it lists are
    taken, from anywhere in the folder, and it gives the category.

    Args:
        folder: where the meshes are.
        least_faces: of a mesh that is fit, see `make_shape`.
        files: a pattern for the path below the folder, such as "*/test/*"; `*` stands for any text.
        classes: a classification file.

    Raises ValueError if there is no mesh, or if `classes` cannot be read.
    """
    if not folder.is_dir():
        raise ValueError(f"folder: there is no folder {folder} to take meshes from")
    suffixes = by_suffix(mesh_formats())
    paths = sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )
    if not paths:
        raise ValueError(
            f"folder: no mesh below {folder}, wanted files that end in {' '.join(suffixes)}"
        )
    matched = [path for path in paths if fnmatchcase(path.relative_to(folder).as_posix(), files)]
    if not matched:
        raise ValueError(
            f"files: none of {len(paths)} meshes below {folder} matches {files!r}, "
            f"such as {paths[0].relative_to(folder).as_posix()}"
        )
    make = partial(_item, folder, least_faces)
    if classes is None:
        return [make(path, _top_folder(folder, path)) for path in matched]
    return list(_listed(matched, classes, make))


def _item(folder: Path, least_faces: int, path: Path, category: str) -> Item:
    stat = path.stat()
    return Item(
        name=path.relative_to(folder).as_posix(),
        category=category,
        load=partial(read_mesh, path),
        least_faces=least_faces,
        stamp=f"{stat.st_size} {stat.st_mtime_ns}",
    )


def _top_folder(folder: Path, path: Path) -> str:
    inside = path.relative_to(folder)
    return inside.parts[0] if len(inside.parts) > 1 else folder.resolve().name


def _listed(paths: list[Path], classes: Path, make: Callable[[Path, str], Item]) -> Iterator[Item]:
    """The meshes of a classification; those that are not there cannot be read."""
    known = read_classes(classes)
    missing = dict(known)
    for path in paths:
        for model in (path.stem, path.stem.removeprefix("m")):
            if model in known:
                missing.pop(model, None)
                yield make(path, known[model])
                break
    if len(missing) == len(known):
        raise ValueError(
            f"classes: none of the {len(known)} models of {shown(classes)} is among the meshes, "
            f"such as {next(iter(known))!r} beside {paths[0].name}"
        )
    for model, category in missing.items():
        yield Item(f"model {model}", category, partial(_absent, classes))


def _absent(classes: Path) -> Mesh:
    raise ValueError(f"{classes.name} lists it, but there is no file of that name")


def read_classes(path: Path) -> dict[str, str]:
    """The class of each model, from a `.cla` file of the Princeton Shape Benchmark, version 1.

    It lists classes, each as its name, its parent ("0" for none) and its number of models, followed
    by these models. Model 17 is a file `17` or `m17`, with the suffix of a mesh. Raises ValueError,
    saying where, if the file is not complete, or if a model is in two classes.
    """
    try:
        words = text(path, _LARGEST_LIST).split()
        return _classes(words)
    except Refused as error:
        raise Refused(f"classes: {shown(path)}: {error}") from None


def _classes(words: list[str]) -> dict[str, str]:
    if words[:2] != ["PSB", "1"]:
        raise Refused(f"starts with {shown(' '.join(words[:2]))!r}, wanted 'PSB 1'")
    wanted, models = (_count(word) for word in (words[2:4] + ["", ""])[:2])
    found: dict[str, str] = {}
    names = {"0"}
    at = 4
    while at < len(words):
        name, parent, count = (words[at : at + 3] + ["", ""])[:3]
        inside = words[at + 3 : at + 3 + _count(count)]
        if len(inside) < _count(count):
            raise Refused(f"ends after {len(inside)} of {count} models of the class {shown(name)}")
        if name in names or parent not in names:
            raise Refused(
                f"the class {shown(name)} of {shown(parent)} must come once, after its parent"
            )
        if twice := next((model for model in inside if model in found), None):
            raise Refused(f"model {shown(twice)} is in {found[twice]} and in {shown(name)}")
        found.update((model, name) for model in inside)
        names.add(name)
        at += 3 + len(inside)
    if (len(names) - 1, len(found)) != (wanted, models):
        raise Refused(
            f"promises {models} models in {wanted} classes, lists {len(found)} in {len(names) - 1}"
        )
    return found


def _count(word: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) < 10):
        raise Refused(f"got {shown(word)!r}, wanted a count")
    return int(word)

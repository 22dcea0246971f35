import re
import zipfile
from collections import Counter
from importlib.resources import files

import mesh_samples as samples
import numpy as np
import pytest

from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.making import build as building
from cfr_jax.data.making import open_cad
from cfr_jax.data.making.open_cad import SOURCES, UNSEEN, build_open_cad, category_of

FLIGHTGEAR = "usr/share/games/flightgear"


def knot(seed):
    scale = (1.0, 0.25 + 0.06 * seed, 0.2)
    return samples.knot(seed, 60, scale, corners=True)


def game_mesh(seed):
    mesh = knot(seed)
    return samples.pmd(mesh, mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def debs(tmp_path_factory):
    """The four packages, with one or two meshes from a few categories."""
    folder = tmp_path_factory.mktemp("debs")
    game = folder / "public.zip"
    with zipfile.ZipFile(game, "w") as archive:
        for seed, name in enumerate(
            ["gaia/oak1", "gaia/palm_fan_a", "props/temple_foundation", "test/reservoir"]
        ):
            archive.writestr(f"art/meshes/{name}.dae.cached.pmd", game_mesh(seed))
        archive.writestr("art/meshes/gaia/oak2.dae.cached.pmd", game_mesh(0))  # oak1 again
        few = samples.knot(0, 12)
        archive.writestr("art/meshes/gaia/pine.dae.cached.pmd", samples.pmd(few, few.vertices))
        archive.writestr("art/textures/oak1.dds", b"no mesh")
    library = folder / "BlendSwap-CC-0.sh3f"
    samples.sh3f(
        library,
        {
            "L#glas": ("Beer glass", "Kitchen", knot(5)),
            "L#fauteuil": ("Armchair", "Living room", knot(6)),
        },
    )
    contents = {
        "0ad-data_0.0.26-1_all.deb": {
            "usr/share/games/0ad/mods/public/public.zip": game.read_bytes()
        },
        "flightgear-data-models_1_all.deb": {
            f"{FLIGHTGEAR}/Models/Maritime/Civilian/Barge.ac": samples.ac3d(knot(7)).encode(),
            f"{FLIGHTGEAR}/Models/Residential/House.ac": samples.ac3d(knot(8)).encode(),
            f"{FLIGHTGEAR}/Models/Weather/cloud.ac": samples.ac3d(knot(9)).encode(),
        },
        "flightgear-data-ai_1_all.deb": {
            f"{FLIGHTGEAR}/AI/Aircraft/747/Models/747.ac": samples.ac3d(knot(10)).encode(),
        },
        "sweethome3d-furniture_1.8-1_all.deb": {
            f"usr/share/sweethome3d/furniture/{library.name}": library.read_bytes()
        },
    }
    for name, entries in contents.items():
        samples.deb(folder / name, entries)
    return folder


def test_the_packages_become_a_corpus_of_seen_and_unseen_shapes(debs, tmp_path):
    out = tmp_path / "open_cad"
    report = build_open_cad(out, debs, quiet=True)
    shapes = {}
    for split in ("train", "val", "test"):
        if (out / f"{split}.h5").is_file():
            corpus = read_corpus(out / f"{split}.h5")
            shapes |= {
                name: (corpus.categories[label], split == "test")
                for name, label in zip(corpus.names, corpus.labels, strict=True)
            }
    assert report.left_out == {
        "0ad:gaia/oak2": "repeats 0ad:gaia/oak1",
        "0ad:gaia/pine": "fewer than 50 faces with an area",
    }
    assert shapes == {
        "0ad:gaia/oak1": ("broadleaf_tree", False),
        "0ad:gaia/palm_fan_a": ("palm", True),
        "0ad:props/temple_foundation": ("rubble_pile", False),
        "sweethome3d:BlendSwap-CC-0/L#glas": ("kitchen", False),
        "sweethome3d:BlendSwap-CC-0/L#fauteuil": ("seat", True),
        "flightgear-models:Maritime/Civilian/Barge": ("ship", False),
        "flightgear-models:Residential/House": ("house_farm", True),
        "flightgear-ai:Aircraft/747/Models/747": ("aircraft", True),
    }
    assert "0ad:gaia/oak2\trepeats 0ad:gaia/oak1\n" in (out / "left_out.tsv").read_text()
    assert "CC-BY-SA-3.0" in (out / "CREDITS.md").read_text()
    assert (out / "unseen_categories.txt").read_text().split() == list(UNSEEN)
    # All categories are always listed, so that labels mean the same everywhere.
    assert len((out / "shape_names.txt").read_text().split()) == 45
    assert sorted(path.name for path in tmp_path.iterdir()) == ["open_cad"]


def test_the_same_packages_give_the_same_bytes_also_after_an_interruption(
    debs, tmp_path, monkeypatch
):
    build_open_cad(tmp_path / "a", debs, quiet=True)
    monkeypatch.setattr(building, "drop_duplicates", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        build_open_cad(tmp_path / "b", debs, quiet=True)
    monkeypatch.undo()
    monkeypatch.setattr(open_cad, "extract", lambda *_: pytest.fail("unpacked a second time"))
    build_open_cad(tmp_path / "b", debs, quiet=True)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_a_missing_package_is_named(debs, tmp_path):
    with pytest.raises(ValueError, match="--debs: no 0ad-data_\\*.deb in"):
        build_open_cad(tmp_path / "out", tmp_path, quiet=True)


def test_a_package_without_its_files_is_refused(tmp_path):
    samples.deb(tmp_path / "0ad-data_9_all.deb", {"usr/share/other": b"x"})
    with pytest.raises(ValueError, match="holds no file like .*another version"):
        build_open_cad(tmp_path / "out", tmp_path, quiet=True)


@pytest.mark.parametrize(
    "source, path, category",
    [
        # A shield on a tower is a shield, and a tower under construction is a pile of rubble.
        ("0ad", "props/maur_scout_tower_shields_bell", "shield"),
        ("0ad", "structural/kart_defense_tower_foundation", "rubble_pile"),
        ("0ad", "structural/kart_wooden_tower", "tower"),
        ("0ad", "structural/brit_wall_tower", "wall"),
        ("0ad", "structural/han_siege_tower", "siege_cart"),
        ("0ad", "props/hele_trireme_foresail", "sail"),
        ("0ad", "structural/hele_ship_trireme", "ship"),
        ("0ad", "gaia/juniper_prickly_1", "conifer"),
        ("0ad", "gaia/juniper_prickly_bush_1", "low_plant"),
        ("0ad", "props/hele_house_b_nature", "garden"),
        ("0ad", "props/hele_house_b_gables", "detail_greek"),
        ("0ad", "props/celt_tc", "detail_other"),
        ("0ad", "structural/celt_tc", "building_celtic"),
        ("0ad", "props/decal_struct_2x2", None),
        ("0ad", "audio/voice", None),
        ("models", "Weather/cirrus_alt1", None),
        ("models", "Airport/Jetway/glass", "commercial"),
        ("ai", "Aircraft/f16/Models/F-16", "aircraft"),
        ("furniture", "Scopia/Scopia#kids_desk_chair|Desk chair|Office", "seat"),
        ("furniture", "L/L#desklamp|Desk lamp|Lights", "lamp"),
        ("furniture", "L/L#desk|Desk|Office", "table"),
        ("furniture", "L/L#towel3|Towel rack|Bathroom", "bed_storage"),
        ("furniture", "L/L#drum|Drum|Miscellaneous", "household"),
    ],
)
def test_the_first_rule_that_fits_gives_the_category(source, path, category):
    assert category_of(source, path) == category


def test_the_rules_are_for_all_sources_and_for_45_categories():
    text = files("cfr_jax.data.making").joinpath("open_cad_categories.txt").read_text()
    rules = [line.split(maxsplit=2) for line in text.splitlines() if line and line[0] != "#"]
    assert {source for _, source, _ in rules} == {"0ad", "models", "ai", "furniture"}
    categories = {category for category, _, _ in rules} - {"-"}
    assert len(categories) == 45 and set(UNSEEN) < categories
    assert len(UNSEEN) == 21 and max(Counter(UNSEEN).values()) == 1
    for _, _, pattern in rules:
        re.compile(pattern)


def test_every_source_has_a_credit():
    assert [source.package for source in SOURCES] == [
        "0ad-data",
        "flightgear-data-models",
        "flightgear-data-ai",
        "sweethome3d-furniture",
    ]
    text = open_cad.credits_text({source.package: f"{source.version}.7" for source in SOURCES})
    assert all(source.credit in text for source in SOURCES)
    assert all(f"`{source.package}` {source.version}.7)" in text for source in SOURCES)

"""The picture: both panels are drawn at one scale, always the same, without a display."""

import sys
import warnings

import numpy as np
import pytest

from cfr_jax.viewer import Scene, write_picture

needs_matplotlib = pytest.mark.skipif(
    "not __import__('importlib').util.find_spec('matplotlib')", reason="needs cfr_jax[viz]"
)


def make_scene(shift=(0.4, 0.3, 0.0), **changes):
    """A disc that `shift` moves onto the same disc."""
    rng = np.random.default_rng(0)
    disc = rng.normal(size=(600, 3)) * [1.0, 0.6, 0.01]
    disc = disc[np.linalg.norm(disc, axis=1) < 2]
    answer = np.eye(4)
    answer[:3, 3] = shift
    given = {
        "source": disc - shift,
        "target": disc,
        "transforms": np.stack([np.eye(4), answer]),
        "labels": ("start", "refined"),
        "facts": {"confidence": "0.97"},
    }
    return Scene(**given | changes)


def colored(path):
    """The yellow and the blue pixels of each panel, as (x, y)."""
    from matplotlib.image import imread

    image = imread(path)[:, :, :3]
    image = image[170:-90]  # below legend and titles, above the facts
    red, blue = image[:, :, 0], image[:, :, 2]
    half = image.shape[1] // 2
    return [
        [np.argwhere(mask[:, panel])[:, ::-1] for mask in (red - blue > 0.3, blue - red > 0.3)]
        for panel in (slice(0, half), slice(half, None))
    ]


@needs_matplotlib
def test_the_clouds_are_apart_before_and_overlap_after(tmp_path):
    write_picture(tmp_path / "picture.png", make_scene(shift=(1.5, 1.0, 0.0)))
    (yellow, blue), (yellow_after, blue_after) = colored(tmp_path / "picture.png")

    one, apart, together = len(blue), len(yellow) + len(blue), len(yellow_after) + len(blue_after)
    assert one > 1000 and apart > 1.5 * one
    # Two equal clouds in the same place cover the same pixels as one.
    assert together == pytest.approx(one, rel=0.05)
    assert np.linalg.norm(yellow.mean(axis=0) - blue.mean(axis=0)) > 100


@needs_matplotlib
def test_both_panels_have_one_scale_unless_the_title_says_otherwise(tmp_path):
    write_picture(tmp_path / "near.png", make_scene())
    write_picture(tmp_path / "far.png", make_scene(shift=(40.0, 0.0, 0.0)))

    before, after = (target for _, target in colored(tmp_path / "near.png"))
    assert np.ptp(before[:, 0]) == pytest.approx(np.ptp(after[:, 0]), rel=0.03)
    before, after = (target for _, target in colored(tmp_path / "far.png"))
    assert np.ptp(before[:, 0]) < 0.25 * np.ptp(after[:, 0])


@needs_matplotlib
def test_names_are_drawn_as_they_are(tmp_path):
    names = ["$x^", "line\nbreak \udcff", "点群.ply", "n" * 500, ""]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in names:
            scene = make_scene(
                source_name=name,
                facts={name: name},
                warnings=(name, "word " * 60),
                labels=(name,) * 2,
            )
            write_picture(tmp_path / "picture.png", scene)
            assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


@needs_matplotlib
def test_the_same_scene_gives_the_same_file_and_no_other(tmp_path):
    write_picture(tmp_path / "a.png", make_scene())
    write_picture(tmp_path / "b.png", make_scene())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_without_matplotlib_one_line_says_how_to_install_it(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ModuleNotFoundError, match=r'^[^\n]*pip install "cfr_jax\[viz\]"$'):
        write_picture(tmp_path / "picture.png", make_scene())

"""The page as a file: what it contains, what it allows, and what it must never do."""

import base64
import hashlib
import json
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.viewer import Scene, write_page
from cfr_jax.viewer.camera import best_view

HOSTILE = [
    "</script><img src=x onerror=alert(1)>",
    "<!--<script>",
    "{{scene}}",
    "&lt;b&gt; \u2028 \u202e \x00",
    "'\"><svg onload=alert(1)>",
    "undecodable-\udcff.ply",
]


def make_scene(count=300, offset=0.0, seed=0, **changes):
    rng = np.random.default_rng(seed)
    transforms = np.tile(np.eye(4), (3, 1, 1))
    transforms[1:, :3, :3] = Rotation.random(2, rng=rng).as_matrix()
    transforms[:, :3, 3] = rng.normal(size=(3, 3))
    given = {
        "source": rng.normal(size=(count, 3)) * [1.0, 2.0, 0.3] + offset,
        "target": rng.normal(size=(count + 50, 3)) + offset,
        "transforms": transforms,
        "labels": ("start", "iteration 1", "refined"),
        "weights": rng.uniform(size=count),
        "facts": {"fitness": "0.71"},
    }
    return Scene(**given | changes)


class Elements(HTMLParser):
    """Every element with its attributes, and the text of scripts and styles."""

    def __init__(self, page):
        super().__init__()
        self.found, self.texts, self.inside = [], [], None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.inside = (tag, dict(attributes))
        self.found.append(self.inside)

    def handle_endtag(self, tag):
        self.inside = None

    def handle_data(self, data):
        if self.inside and self.inside[0] in ("script", "style"):
            self.texts.append((*self.inside, data))

    def carried(self):
        """The scene as the page's own script reads it."""
        (text,) = [text for _, attributes, text in self.texts if attributes.get("id") == "scene"]
        return json.loads(text)


def written(tmp_path, scene, **options):
    path = tmp_path / "page.html"
    write_page(path, scene, **options)
    return Elements(path.read_text("utf-8"))


def decode(cloud):
    steps = np.frombuffer(base64.b64decode(cloud["points"]), "<i2").reshape(-1, 3)
    return steps / 32767 * cloud["size"]


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_the_page_shows_every_station_where_the_transform_puts_the_source(tmp_path, offset):
    scene = make_scene(offset=offset)
    view = best_view(scene)
    carried = written(tmp_path, scene).carried()

    def in_units(shown):
        return np.asarray(shown) * view.radii[-1] + view.center

    # Half a rounding step for clouds about 6 wide, also at far map coordinates.
    target = in_units(decode(carried["target"]) + carried["target"]["position"])
    np.testing.assert_allclose(target, scene.target, rtol=0, atol=2e-4)
    for k, station in enumerate(carried["stations"]):
        turned = Rotation.from_quat(station["rotation"]).apply(decode(carried["source"]))
        np.testing.assert_allclose(
            in_units(turned + station["position"]), scene.moved(k), rtol=0, atol=2e-4
        )


def test_weights_are_stored_with_unused_points_marked(tmp_path):
    scene = make_scene(count=4, weights=[0.0, 0.5, 7.0, np.nan])
    carried = written(tmp_path, scene).carried()
    levels = np.frombuffer(base64.b64decode(carried["source"]["weights"]), np.uint8)
    assert levels.tolist() == [0, 127, 254, 255]


def test_hostile_text_stays_text(tmp_path):
    plain = written(tmp_path, make_scene(warnings=("-",) * 6, facts=dict.fromkeys("abcdef", "")))
    for text in HOSTILE:
        scene = make_scene(
            source_name=text,
            target_name=text,
            labels=(text,) * 3,
            facts={f"{text}{k}": text for k in range(6)},
            warnings=(text,) * 6,
        )
        page = written(tmp_path, scene)
        assert page.found == plain.found  # not one element or attribute more
        carried = page.carried()
        assert carried["source"]["name"] == text
        assert carried["stations"][0]["label"] == text
        assert carried["facts"][5] == [f"{text}5", text]
        assert carried["warnings"][0] == text


def test_nothing_on_the_page_is_loaded_from_elsewhere(tmp_path):
    page = written(tmp_path, make_scene())
    for tag, attributes in page.found:
        for name in {"src", "srcset", "href", "action", "data", "poster"} & set(attributes):
            assert attributes[name].startswith("data:"), (tag, attributes)
        assert "style" not in attributes and not any(name.startswith("on") for name in attributes)
    for _, attributes, text in page.texts:
        if "id" not in attributes:
            for loader in ("http:", "https:", "url(", "@import", "fetch(", "XMLHttp", "import("):
                assert loader not in text


def test_the_policy_allows_the_pages_own_script_and_style_and_nothing_else(tmp_path):
    page = written(tmp_path, make_scene())
    (policy,) = [
        attributes["content"]
        for tag, attributes in page.found
        if attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'" and "unsafe" not in policy and "*" not in policy
    for tag in ("script", "style"):
        (text,) = [text for name, attributes, text in page.texts if name == tag and not attributes]
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert rules[f"{tag}-src"] == f"'sha256-{digest}'"


def test_full_clouds_fit_in_one_and_a_half_megabytes(tmp_path):
    scene = make_scene(count=20_000)
    write_page(tmp_path / "page.html", scene)
    assert (tmp_path / "page.html").stat().st_size <= 1_500_000


def test_thinning_keeps_the_points_the_network_used_and_says_so(tmp_path):
    weights = np.full(1000, np.nan)
    weights[::25] = 1.0
    carried = written(tmp_path, make_scene(count=1000, weights=weights), max_points=100).carried()

    levels = np.frombuffer(base64.b64decode(carried["source"]["weights"]), np.uint8)
    assert (levels == 254).sum() == 40 and len(levels) == 100
    assert (carried["source"]["count"], carried["source"]["total"]) == (100, 1000)
    assert (carried["target"]["count"], carried["target"]["total"]) == (100, 1050)


def test_the_same_scene_gives_the_same_page(tmp_path):
    for name in ("a.html", "b.html"):
        write_page(tmp_path / name, make_scene(count=500), max_points=200)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    (tmp_path / "page.html").mkdir()  # a rename cannot replace a folder
    with pytest.raises(OSError):
        write_page(tmp_path / "page.html", make_scene())
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


@pytest.mark.parametrize("count", [0, -5, True])
def test_an_invalid_point_budget_is_refused(tmp_path, count):
    with pytest.raises(ValueError, match="max_points"):
        write_page(tmp_path / "page.html", make_scene(), max_points=count)

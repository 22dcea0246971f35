"""The page of many clouds: what it holds, and what must never come of names."""

from __future__ import annotations

import base64
import json
import re
import shutil
import time

import numpy as np
import pytest

from cfr_jax.geometry import motions
from cfr_jax.viewer import CloudLayer, write_layers
from cfr_jax.viewer.layers import color

HOSTILE = "</script><img src=x onerror=alert(1)>{{layers}}"


@pytest.fixture
def layers() -> list[CloudLayer]:
    rng = np.random.default_rng(0)
    return [
        CloudLayer(f"scan {k}.ply", rng.normal(size=(50 * (k + 1), 3)) + (4e6, k, 0.0))
        for k in range(3)
    ]


def held(path) -> dict:
    text = path.read_text()
    return json.loads(re.search(r'id="layers">(.*?)</script>', text, re.DOTALL)[1])


def test_the_page_holds_every_layer_where_it_is(layers, tmp_path):
    # when
    write_layers(tmp_path / "p.html", layers, title="a model")
    # then
    shown = held(tmp_path / "p.html")
    assert [each["name"] for each in shown["layers"]] == [layer.name for layer in layers]
    places = []
    for layer, each in zip(layers, shown["layers"], strict=True):
        steps = np.frombuffer(base64.b64decode(each["points"]), "<i2").reshape(-1, 3)
        assert each["count"] == each["total"] == len(layer.points) == len(steps)
        places.append(steps * each["size"] / 32767 + each["position"])
    # one scale and one shift lay all layers on what was given
    points = np.concatenate([layer.points for layer in layers])
    seen = np.concatenate(places)
    scale = np.linalg.norm(points[0] - points[-1]) / np.linalg.norm(seen[0] - seen[-1])
    np.testing.assert_allclose(points, seen * scale + (points[0] - seen[0] * scale), atol=2e-3)
    assert motions.from_xyzw(np.array(shown["view"])).shape == (3, 3)


def test_large_layers_are_thinned_alike(layers, tmp_path):
    write_layers(tmp_path / "p.html", layers, max_points=30)
    assert [each["count"] for each in held(tmp_path / "p.html")["layers"]] == [5, 10, 15]


def test_names_are_text_and_never_html(layers, tmp_path):
    layers[0] = CloudLayer(HOSTILE, layers[0].points)
    write_layers(tmp_path / "p.html", layers, title=HOSTILE)
    text = (tmp_path / "p.html").read_text()
    assert "<img" not in text and held(tmp_path / "p.html")["layers"][0]["name"] == HOSTILE
    assert "default-src 'none'" in text


def test_colors_of_neighbors_are_far_apart():
    colors = np.array([color(k) for k in range(12)])
    away = np.linalg.norm(colors[:, None] - colors, axis=2)[~np.eye(12, dtype=bool)]
    assert away.min() > 20


def test_without_a_point_there_is_no_page(tmp_path):
    with pytest.raises(ValueError, match="layers: got no points"):
        write_layers(tmp_path / "p.html", [CloudLayer("a", np.zeros((0, 3)))])
    assert not (tmp_path / "p.html").exists()


@pytest.mark.skipif(
    not (shutil.which("chromium") and shutil.which("chromedriver")),
    reason="the browser test needs Debian's chromium and chromium-driver",
)
def test_a_browser_shows_each_scan_on_or_off(layers, tmp_path):
    # given
    selenium = pytest.importorskip("selenium.webdriver")
    write_layers(tmp_path / "p.html", layers)
    options = selenium.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=800,600"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = selenium.Chrome(options, selenium.ChromeService(shutil.which("chromedriver")))
    count = """const c = document.querySelector("canvas"), n = new Set();
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let shown = 0;
        for (let i = 0; i < d.length; i += 4) shown += d[i] !== d[i + 1] || d[i] !== d[i + 2];
        return shown;"""
    try:
        driver.get((tmp_path / "p.html").as_uri())
        time.sleep(0.5)
        whole = driver.execute_script(count)
        # when: the largest scan is switched off, then all are
        boxes = driver.find_elements("css selector", "#list input")
        boxes[2].click()
        time.sleep(0.3)
        fewer = driver.execute_script(count)
        driver.find_element("id", "none").click()
        time.sleep(0.3)
        none = driver.execute_script(count)
        # then
        assert len(boxes) == 3 and whole > fewer > none == 0
        assert not [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    finally:
        driver.quit()

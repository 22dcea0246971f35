"""The page in a real browser, drawn with WebGL and, without WebGL, by hand."""

import io
import json
import shutil
import time
from types import SimpleNamespace

import numpy as np
import pytest

from cfr_jax.viewer import Scene, write_page

selenium = pytest.importorskip("selenium.webdriver", reason="the browser test needs selenium")
image = pytest.importorskip("PIL.Image", reason="the browser test needs pillow")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
CHROMEDRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not (CHROMIUM and CHROMEDRIVER),
    reason="the browser test needs Debian's chromium and chromium-driver",
)

RENDERERS = {
    "webgl2": ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
    "canvas2d": ["--disable-3d-apis", "--disable-gpu"],
}
QUIET = [
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=900,640",
]


@pytest.fixture(scope="module", params=RENDERERS)
def chromium(request):
    """One browser for all tests of a renderer. It asks for reduced motion, so that the page does
    not move by itself."""
    options = selenium.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in QUIET + RENDERERS[request.param]:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = selenium.Chrome(options, selenium.ChromeService(CHROMEDRIVER))
    prefer(driver, reduced_motion=True)
    yield SimpleNamespace(driver=driver, renderer=request.param)
    driver.quit()


def prefer(driver, reduced_motion, scheme="light"):
    motion = "reduce" if reduced_motion else "no-preference"
    features = [
        {"name": "prefers-reduced-motion", "value": motion},
        {"name": "prefers-color-scheme", "value": scheme},
    ]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


class Page:
    """An open page. After each test it must have loaded nothing and logged no errors."""

    def __init__(self, driver, path):
        self.driver = driver
        self.url = path.as_uri()
        driver.get(self.url)

    def __getitem__(self, name):
        return self.driver.find_element("id", name)

    def click(self, *names):
        for name in names:
            self[name].click()

    def press(self, *keys):
        for key in keys:
            selenium.ActionChains(self.driver).send_keys(key).perform()

    def root(self, name):
        return self.driver.execute_script(f"return document.documentElement.dataset.{name}")

    def wait_for_station(self, station):
        deadline = time.monotonic() + 20
        while float(self.root("station")) != station:
            assert time.monotonic() < deadline, f"still at station {self.root('station')}"
            time.sleep(0.05)

    def wait_until_still(self):
        """The station reads 1.000 a frame or two before the motion ends."""
        deadline = time.monotonic() + 20
        while self["play"].get_attribute("data-playing") is not None:
            assert time.monotonic() < deadline, "still playing"
            time.sleep(0.05)

    def settled(self):
        self.driver.execute_async_script(
            "const done = arguments[0];"
            "requestAnimationFrame(() => requestAnimationFrame(() => done()))"
        )

    def pixels(self):
        """The clouds as shown, (height, width, 3), 0 to 255: the stage without its captions."""
        self.settled()
        shown = image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB")
        box = self["stage"].rect
        return np.asarray(shown)[50 : int(box["height"]) - 50, 8 : int(box["width"]) - 8].astype(
            int
        )

    def covered(self, cloud):
        """Which pixels one cloud covers if it is shown alone."""
        other = {"source": "target", "target": "source"}[cloud]
        self.click(f"show-{other}")
        covered = drawn(self.pixels())
        self.click(f"show-{other}")
        assert covered.sum() > 1000, f"{cloud} is not drawn"
        return covered

    def overlap(self):
        """The number of pixels that both clouds cover, divided by those that either covers."""
        source, target = self.covered("source"), self.covered("target")
        return (source & target).sum() / (source | target).sum()


def drawn(pixels):
    """Which pixels are covered by a point: those with a color."""
    return np.ptp(pixels, axis=2) > 60


@pytest.fixture
def open_page(chromium, tmp_path):
    opened = []

    def open_scene(scene, path=tmp_path / "page.html"):
        write_page(path, scene)
        opened.append(Page(chromium.driver, path))
        assert opened[-1].root("renderer") == chromium.renderer
        return opened[-1]

    yield open_scene
    complaints = chromium.driver.get_log("browser")
    events = [
        json.loads(entry["message"])["message"] for entry in chromium.driver.get_log("performance")
    ]
    asked = {
        e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"
    }
    assert complaints == []
    assert asked and asked <= {page.url for page in opened}


def make_scene(**changes):
    """Two copies of an egg. The answer brings them together exactly, along a crooked path."""
    rng = np.random.default_rng(0)
    egg = rng.normal(size=(1500, 3))
    egg *= np.array([1.5, 1.0, 0.6]) / np.linalg.norm(egg, axis=1, keepdims=True)
    stations = np.tile(np.eye(4), (4, 1, 1))
    for k, (angle, shift) in enumerate([(0, 0), (2.0, 0.5), (1.3, 1.1), (1.2, 1.0)]):
        c, s = np.cos(angle), np.sin(angle)
        stations[k, :2, :2] = [[c, -s], [s, c]]
        stations[k, :3, 3] = np.array([1.2, -0.8, 0.3]) * shift
    answer = stations[-1]
    given = {
        "source": (egg - answer[:3, 3]) @ answer[:3, :3],
        "target": egg,
        "transforms": stations,
        "labels": ("start", "iteration 1", "iteration 2", "refined"),
        "weights": np.where(np.arange(1500) % 3 == 0, np.nan, rng.uniform(size=1500)),
        "facts": {"confidence": "0.97", "fitness": "0.71"},
        "warnings": ("The clouds hardly overlap.",),
        "source_name": "left.ply",
        "target_name": "right.ply",
    }
    return Scene(**given | changes)


def test_the_source_is_apart_before_and_on_the_target_after(open_page):
    page = open_page(make_scene())

    page.click("after")
    together = page.overlap()
    page.click("before")
    apart = page.overlap()

    assert together > 0.98 and apart < 0.3
    assert page["before"].get_attribute("aria-pressed") == "true"
    assert page["station"].text == "start"


def test_the_panel_shows_names_counts_facts_and_warnings(open_page):
    page = open_page(make_scene())
    panel = page.driver.find_element("tag name", "aside").text
    for text in ("left.ply", "right.ply", "source, 1,500 points", "confidence\n0.97", "fitness"):
        assert text in panel
    assert page["warnings"].text == "The clouds hardly overlap."


def test_hostile_names_are_shown_and_not_run(open_page):
    attack = "</script><img src=x onerror='document.title=1'><script>document.title=2</script>"
    page = open_page(
        make_scene(
            source_name=attack,
            facts={attack: attack},
            warnings=(attack,),
            labels=("start", attack, attack, attack),
        )
    )
    assert page["source-name"].text == page["warnings"].text == attack
    assert page.driver.title == f"{attack} → right.ply"
    assert page.driver.execute_script("return document.images.length") == 0


def test_weight_coloring_recolors_the_points_and_explains_itself(open_page):
    page = open_page(make_scene())
    solid = page.pixels()
    page.click("weight")
    weighted = page.pixels()

    assert (np.abs(solid - weighted).max(axis=2) > 40).sum() > 1000
    assert page["legend"].is_displayed() and "not used" in page["legend"].text
    page.click("solid")
    np.testing.assert_array_equal(page.pixels(), solid)
    assert not page["legend"].is_displayed()


def test_without_weights_there_is_nothing_to_color_by(open_page):
    page = open_page(make_scene(weights=None))
    solid = page.pixels()
    page["stage"].click()
    page.press("w")
    assert not page["weight"].is_displayed()
    np.testing.assert_array_equal(page.pixels(), solid)


def test_the_theme_follows_the_system_and_the_button(open_page):
    page = open_page(make_scene())
    light = page.pixels()[0, -1]
    page.click("theme")
    dark = page.pixels()[0, -1]
    prefer(page.driver, reduced_motion=True, scheme="dark")
    page.driver.refresh()
    followed = page.pixels()[0, -1]
    prefer(page.driver, reduced_motion=True)

    assert light.min() > 220 and dark.max() < 40
    np.testing.assert_array_equal(followed, dark)


def test_keys_walk_the_stations_and_turn_zoom_and_reset_the_view(open_page):
    page = open_page(make_scene())
    page["stage"].click()
    page.press("b", ">", ">")
    assert page["station"].text == "iteration 2"
    page.press("a")
    assert page["station"].text == "refined"

    straight = page.pixels()
    for keys in (["\ue012"], ["+", "+"], ["q"]):  # arrow left, zoom, roll
        page.press(*keys)
        assert (page.pixels() != straight).any(axis=2).sum() > 1000
        page.press("r")
        np.testing.assert_array_equal(page.pixels(), straight)


def test_the_slider_moves_from_station_to_station_and_says_where_it_is(open_page):
    page = open_page(make_scene())
    page.press("b")
    page["slider"].send_keys("\ue014")  # arrow right
    assert float(page.root("station")) == 1.0
    assert page["slider"].get_attribute("aria-valuetext") == "iteration 1"


def test_dragging_turns_the_clouds_and_the_wheel_zooms(open_page):
    page = open_page(make_scene())
    straight = page.pixels()
    drag = selenium.ActionChains(page.driver)
    drag.drag_and_drop_by_offset(page["stage"], 120, 40).perform()
    turned = page.pixels()
    wheel = selenium.ActionChains(page.driver)
    origin = selenium.common.actions.wheel_input.ScrollOrigin.from_element(page["stage"])
    wheel.scroll_from_origin(origin, 0, -300).perform()
    zoomed = page.pixels()

    assert (turned != straight).any(axis=2).sum() > 1000
    assert np.argwhere(drawn(zoomed)).std() > 1.3 * np.argwhere(drawn(turned)).std()


def test_two_fingers_zoom_and_move(open_page):
    page = open_page(make_scene())
    straight = np.argwhere(drawn(page.pixels()))

    def touch(kind, *xs):
        points = [{"x": x, "y": 250, "id": k} for k, x in enumerate(xs)]
        event = {"type": f"touch{kind}", "touchPoints": points}
        page.driver.execute_cdp_cmd("Input.dispatchTouchEvent", event)

    touch("Start", 300, 400)
    for step in range(1, 11):
        touch("Move", 300 + 10 * step, 400 + 6 * step)
    touch("End")
    pinched = np.argwhere(drawn(page.pixels()))

    # The fingers went from 100 to 60 pixels apart, and their middle 80 to the right.
    assert 0.5 < pinched.std(axis=0).min() / straight.std(axis=0).min() < 0.75
    assert 40 < (pinched.mean(axis=0) - straight.mean(axis=0))[1] < 90


def test_right_dragging_moves_the_clouds_with_the_pointer(open_page):
    page = open_page(make_scene())
    straight = np.argwhere(drawn(page.pixels())).mean(axis=0)
    hand = selenium.ActionChains(page.driver)
    hand.w3c_actions.pointer_action.move_to(page["stage"]).pointer_down(button=2)
    hand.w3c_actions.pointer_action.move_by(60, 40).pointer_up(button=2)
    hand.perform()
    moved = np.argwhere(drawn(page.pixels())).mean(axis=0)
    np.testing.assert_allclose(moved - straight, [40, 60], atol=3)


def test_a_lost_graphics_context_comes_back(open_page, chromium):
    page = open_page(make_scene())
    if chromium.renderer == "webgl2":
        whole = page.pixels()
        page.driver.execute_async_script(
            "const gl = document.querySelector('canvas').getContext('webgl2');"
            "const loss = gl.getExtension('WEBGL_lose_context');"
            "const back = () => setTimeout(arguments[0], 100);"
            "gl.canvas.addEventListener('webglcontextrestored', back);"
            "loss.loseContext(); setTimeout(() => loss.restoreContext(), 100);"
        )
        np.testing.assert_array_equal(page.pixels(), whole)


def test_bigger_points_cover_more(open_page):
    page = open_page(make_scene())
    small = drawn(page.pixels()).sum()
    page["point-size"].send_keys("\ue010")  # End
    assert drawn(page.pixels()).sum() > 1.5 * small


def test_the_page_plays_once_by_itself_and_again_when_asked(open_page, chromium):
    prefer(chromium.driver, reduced_motion=False)
    scene = make_scene()
    page = open_page(make_scene(transforms=scene.transforms[[0, -1]], labels=("start", "refined")))
    try:
        page.wait_for_station(1.0)
        page.wait_until_still()
        seen = page.driver.execute_async_script(
            "const [done, seen, root] = [arguments[0], [], document.documentElement];"
            "new MutationObserver(() => {"
            "  seen.push(Number(root.dataset.station));"
            "  if (seen.at(-1) === 1) done(seen);"
            "}).observe(root, {attributeFilter: ['data-station']});"
            "document.getElementById('play').click();"
        )
        assert seen[0] == 0.0 and any(0 < station < 1 for station in seen)
        assert seen == sorted(seen)
    finally:
        prefer(chromium.driver, reduced_motion=True)


def test_many_stations_of_a_map_at_far_coordinates_are_shown(open_page):
    scene = make_scene()
    far = np.eye(4)
    far[:3, 3] = [4.5e6, 5.2e6, 300.0]
    transforms = far @ np.concatenate([scene.transforms, np.tile(scene.transforms[-1], (9, 1, 1))])
    page = open_page(
        make_scene(
            target=scene.target + far[:3, 3],
            transforms=transforms,
            labels=[f"iteration {k}" for k in range(13)],
        )
    )
    assert page.overlap() > 0.98

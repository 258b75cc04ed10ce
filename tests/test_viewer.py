"""The page of the viewer stores the states accurately, and works in a browser."""

import base64
import json
import re
import shutil
import zlib

import numpy as np
import pytest

import ltljax as ltl
from ltljax._output.viewer import Inline, viewer_html, write_viewer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def sphere():
    return ltl.shapes.icosphere(3)


def states(mesh, count=5):
    x, y, z = mesh.vertices.T
    u = np.stack([np.sin(4 * x + k) for k in range(count)])
    return np.linspace(0, 2, count), {"u": u, "v": np.stack([y * z * k for k in range(count)])}


def part(page, name):
    match = re.search(rf'<script id="{name}"[^>]*>(.*?)</script>', page, re.DOTALL)
    assert match, name
    return match[1]


def decoded(page, index):
    """The states of a species, decoded from the documented layout."""
    header = json.loads(part(page, "header"))
    data = np.frombuffer(zlib.decompress(base64.b64decode(part(page, f"field-{index}"))), np.uint8)
    low, high = data.reshape(2, len(header["times"]), header["vertices"]).astype(np.uint16)
    codes = (low + (high << 8)).astype(np.int64)
    quantised = np.cumsum((codes >> 1) ^ -(codes & 1), axis=0) % 65536
    limits = header["species"][index]
    values = limits["low"] + (limits["high"] - limits["low"]) * quantised / limits["steps"]
    return np.where(quantised == 65535, np.nan, values)


def test_states_are_stored_with_sixteen_bits_and_nan_is_preserved(sphere):
    times, fields = states(sphere)
    fields["u"][1, 3] = np.nan
    fields["v"][2, 0] = np.inf
    page = viewer_html(sphere.vertices, sphere.faces, times, fields)
    for index, values in enumerate(fields.values()):
        stored = decoded(page, index)
        is_finite = np.isfinite(values)
        np.testing.assert_array_equal(np.isnan(stored), ~is_finite)
        assert np.abs(stored - values)[is_finite].max() <= np.ptp(values[is_finite]) / 65534


def test_a_uniform_state_at_a_single_time_is_stored(sphere):
    page = viewer_html(sphere.vertices, sphere.faces, np.zeros(1), {"u": np.full((1, sphere.num_vertices), 3.0)})
    np.testing.assert_allclose(decoded(page, 0), 3.0)


def test_times_that_were_not_reached_are_left_out(sphere):
    states = np.zeros((3, sphere.num_vertices))
    states[2] = np.nan
    page = viewer_html(sphere.vertices, sphere.faces, np.array([0.0, 1.0, np.inf]), {"u": states})
    assert json.loads(part(page, "header"))["times"] == [0, 1]
    assert decoded(page, 0).shape == (2, sphere.num_vertices)


def test_a_title_cannot_end_the_script_that_contains_it(sphere):
    times, fields = states(sphere)
    title = "</script><script>alert(1)</script> @bundle@ @data@"
    page = viewer_html(sphere.vertices, sphere.faces, times, fields, title)
    assert title not in page
    assert json.loads(part(page, "header"))["title"] == title


def test_errors_name_the_mistake(sphere):
    times, fields = states(sphere)
    with pytest.raises(ValueError, match="at least one species"):
        viewer_html(sphere.vertices, sphere.faces, times, {})
    with pytest.raises(ValueError, match=r"Expected u of shape \(5, 642\), found \(4, 642\)"):
        viewer_html(sphere.vertices, sphere.faces, times, {"u": fields["u"][:4]})
    with pytest.raises(ValueError, match="did you mean viridis"):
        viewer_html(sphere.vertices, sphere.faces, times, fields, colormap="virdis")


def test_a_notebook_shows_the_page_in_a_frame(sphere):
    times, fields = states(sphere)
    shown = Inline(viewer_html(sphere.vertices, sphere.faces, times, fields))._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert '"viridis"' not in shown.split("srcdoc=")[1].split("style")[0].replace("&quot;", "")


def moving(mesh, count):
    """Growing, moving waves with independent noise in each of 100 frames."""
    x, y, z = mesh.vertices.T
    rng = np.random.default_rng(0)
    fields = {}
    for k in range(count):
        wave = [np.sin(20 * x + k + t / 9) * np.cos(17 * y - k * z) * np.tanh(t / 30) for t in range(100)]
        fields[f"u{k}"] = np.stack(wave) + 1e-4 * rng.normal(size=(100, mesh.num_vertices))
    return fields


@pytest.mark.parametrize(("count", "tolerance"), [(2, 1e-4), pytest.param(5, 3.4e-3, marks=pytest.mark.slow)])
def test_the_page_of_a_long_run_on_a_fine_mesh_is_small(count, tolerance):
    mesh = ltl.shapes.icosphere(6)
    fields = moving(mesh, count)
    page = viewer_html(mesh.vertices, mesh.faces, np.arange(100.0), fields)
    assert len(page) < 15e6
    for index, values in enumerate(fields.values()):
        assert np.abs(decoded(page, index) - values).max() < tolerance * np.ptp(values)


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    driver = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with driver.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield chromium
        chromium.close()


def assert_pointer_shows_value(page, middle, v):
    """The value under the pointer is close to the value at the nearest vertex, and the stored value is accurate."""
    hit = page.evaluate("([x, y]) => viewer.valueAt(x, y)", list(middle))
    assert hit["value"] == pytest.approx(v[4][hit["vertex"]], abs=0.3)
    stored = page.evaluate("vertex => viewer.stored(1, 4, vertex)", hit["vertex"])
    assert stored == pytest.approx(v[4][hit["vertex"]], abs=np.ptp(v) / 65534)
    page.mouse.move(*middle)
    page.wait_for_function("!document.getElementById('value').hidden")
    assert page.locator("#value").inner_text().startswith("v = ")
    assert page.evaluate("viewer.valueAt(3, 90)") is None


def assert_interaction_works(page, middle, picture):
    """Zooming, rotating, playing, keys, and saving a picture work."""
    second = picture("before")
    distance = page.evaluate("viewer.distance")
    page.mouse.wheel(0, -400)
    page.wait_for_function("distance => viewer.distance < 0.95 * distance", arg=distance)
    page.mouse.wheel(0, 400)
    page.wait_for_timeout(800)
    page.mouse.down()
    page.mouse.move(middle[0] + 90, middle[1] + 30)
    page.mouse.up()
    assert picture("turned") != second
    page.evaluate("viewer.setFrame(0)")
    page.locator("#play").click()
    page.wait_for_function("viewer.frame > 0.05")
    page.keyboard.press("ArrowRight")
    assert not page.evaluate("viewer.playing")
    assert page.evaluate("viewer.frame") == int(page.evaluate("viewer.frame"))
    with page.expect_download() as saved:
        page.locator("#save").click()
    assert saved.value.suggested_filename == "Waves-on-a-sphere.png"


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_the_viewer_works_in_a_browser(browser, sphere, tmp_path, size):
    times, fields = states(sphere)
    path = tmp_path / "run.html"
    write_viewer(path, sphere.vertices, sphere.faces, times, fields, "Waves on a sphere")
    page = browser.new_page(viewport=dict(width=size[0], height=size[1]))
    errors = []
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_function("window.viewerReady === true", timeout=60_000)

    def picture(name):
        page.wait_for_timeout(300)
        page.screenshot(path=tmp_path / f"{name}.png")
        return page.locator("#scene").screenshot()

    assert page.title() == "Waves on a sphere"
    last = picture("last")
    page.locator("#slider").fill("0")
    assert page.evaluate("viewer.frame") == 0
    assert page.locator("#time").inner_text() == "t = 0"
    first = picture("first")
    assert first != last
    page.locator("#species").select_option("v")
    second = picture("species")
    assert second != first
    page.evaluate("viewer.setFrame(4)")
    page.locator("#colormap").select_option("gray")
    assert picture("gray") != last

    box = page.locator("#scene").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    assert_pointer_shows_value(page, middle, fields["v"])

    # The value is not computed again while nothing moves.
    page.wait_for_timeout(300)
    answers = page.evaluate("viewer.answers")
    page.wait_for_timeout(500)
    assert page.evaluate("viewer.answers") == answers > 0

    assert_interaction_works(page, middle, picture)
    assert errors == []
    page.close()


def test_touch_rotates_zooms_and_shows_values(browser, sphere, tmp_path):
    times, fields = states(sphere)
    path = tmp_path / "run.html"
    write_viewer(path, sphere.vertices, sphere.faces, times, fields, "Waves")
    context = browser.new_context(viewport=dict(width=390, height=844), has_touch=True, is_mobile=True)
    page = context.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_function("window.viewerReady === true", timeout=60_000)
    box = page.locator("#scene").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.touchscreen.tap(x, y)
    page.wait_for_function("!document.getElementById('value').hidden")
    assert page.locator("#value").inner_text().startswith("u = ")

    session = context.new_cdp_session(page)

    def touch(kind, *positions):
        points = [dict(x=a, y=b, id=index) for index, (a, b) in enumerate(positions)]
        session.send("Input.dispatchTouchEvent", dict(type=kind, touchPoints=points))
        page.wait_for_timeout(50)

    before = page.locator("#scene").screenshot()
    touch("touchStart", (x, y))
    for k in range(1, 6):
        touch("touchMove", (x + 15 * k, y))
    touch("touchEnd")
    page.wait_for_timeout(800)
    assert page.locator("#scene").screenshot() != before
    distance = page.evaluate("viewer.distance")
    touch("touchStart", (x - 30, y), (x + 30, y))
    for k in range(1, 6):
        touch("touchMove", (x - 30 - 15 * k, y), (x + 30 + 15 * k, y))
    touch("touchEnd")
    page.wait_for_function("distance => viewer.distance < 0.8 * distance", arg=distance)
    assert errors == []
    context.close()

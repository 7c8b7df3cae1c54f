"""The replay as a user has it: opened from the disk in a browser, without a graphics card and without a network."""

import io
import re

import matplotlib.image
import numpy as np
import pytest
from PIL import Image
from truths.browser import SOFTWARE, browsers, slide
from truths.passing import STEPS, box_scenario, pass_position, pass_record

from keepout.flights.pages.filmed import chromium, film
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_records

pytestmark = pytest.mark.long

TURNING = 0.02
EVIL = "</script><script>globalThis.evil = 1</script> & <b>high</b>"


@pytest.fixture(scope="module")
def page_path(tmp_path_factory, coarse_surfaces):
    """Two passes: of the first the guard spoke from 40 s to 60 s, with a flag from 50 s to 55 s."""
    folder = tmp_path_factory.mktemp("replay in a browser")
    guard = np.zeros(STEPS + 1, np.int32)
    guard[40:60] = 1
    guard[50:55] |= 8
    attitude = {"kind": "tumbling", "angular_velocity": (0.0, 0.0, TURNING)}
    records = {
        EVIL: pass_record(
            box_scenario(folder, 3.0, "high", attitude=attitude), 3.0, turning=TURNING, guard_status=guard
        ),
        "low": pass_record(
            box_scenario(folder, 2.0, "low", attitude=attitude, sun={"direction": (0.0, 0.0, 1.0)}),
            2.0,
            turning=TURNING,
        ),
    }
    path = folder / "replay.html"
    write_replay(path, of_records(records), title=EVIL)
    return path


@pytest.fixture(scope="module")
def start():
    with browsers() as launch:
        yield launch


@pytest.fixture(scope="module")
def started(start):
    browser = start(*SOFTWARE)
    yield browser
    browser.close()


@pytest.fixture
def opened(started, page_path):
    """The page at 1280 × 720, with what it said and asked for; nothing may be an error or leave the disk."""
    context = started.new_context(viewport={"width": 1280, "height": 720})
    page = context.new_page()
    said, asked = [], []
    page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: said.append(f"error: {error}"))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(page_path.as_uri())
    page.wait_for_selector("#replay[data-ready]", timeout=60_000)
    yield page
    assert said == []
    assert all(re.match("file:|data:|blob:", url) for url in asked)
    assert [url for url in asked if url.startswith("file:")] == [page_path.as_uri()]
    context.close()


def state(page):
    """What is shown, after the next picture."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.evaluate("keepoutReplay.state()")


def picture(page):
    """The drawing's pixels; its labels and controls are left out."""
    page.evaluate(
        "document.querySelectorAll('.stage > :not(canvas)').forEach((of) => { of.style.visibility = 'hidden' })"
    )
    page.wait_for_timeout(1000)  # at rest it is drawn finer
    return matplotlib.image.imread(io.BytesIO(page.locator(".stage").screenshot()))


def test_the_page_says_what_was_flown_and_runs_nothing_that_a_name_holds(opened):
    assert opened.title() == EVIL
    assert opened.locator("header h1").inner_text() == EVIL
    assert "No contact, proved" in opened.locator(".verdict").inner_text()
    assert opened.evaluate("globalThis.evil") is None
    assert state(opened)["flights"] == [EVIL, "low"]


@pytest.mark.slow
def test_the_slider_moves_the_chaser(opened):
    before = picture(opened)
    for time in (0.0, 50.0, 123.5, 200.0):
        slide(opened, time)
        shown = state(opened)
        assert shown["time"] == time
        np.testing.assert_allclose(shown["chaser"], pass_position(time, 3.0), atol=1e-5)
    after = picture(opened)
    assert (np.abs(after - before).max(axis=2) > 0.2).sum() > 100
    slide(opened, 100.0)
    state(opened)
    said = opened.locator("output[data-quantity=clearance]").inner_text()
    found, proved = (float(number) for number in re.findall(r"[\d.]+(?= m)", said))
    assert found == pytest.approx(1.5, abs=1e-3)
    assert 1.4 < proved < 1.5


def test_marks_jump(opened):
    words = [mark["words"] for mark in state(opened)["marks"]]
    assert words == ["guard: braking", "flag: disturbance", "least clearance", "goal reached, to stay"]
    opened.locator(".mark.guard").click(position={"x": 2, "y": 2})
    assert state(opened)["time"] == 40.0
    assert "guard: braking" in opened.locator(".status").inner_text()
    assert "guard: braking: 40.0 s to 60.0 s" in opened.locator(".words").inner_text()
    opened.locator("button[name=next]").click()
    assert state(opened)["time"] == 50.0
    assert "flag: disturbance" in opened.locator(".status").inner_text()
    opened.keyboard.press("[")
    assert state(opened)["time"] == 40.0
    slide(opened, 70.0)
    state(opened)
    assert opened.locator(".status").inner_text() == "guard: command passed on"


@pytest.mark.slow
def test_a_toggle_takes_away_what_it_names(opened):
    slide(opened, 100.0)
    opened.set_viewport_size({"width": 640, "height": 480})
    shown, before = state(opened), picture(opened)
    for name in ("target", "envelope", "guard", "path", "thrust", "velocity", "closest", "ends", "chaser"):
        opened.evaluate("(name) => document.querySelector(`input[name=${name}]`).click()", name)
        toggled, after = state(opened), picture(opened)
        assert toggled["shown"] == shown["shown"] | {name: not shown["shown"][name]}
        changed = (np.abs(after - before).max(axis=2) > 0.02).sum()
        # The thrust of this flight is nothing, so there is no arrow to take away.
        assert changed > 30 if name != "thrust" else changed == 0, name
        if name in ("envelope", "guard"):
            assert toggled["surfaces"] != shown["surfaces"]
            opened.keyboard.press(name[0])
            assert state(opened)["surfaces"] == shown["surfaces"]
            opened.keyboard.press(name[0])
        shown, before = state(opened), after


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (900, 700)])
def test_nothing_lies_over_anything_else(started, page_path, width, height):
    page = started.new_page(viewport={"width": width, "height": height})
    page.goto(page_path.as_uri())
    page.wait_for_selector("#replay[data-ready]", timeout=60_000)
    state(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("document.documentElement.scrollHeight") <= height
    places = ["header", ".controls", ".status", ".triad", ".bar", ".plots", ".transport"]
    boxes = {name: page.locator(name).bounding_box() for name in places}
    boxes = {name: box for name, box in boxes.items() if box is not None}
    for name, one in boxes.items():
        assert one["x"] >= 0
        assert one["x"] + one["width"] <= width + 0.5
        for other_name, other in boxes.items():
            if name < other_name:
                across = min(one["x"] + one["width"], other["x"] + other["width"]) - max(one["x"], other["x"])
                down = min(one["y"] + one["height"], other["y"] + other["height"]) - max(one["y"], other["y"])
                assert min(across, down) <= 0.5, (name, other_name)
    page.close()


def test_on_a_phone_nothing_is_wider_than_the_screen_and_the_switches_are_folded(started, page_path):
    page = started.new_page(viewport={"width": 390, "height": 844})
    page.goto(page_path.as_uri())
    page.wait_for_selector("#replay[data-ready]", timeout=60_000)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert not page.locator("input[name=path]").is_visible()
    page.locator(".controls summary").click()
    assert page.locator("input[name=path]").is_visible()
    page.locator("button[name=about]").click()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert "machine" in page.locator("#figures footer").inner_text()
    page.close()


@pytest.mark.slow
def test_a_chaser_behind_the_target_is_still_marked(opened):
    slide(opened, 100.0)
    for name in ("thrust", "velocity", "closest", "envelope", "path", "ends"):
        opened.evaluate("(name) => document.querySelector(`input[name=${name}]`).click()", name)
    opened.evaluate(
        "keepoutReplay.eye.camera.position.set(0, 0.01, -12); keepoutReplay.eye.controls.update()"
    )  # the box is between it and the chaser
    state(opened)
    before = picture(opened)
    opened.evaluate("document.querySelector('input[name=chaser]').click()")
    state(opened)
    assert (np.abs(picture(opened) - before).max(axis=2) > 0.2).sum() > 100


@pytest.mark.slow  # the tests above look at the page that is filmed
def test_a_film_shows_the_flight_and_a_row_of_pictures_too(page_path, tmp_path, monkeypatch):
    if chromium() is None:
        pytest.skip("no chromium: install Debian's, or name one in KEEPOUT_CHROMIUM")
    for name, value in {"SECONDS": 0.3, "RATE": 10, "SIZE": (640, 360), "PICTURES": 2}.items():
        monkeypatch.setattr(f"keepout.flights.pages.filmed.{name}", value)
    with Image.open(film(page_path, tmp_path / "film.gif")) as gif:
        assert (gif.size, gif.n_frames) == ((640, 360), 3)
    row = matplotlib.image.imread(film(page_path, tmp_path / "row.png"))[..., :3]
    assert row.shape == (360, 1280, 3)
    assert (np.abs(row[:, :640] - row[:, 640:]).max(axis=2) > 0.2).sum() > 100


@pytest.mark.slow  # the same figures on sheets are in test_printed
def test_without_scripts_and_in_print_there_are_figures(started, page_path):
    context = started.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(page_path.as_uri())
    assert page.locator("#figures").is_visible()
    assert not page.locator("#replay").is_visible()
    assert page.locator("#figures img").count() == 3
    assert "Contact: no" in page.locator("#figures").inner_text()
    context.close()
    page = started.new_page()
    page.goto(page_path.as_uri())
    page.wait_for_selector("#replay[data-ready]", timeout=60_000)
    assert not page.locator("#figures").is_visible()
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("#figures").is_visible()
    assert page.locator(".still").is_visible()
    assert not page.locator(".transport").is_visible()
    assert page.locator(".still").get_attribute("src").startswith("data:image/png")
    assert len(page.pdf()) > 10_000
    page.close()


@pytest.mark.slow  # a browser of its own; without scripts the same figures are shown
def test_a_browser_without_webgl_shows_the_figures(start, page_path):
    bare = start("--disable-gpu", "--disable-3d-apis")
    page = bare.new_page()
    page.goto(page_path.as_uri())
    page.wait_for_selector(".failed", timeout=60_000)
    assert "WebGL" in page.locator(".failed").inner_text()
    assert page.locator("#figures").is_visible()
    bare.close()

"""A replay whose map grows: what it holds against the exploration, and what a browser shows of it."""

import re

import numpy as np
import pytest
from truths.browser import SOFTWARE, browsers
from truths.made_up_exploration import BOUNDS, CAMERA, PERIOD, REFUSED, circle, look_at, made_up
from truths.replay_page import ReplayPage

from keepout.exploring.stages import MOST, Stages
from keepout.replay import growth
from keepout.replay.body import fewer
from keepout.replay.flights import Replayed
from keepout.replay.growth import Growth
from keepout.replay.scene import scene
from keepout.report.replay_view import write_replay

pytestmark = pytest.mark.long
VIEWS = 8


@pytest.fixture(scope="module")
def exploration():
    return made_up(views=VIEWS)


def replayed(of):
    return Replayed(of.scenario.name, of.record, of.scenario, of.target, of.audit, growth=Growth.of(of))


def page_of(of):
    made = scene([replayed(of)])
    return ReplayPage.of(made.told, made.content)


def volume(vertices, faces):
    """Of a closed mesh, by the divergence theorem, m³."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0


def test_the_skins_enclose_what_was_not_known_free_and_shrink(exploration):
    stages = exploration.stages
    assert 3 <= len(stages) <= MOST
    assert stages[0].time == 0.0
    assert stages[-1].time == exploration.record.time[-1]
    volumes = [volume(stage.vertices, stage.faces) for stage in stages]
    assert volumes == sorted(volumes, reverse=True)
    # Room that is free but shut in belongs to the skin's inside, so it holds at least the cubes that are not free.
    unknown = (~exploration.map.free).sum() * exploration.map.spacing**3
    assert unknown - 1e-6 <= volumes[-1] < 1.05 * unknown


def test_stages_are_spread_over_what_was_opened_however_many_views_there_are(exploration):
    known = exploration.map
    stages = Stages(known, 0.0)
    ball = 4.0 / 3.0 * np.pi * known.radius**3
    for number in range(1, 501):
        stages.note(known, float(number), ball * number / 500)
    times = [stage.time for stage in stages.at_the_end(known, 501.0)]
    assert 5 <= len(times) <= MOST
    assert (times[0], times[-1]) == (0.0, 501.0)
    gaps = np.diff(times[:-1])
    assert gaps.max() <= 2.1 * gaps.min()


def test_the_page_holds_the_views_where_they_were_taken(exploration):
    page = page_of(exploration)
    told = page.told["flights"][0]["growth"]
    views = {name: page.array(reference) for name, reference in told["views"].items()}
    for number in range(VIEWS):
        position = circle(PERIOD * number, PERIOD * VIEWS)
        np.testing.assert_allclose(views["position"][number], position, atol=1e-5)
        np.testing.assert_allclose(views["axes"][number], look_at(position, np.zeros(3)).T, atol=1e-5)
    assert views["taken"].tolist() == [number != REFUSED for number in range(VIEWS)]
    assert told["reach"] == pytest.approx(BOUNDS.usable_range(CAMERA))
    assert [stage["time"] for stage in told["stages"]] == [stage.time for stage in exploration.stages]


def test_a_thinned_skin_is_near_the_map_and_the_page_says_so(exploration, monkeypatch):
    monkeypatch.setattr(growth, "MOST_TRIANGLES", 3000)
    page = page_of(exploration)
    told = page.told["flights"][0]["growth"]
    assert re.search(r"with at most [\d,]+ of up to [\d,]+ triangles", told["remark"])
    for stage, whole in zip(told["stages"], exploration.stages, strict=True):
        vertices, faces = page.array(stage["vertices"]), page.array(stage["faces"])
        assert 500 < len(faces) <= 3000
        assert abs(volume(vertices, faces) / volume(whole.vertices, whole.faces) - 1.0) < 0.1
        lower, upper = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
        assert ((vertices >= lower - 1e-3) & (vertices <= upper + 1e-3)).all()


def test_a_skin_with_few_triangles_is_drawn_as_it_is(exploration):
    stage = exploration.stages[0]
    vertices, faces = fewer(stage.vertices, stage.faces, len(stage.faces), side=1.0)
    assert faces is stage.faces
    assert vertices is stage.vertices


def test_a_flight_that_did_not_explore_has_no_map_on_its_page(exploration):
    flight = replayed(exploration)
    plain = Replayed(flight.name, flight.record, flight.scenario, flight.target, flight.verdict)
    assert "growth" not in scene([plain]).told["flights"][0]


@pytest.fixture(scope="module")
def opened(exploration, tmp_path_factory):
    path = tmp_path_factory.mktemp("growth") / "replay.html"
    write_replay(path, [replayed(exploration)], title="grown")
    with browsers() as start:
        browser = start(*SOFTWARE)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        said = []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(path.as_uri())
        page.wait_for_selector("#replay[data-ready]", timeout=60_000)
        yield page
        assert said == []
        browser.close()


def shown_at(page, time):
    page.locator("input[type=range]").evaluate(
        "(of, time) => { of.value = time; of.dispatchEvent(new Event('input', {bubbles: true})) }", time
    )
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    skins = "keepoutReplay.flight.grown.skins.map((mesh) => mesh.visible)"
    return page.evaluate(f"({{...keepoutReplay.state().growth, skins: {skins}}})")


def test_the_map_and_the_views_switch_as_time_goes_on(opened, exploration):
    times = [stage.time for stage in exploration.stages]
    for time in (0.0, 10.0, 59.0, 61.0, 141.0, 160.0):
        shown = shown_at(opened, time)
        stage = max(place for place, of in enumerate(times) if of <= time)
        assert shown["stage"] == stage
        assert shown["skins"] == [place == stage for place in range(len(times))]
        assert shown["view"] == min(int(time // PERIOD), VIEWS - 1)
    shown_at(opened, PERIOD * REFUSED + 1.0)
    words = opened.locator(".status").inner_text()
    assert f"view {REFUSED + 1} of {VIEWS}, refused" in words
    assert f"{exploration.views[REFUSED].free_volume:.0f} m³ known free" in words
    assert "The map is drawn at" in opened.locator(".note").inner_text()


@pytest.mark.parametrize(("name", "key"), [("map", "m"), ("views", "c")])
def test_map_and_views_are_taken_away(opened, name, key):
    visible = f"keepoutReplay.flight.grown.{name}.visible"
    opened.keyboard.press(key)
    shown_at(opened, 50.0)
    assert opened.evaluate(visible) is False
    opened.evaluate("(name) => document.querySelector(`input[name=${name}]`).click()", name)
    shown_at(opened, 50.0)
    assert opened.evaluate(visible) is True

"""A replay whose map grows: what it holds against the exploration, and what a browser shows of it."""

import numpy as np
import pytest
from truths.browser import shown, slide
from truths.made_up_exploration import BOUNDS, CAMERA, PERIOD, REFUSED, circle, look_at, made_up
from truths.replay_page import ReplayPage

from keepout.apps.unknown.exploration_page import Growth
from keepout.apps.unknown.skin import MOST
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import Replayed
from keepout.flights.pages.scene import scene

pytestmark = pytest.mark.long
VIEWS = 8


@pytest.fixture(scope="module")
def exploration():
    return made_up(views=VIEWS)


def replayed(of):
    return Replayed(of.scenario.name, of.record, of.scenario, of.target, of.audit, layer=Growth(of))


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


@pytest.fixture(scope="module")
def opened(exploration, tmp_path_factory):
    path = tmp_path_factory.mktemp("growth") / "replay.html"
    write_replay(path, [replayed(exploration)], title="grown")
    with shown(path) as page:
        yield page


def shown_at(page, time):
    slide(page, time)
    skins = "keepoutReplay.flight.grown.skins.map((mesh) => mesh.visible)"
    return page.evaluate(f"({{...keepoutReplay.state().growth, skins: {skins}}})")


@pytest.mark.slow  # the replay of an exploration is written in test_commands
def test_the_map_and_the_views_switch_as_time_goes_on(opened, exploration):
    times = [stage.time for stage in exploration.stages]
    for time in (0.0, 10.0, 59.0, 61.0, 141.0, 160.0):
        told = shown_at(opened, time)
        stage = max(place for place, of in enumerate(times) if of <= time)
        assert told["stage"] == stage
        assert told["skins"] == [place == stage for place in range(len(times))]
        assert told["view"] == min(int(time // PERIOD), VIEWS - 1)
    shown_at(opened, PERIOD * REFUSED + 1.0)
    words = opened.locator(".status").inner_text()
    assert f"view {REFUSED + 1} of {VIEWS}, refused" in words
    assert f"{exploration.views[REFUSED].free_volume:.0f} m³ known free" in words
    assert "The map is drawn at" in opened.locator(".note").inner_text()

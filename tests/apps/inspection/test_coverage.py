"""A replay that shows what an inspection saw: what it holds against the inspection, and what a browser shows of it."""

import re

import numpy as np
import pytest
from truths.browser import shown, slide
from truths.made_up_inspection import DARK, PERIOD, RULES, SUN, made_up
from truths.replay_page import ReplayPage

from keepout.apps.inspection import inspection_page
from keepout.apps.inspection.inspection import Fate, fates, first_frames
from keepout.apps.inspection.inspection_page import Coverage
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import Replayed
from keepout.flights.pages.scene import scene

pytestmark = pytest.mark.long
VIEWS = 8


@pytest.fixture(scope="module")
def inspection():
    return made_up(views=VIEWS, light=True)


def replayed(of):
    return Replayed(of.scenario.name, of.record, of.scenario, of.target, of.audit, layer=Coverage(of))


def page_of(of):
    made = scene([replayed(of)])
    return ReplayPage.of(made.told, made.content)


def test_the_page_holds_what_each_side_came_to_and_when(inspection):
    page = page_of(inspection)
    told = page.told["flights"][0]["coverage"]
    vertices, faces, fate, firsts = (page.array(told[name]) for name in ("vertices", "faces", "fates", "firsts"))
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles, patches = vertices[faces].mean(axis=1), inspection.patches
    wanted, first = fates(inspection), first_frames(inspection)
    for place in range(len(faces)):
        near = np.abs(patches.centres - middles[place]).sum(axis=1) + 10.0 * np.abs(
            patches.normals - normals[place]
        ).sum(axis=1)
        patch = int(np.argmin(near))
        assert fate[place].tolist() == wanted[[2 * patch, 2 * patch + 1]].tolist()
        assert firsts[place].tolist() == first[[2 * patch, 2 * patch + 1]].tolist()
    frames = {name: page.array(reference) for name, reference in told["frames"].items()}
    np.testing.assert_allclose(frames["share"], inspection.over_time()[1], atol=1e-6)
    for number, frame in enumerate(inspection.frames):
        np.testing.assert_allclose(frames["boresight"][number], frame.boresight, atol=1e-6)
        assert np.isnan(frames["sun"][number]).all() == (number in DARK)
    assert told["half_angle"] == pytest.approx(RULES.half_angle)
    assert told["reach"] == RULES.greatest_range


def test_the_plot_is_the_share_seen_up_to_each_row(inspection):
    page = page_of(inspection)
    seen = page.array(page.told["flights"][0]["arrays"]["seen"])
    time = page.array(page.told["flights"][0]["arrays"]["time"])
    _, shares = inspection.over_time()
    np.testing.assert_allclose(seen, shares[np.minimum(time // PERIOD, VIEWS - 1).astype(int)], atol=1e-6)
    assert "goal" not in " ".join(mark["words"] for mark in page.told["flights"][0]["marks"])


def test_a_surface_of_very_many_triangles_is_drawn_with_fewer_and_the_page_says_so(inspection, monkeypatch):
    fine = made_up(views=VIEWS, across=24)
    monkeypatch.setattr(inspection_page, "MOST_TRIANGLES", 2000)
    thinned = Coverage(fine)
    assert 200 < len(thinned.faces) <= 2000
    assert re.search(r"with [\d,]+ of the patches' 6,912 triangles", thinned._remark())
    # Each triangle left has the fate of the side of the box that it lies on.
    middles = thinned.vertices[thinned.faces].mean(axis=1)
    below = np.abs(middles[:, 2] + 1.0) < 0.05
    hidden = np.isin(thinned.fates, (Fate.ENCLOSED_BY_RAYS, Fate.NARROW_BY_RAYS)).any(axis=1)
    assert hidden[below].mean() > 0.9
    assert not hidden[~below & (middles[:, 2] > -0.8)].any()
    a, b, c = np.moveaxis(thinned.vertices[thinned.faces], 1, 0)
    outer = np.where(np.einsum("fi,fi->f", np.cross(b - a, c - a), middles) > 0.0, *thinned.fates.T)
    assert (outer != Fate.NOT_COUNTED).mean() > 0.99


@pytest.fixture(scope="module")
def opened(inspection, tmp_path_factory):
    path = tmp_path_factory.mktemp("coverage") / "replay.html"
    write_replay(path, [replayed(inspection)], title="inspected")
    with shown(path) as page:
        yield page


def shown_at(page, time):
    slide(page, time)
    return page.evaluate("keepoutReplay.state().coverage")


def test_frame_camera_and_sun_move_with_time(opened, inspection):
    for time in (0.0, 19.0, 20.0, 50.0, 70.0, 110.0, 145.0):
        told = shown_at(opened, time)
        number = min(int(time // PERIOD), VIEWS - 1)
        assert told["frame"] == number
        row = int(np.searchsorted(inspection.record.time, time))
        np.testing.assert_allclose(told["camera"], inspection.record.position[row], atol=1e-4)
        here, there = (inspection.frames[min(k, VIEWS - 1)].boresight for k in (number, number + 1))
        part = time / PERIOD - number if number < VIEWS - 1 else 0.0
        wanted = (1.0 - part) * here + part * there
        np.testing.assert_allclose(told["boresight"], wanted / np.linalg.norm(wanted), atol=1e-5)
        np.testing.assert_allclose(told["sun"], np.zeros(3) if number in DARK else SUN, atol=1e-6)
    words = opened.locator(".status").inner_text()
    assert f"frame {VIEWS} of {VIEWS}, {100 * inspection.coverage:.1f} % of the surface seen" in words
    shown_at(opened, 110.0)
    assert "in the Earth's shadow" in opened.locator(".status").inner_text()

"""Pictures of an exploration against what the made-up one saw, in closed form."""

import math

import matplotlib.image
import numpy as np
import pytest
from truths.made_up_exploration import CAMERA, HALF, PERIOD, REFUSED, circle, look_at, made_up

from keepout.geometry.target import Target
from keepout.report import exploration_view
from keepout.report.exploration_page import said, write_exploration
from keepout.report.first_sight import FirstSight
from keepout.report.map_slices import FREE, SURFACE, UNKNOWN, kinds_in_slice
from keepout.report.raster import rasterise

pytestmark = pytest.mark.long
VIEWS = 8


@pytest.fixture(scope="module")
def exploration():
    return made_up(views=VIEWS, expected=Target.load("box", parameters={"height": 1.0}))


def first_times(points):
    """When places on the box come into the image of a convex box: at the first view before their side and within it."""
    times = np.full(len(points), np.inf)
    outward = np.where(np.isclose(np.abs(points), HALF), np.sign(points), 0.0)
    slopes = 0.5 * np.array([CAMERA.width, CAMERA.height]) / CAMERA.focal
    for number in range(VIEWS):
        if number == REFUSED:
            continue
        position = circle(PERIOD * number, PERIOD * VIEWS)
        away = points - position
        seen = away @ look_at(position, np.zeros(3))
        length = np.linalg.norm(away, axis=1)
        facing = -np.einsum("ni,ni->n", away, outward) > math.cos(1.48) * length
        inside = (np.abs(seen[:, :2]) <= slopes * seen[:, 2:]).all(axis=1)
        times[facing & inside & np.isinf(times)] = PERIOD * number
    return times


def sight_of(exploration):
    return FirstSight(
        exploration.target,
        exploration_view.taken(exploration),
        exploration_view.camera_of(exploration),
        greatest_range=15.0,
        grazing_angle=1.48,
    )


def test_times_of_first_sight_are_those_of_a_convex_box(exploration):
    sight = sight_of(exploration)
    inner = np.sort(HALF - np.abs(sight.points), axis=1)[:, 1] > 0.02  # away from edges, where a ray meets either side
    expected = first_times(sight.points)
    np.testing.assert_array_equal(sight.times[inner], expected[inner])
    assert 0.2 < np.isinf(expected[inner]).mean() < 0.8
    assert len(np.unique(expected[inner])) >= 3


def test_a_picture_takes_the_time_of_the_place_that_a_pixel_shows(exploration):
    target, side = exploration.target, {"elevation": 25.0, "azimuth": -60.0}
    view = rasterise(target.vertices, target.faces, columns=200, **side)
    times = sight_of(exploration).of_picture(target, view, **side)
    assert (np.isnan(times) == ~view.hit).all()
    top, front = (target.vertices[target.faces].min(axis=1)[:, axis] == sign for axis, sign in ((2, 1.0),) * 2)
    assert (top == front).all()
    seen_top = times[view.hit & top[view.face]]
    assert np.median(seen_top) == np.median(first_times(np.array([[0.0, 0.0, 1.0]])))


def test_a_slice_sorts_cubes_by_the_map_and_its_returns(exploration):
    known = exploration.map
    kinds, centres = kinds_in_slice(known, 2, 0.05, explained=0.35)
    cells = np.floor((centres - known.origin) / known.spacing).astype(int)
    assert ((kinds == FREE) == known.free[tuple(np.moveaxis(cells, -1, 0))]).all()
    for kind, near in ((SURFACE, True), (UNKNOWN, False)):
        chosen = centres[kinds == kind]
        assert len(chosen) > 10
        distance = np.linalg.norm(chosen[:, None] - known.returns[None], axis=2).min(axis=1)
        assert ((distance <= 0.35) == near).all()


def test_the_folder_holds_what_there_is_to_see(exploration, tmp_path):
    summary = write_exploration(tmp_path, exploration)
    stems = ("seen", "map", "progress", "unknown", "departures", "motion")
    assert summary["pictures"] == [str(tmp_path / f"{stem}.png") for stem in stems]
    for stem in stems:
        picture = matplotlib.image.imread(tmp_path / f"{stem}.png")
        assert picture[..., :3].std() > 0.02
    page = (tmp_path / "index.html").read_text()
    assert page.count("data:image/png") == len(stems)
    assert 'src="replay.html"' in page
    assert "Contact not excluded" in page
    assert summary["refused_views"] == {"pose jump": 1}
    assert (tmp_path / "replay.html").stat().st_size < 4_000_000


def test_what_was_in_the_way_and_departures_are_drawn_only_where_there_are_any(tmp_path):
    reached = made_up(views=3, outcome="reached goal")
    summary = write_exploration(tmp_path, type(reached)(**{**vars(reached), "unknown": np.zeros((0, 3))}))
    assert not {"unknown.png", "departures.png"} & {path.name for path in tmp_path.iterdir()}
    assert "departures_largest_m" in summary
    assert "Reached goal" in said(reached)


def test_words_that_a_page_shows_are_text(tmp_path):
    evil = made_up(views=2)
    evil = type(evil)(**{**vars(evil), "why": "<script>evil</script>", "assumptions_broken": ("<b>broken</b>",)})
    write_exploration(tmp_path, evil)
    page = (tmp_path / "index.html").read_text()
    assert "<script>" not in page
    assert "<b>broken" not in page

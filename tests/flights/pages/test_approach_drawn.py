"""Zones, corridors and legs as pages show them, against the audit's distances and what a hand-made flight holds."""

import dataclasses
import json
from unittest.mock import Mock

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from truths.browser import shown, slide
from truths.command_line import keepout_command
from truths.passing import STEPS, box_scenario, pass_record

from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import regions
from keepout.flights.pages.approach_drawn import paint_bodies, told
from keepout.flights.pages.flight_page import draw_error, draw_motion
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_records
from keepout.flights.pages.scene import marks, to_inertial

HEIGHT, CHANGED = 3.0, 80
HOLD, GOAL = (-1.5, 0.0, HEIGHT), (5.0, 0.0, HEIGHT)
LEGS = [
    {"name": "hold", "position": HOLD, "tolerance": 0.4, "until": "go", "go_at": 75.0},
    {"position": GOAL, "tolerance": 0.1},
]
AXIS, CENTRE = (1.0, 2.0, -2.0), (30.0, 1.0, 2.0)
ZONES = [
    {"name": "ball", "shape": "sphere", "centre": CENTRE, "radius": 2.0, "until": "go"},
    {"shape": "ellipsoid", "centre": CENTRE, "semi_axes": (1.0, 2.0, 3.0), "start": 20.0, "until": 90.0},
    {"shape": "box", "lower": (30.0, 1.0, 2.0), "upper": (31.0, 3.0, 5.0)},
    {"shape": "cylinder", "centre": CENTRE, "axis": AXIS, "radius": 1.5, "length": 4.0},
    {"shape": "cone", "centre": CENTRE, "axis": AXIS, "half_angle": 0.4, "length": 5.0},
]
CORRIDORS = [
    {"port": (0.0, 0.0, -1.0), "axis": AXIS, "length": 5.0, "half_angle": 0.3},
    {"port": (0.0, 0.0, -1.0), "axis": AXIS, "length": 5.0, "half_angle": 0.3, "radius": 0.7},
    {"port": (0.0, 0.0, -1.0), "axis": AXIS, "length": 5.0, "radius": 0.7},
]
SUN = {"name": "sun", "shape": "cone", "axes": "inertial", "centre": (0.0, 0.0, 0.0), "axis": (0.0, 1.0, 0.0)}
SUN |= {"half_angle": 0.2, "length": 9.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("approach")


@pytest.fixture(scope="module")
def scenario(folder):
    rule = {"speed_by_distance": [(4.0, 0.09), (2.0, 0.06)], "distance_to": (0.0, 0.0, 1.0)}
    rules = {"leg": LEGS, "zone": [ZONES[0], SUN], "corridor": CORRIDORS[:1], "approach": rule}
    return box_scenario(folder, HEIGHT, "legs", duration=STEPS, orbit={"semi_major_axis": 6.8e6}, **rules)


@pytest.fixture(scope="module")
def record(scenario):
    return pass_record(scenario, HEIGHT, leg=(np.arange(STEPS + 1) >= CHANGED).astype(np.int32))


@pytest.fixture(scope="module")
def replay(folder, record, coarse_surfaces):
    write_replay(folder / "replay.html", of_records({"legs": record}), title="legs")
    return folder / "replay.html"


def surface(body):
    """Points of a body as the viewer makes it, m."""
    turns = np.linspace(0.0, 2.0 * np.pi, 7)
    if "profile" in body:
        across, along = np.array(body["profile"]).T
        round_z = [across * np.cos(turns)[:, None], across * np.sin(turns)[:, None], along + 0.0 * turns[:, None]]
        turned = Rotation.align_vectors(np.array([body["axis"]]), np.array([[0.0, 0.0, 1.0]]))[0]
        return turned.apply(np.stack(round_z, axis=-1).reshape(-1, 3)) + body["at"]
    if "corners" in body:
        return np.array(body["corners"])[np.array(body["faces"])].mean(axis=1) + body["at"]
    if "size" in body:
        corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
        return corners * body["size"] + body["at"]
    rays = np.random.default_rng(0).normal(size=(40, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True) * body["semi_axes"] + body["at"]


def test_bodies_are_drawn_where_the_audit_judges_them(tmp_path):
    (tmp_path / "tip.off").write_text(
        "OFF\n4 4 0\n30 0 0\n32 0 0\n30 2 0\n30 0 2\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 2 0 3\n"
    )
    mesh = {"shape": "mesh", "file": str(tmp_path / "tip.off")}
    scenario = Scenario(target={"source": "box"}, leg=LEGS, zone=[*ZONES, mesh], corridor=CORRIDORS)
    bodies = told(scenario, 10.0)["bodies"]
    for body, region in zip(bodies, regions(Surroundings(scenario)), strict=True):
        np.testing.assert_allclose(region.distance(surface(body)), 0.0, atol=2e-4)
    assert [(body["start"], body["until"]) for body in bodies[:3]] == [(-10.0, 65.0), (10.0, 80.0), (-10.0, None)]
    assert [body["name"] for body in bodies[:2] + bodies[-1:]] == ["ball", "zone 1", "corridor 2"]
    for corridor, body in zip(CORRIDORS, bodies[-3:], strict=True):
        end = np.linalg.norm(body["profile"][-1])
        assert end == pytest.approx(corridor["length"])  # there the corridor ends


def test_pictures_of_the_path_show_what_stands_still_and_keep_their_limits():
    scenario = Scenario(target={"source": "box"}, leg=LEGS, zone=[*ZONES, SUN], corridor=CORRIDORS)
    eye = Rotation.from_euler("zx", [0.4, 1.1]).as_matrix()
    axes = Figure().subplots()
    axes.plot([0.0, 9.0], [0.0, 4.0])
    limits = axes.get_xlim(), axes.get_ylim()
    paint_bodies(axes, scenario, eye)
    assert (axes.get_xlim(), axes.get_ylim()) == limits
    bodies = [body for body in told(scenario, 0.0)["bodies"] if body["name"] != "sun"]
    outlines = [patch.get_path() for patch in axes.patches if patch.get_fill()]
    for body, outline in zip(bodies, outlines, strict=True):
        # A circle of 48 corners is 0.2 % narrower.
        assert outline.contains_points((surface(body) @ eye.T)[:, :2], radius=0.02).all()
    np.testing.assert_allclose(np.ptp(outlines[0].vertices, axis=0), 2.0 * ZONES[0]["radius"], rtol=5e-3)
    np.testing.assert_allclose(axes.lines[-1].get_xydata(), [(eye @ HOLD)[:2]])


@pytest.mark.long
def test_axes_turn_in_the_replay_as_they_do_for_the_audit(scenario, record):
    sun = regions(Surroundings(scenario))[1]
    drawn = Rotation.from_quat(to_inertial(record, scenario), scalar_first=True).as_matrix()
    np.testing.assert_allclose(drawn, sun.rotations[: STEPS + 1], atol=1e-9)
    assert np.abs(drawn[-1] - drawn[0]).max() > 0.1


@pytest.mark.long
def test_who_stays_at_a_hold_has_not_reached_the_goal(record):
    held = dataclasses.replace(record, leg=np.zeros(STEPS + 1, np.int32))
    there = np.zeros(STEPS + 1)
    assert "reached" in {mark.kind for mark in marks(held, there, there, 0.1, ["the only one"])}
    assert "reached" not in {mark.kind for mark in marks(held, there, there, 0.1, ["hold", "goal"])}


@pytest.mark.slow  # bodies of zones are held where the audit judges them
@pytest.mark.long
def test_zones_stand_and_go_in_a_browser(replay):
    with shown(replay) as page:

        def standing(time):
            slide(page, time)
            return {of["name"]: of["turned"] for of in page.evaluate("keepoutReplay.state().standing")}

        first, last = standing(74.0), standing(190.0)
        assert [list(first), list(last)] == [["ball", "sun", "corridor 0"], ["sun", "corridor 0"]]
        turned = (Rotation.from_quat(last["sun"]).inv() * Rotation.from_quat(first["sun"])).magnitude()
        assert 0.9e-3 < turned / 116.0 < 1.3e-3  # a low orbit's rate, rad/s
        assert page.locator(".fates .over").inner_text() == "ball"
        assert page.locator(".mark.leg").all_inner_texts() == ["hold", "leg 1"]
        assert page.locator(".status").inner_text().startswith("leg 1 · ")
        assert page.locator(".labels .hold").inner_text() == "hold"
        page.locator("input[name=zone]").click()
        assert list(standing(10.0)) == ["corridor 0"]
        page.keyboard.press("z")
        assert list(standing(10.0)) == ["ball", "sun"]


@pytest.mark.long
def test_figures_have_a_line_where_a_leg_begins(folder, scenario, record, monkeypatch):
    drawn = []
    monkeypatch.setattr("matplotlib.axes.Axes.axvline", lambda axes, x, **_: drawn.append(x))
    clearance = np.zeros(STEPS + 1)
    flight = Mock(spec=Flight, record=record, scenario=scenario, clearance=clearance)
    draw_error(folder / "error.png", flight)
    draw_motion(folder / "motion.png", flight)
    assert drawn == 2 * [0.0, float(CHANGED)]


MISSION = """
name = "approach"
duration = 160.0
target.source = "box"
field.source = "grid"
start.position = [10.0, 0.0, 0.0]
leg = [{name = "hold", position = [8.0, 0.0, 0.0], dwell = 5.0}, {position = [5.0, 0.0, 0.0], tolerance = 0.2}]
zone = [{name = "ball", shape = "sphere", centre = [0.0, 9.0, 0.0], radius = 3.0}]
corridor = [{port = [2.0, 0.0, 0.0], axis = [1.0, 0.0, 0.0], length = 4.0, half_angle = 0.3, radius = 1.0}]
approach.abort_time = 60.0
require = {zones = "proved", holds = true}
"""


@pytest.mark.slow  # a minute
def test_the_command_flies_an_approach_and_writes_what_came_of_it(tmp_path):
    (tmp_path / "mission.toml").write_text(MISSION, encoding="utf-8")
    answer = keepout_command("fly", tmp_path / "mission.toml", "-o", tmp_path / "out")
    assert answer.code == 0, answer.err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert (summary["zones_entered"], summary["holds_kept"]) == ("no", True)
    assert [leg["name"] for leg in summary["legs"]] == ['leg "hold"', "leg 1"]
    assert [zone["name"] for zone in summary["zones"]] == ['zone "ball"', "corridor 0"]
    assert sum(leg["judged"] for leg in summary["drifts"]) == 17
    for page in ("index.html", "replay.html"):
        assert "ball" in (tmp_path / "out" / page).read_text(encoding="utf-8")

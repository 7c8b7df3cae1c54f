"""`keepout explore`, as a person calls it: it maps and approaches a box that it does not know, or refuses in a line."""

import json

import numpy as np
import pytest
from truths.command_line import keepout_command
from truths.made_up_exploration import HALF
from truths.replay_page import ReplayPage

import keepout
from keepout.flight.record import FlightRecord
from keepout.mapping import map_file

pytestmark = pytest.mark.long

MISSION = """
name = "small"
seed = 1
duration = 900.0
[target]
source = "box"
[map]
radius = 3.0
spacing = 0.25
cap = 2.0
[depth_sensor]
width = 64
height = 48
surely_returned_width = 0.12
[chaser]
radius = 0.3
[disturbance]
kind = "none"
[start]
position = [-5.0, 0.0, 0.0]
[goal]
position = [4.0, 0.0, 0.0]
[explore]
most_views = 60
expected = "box"
"""
GOAL, RADIUS, TOLERANCE = np.array([4.0, 0.0, 0.0]), 0.3, 0.1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explore")
    (folder / "mission.toml").write_text(MISSION)
    return folder


@pytest.fixture(scope="module")
def explored(folder):
    return keepout_command("explore", folder / "mission.toml", "-o", folder / "out", "--json")


def distance_to_the_box(points):
    """Distance to the box in closed form, m; 0 inside."""
    return np.linalg.norm(np.maximum(np.abs(points) - HALF, 0.0), axis=1)


def test_it_reaches_the_goal_and_says_so(folder, explored):
    summary = explored.json
    assert {path.name for path in (folder / "out").iterdir()} == {
        *("map.keepmap", "small.parquet", "summary.json", "index.html", "replay.html"),
        *("seen.png", "map.png", "progress.png", "departures.png", "motion.png"),
    }
    assert json.loads((folder / "out" / "summary.json").read_text()) == summary
    assert summary["outcome"] == "reached goal"
    assert summary["contact"] is False
    assert summary["start_certified"] is True
    assert 0.0 < summary["seen_share"] <= 1.0
    assert summary["departures_largest_m"] == 0.0
    assert summary["seconds"] > 0.0


def test_the_figures_are_those_of_the_flight_and_of_the_true_box(folder, explored):
    summary = explored.json
    record = FlightRecord.load(folder / "out" / "small.parquet")
    assert np.linalg.norm(record.position[-1] - GOAL) < TOLERANCE
    least = distance_to_the_box(record.position).min() - RADIUS
    assert summary["minimum_clearance_m"] == pytest.approx(least, abs=5e-3)
    assert summary["minimum_clearance_m"] <= least + 1e-9
    pushed = np.linalg.norm(record.force[:-1], axis=1).sum() * (record.time[1] - record.time[0]) / 20.0
    assert summary["delta_v_mps"] == pytest.approx(pushed, rel=1e-6)
    known = map_file.load(folder / "out" / "map.keepmap", name="small", spacing=0.25)
    assert summary["views"] == known.views + sum(summary["refused_views"].values())
    # No free cube meets the box: the nearest place of each to the box is not inside it.
    centres = known.origin + (np.argwhere(known.free) + 0.5) * known.spacing
    nearest = np.maximum(np.abs(centres) - HALF, 0.0).max(axis=1)
    assert nearest.min() >= 0.5 * known.spacing - 1e-9


def test_a_map_that_was_kept_is_gone_on_from(folder, explored):
    kept = map_file.load(folder / "out" / "map.keepmap")
    mission = MISSION.replace("[map]", f'[map]\nfile = "{folder / "out" / "map.keepmap"}"')
    (folder / "again.toml").write_text(mission.replace("most_views = 60", "most_views = 3"))
    summary = keepout_command("explore", folder / "again.toml", "-o", folder / "again", "--json", "--no-figures").json
    assert summary["outcome"] in ("out of views", "reached goal")
    later = map_file.load(folder / "again" / "map.keepmap")
    assert later.views == kept.views + summary["views"] - sum(summary["refused_views"].values())
    assert (later.free >= kept.free).all()
    assert {path.name for path in (folder / "again").iterdir()} == {"map.keepmap", "small.parquet", "summary.json"}


def test_its_flight_file_is_replayed_without_a_field_of_the_target(folder, explored):
    assert explored.code == 0
    page = folder / "again.html"
    told = keepout_command("replay", folder / "out" / "small.parquet", "-o", page, "--json").json
    assert told["flights"] == ["small"]
    assert ReplayPage.read(page).told["surfaces"] == []


REFUSALS = {
    "map.radius": (("radius = 3.0\n", ""), "map.radius"),
    "inside the ball": (("[-5.0, 0.0, 0.0]", "[-2.9, 0.0, 0.0]"), "start.position"),
    "period": (("[depth_sensor]", "[depth_sensor]\nperiod = 10.5"), "depth_sensor.period: 10.5 s"),
    "latency": (("[depth_sensor]", "[depth_sensor]\nlatency = 0.3"), "depth_sensor.latency: 0.3 s"),
    "range": (("surely_returned_width = 0.12", "surely_returned_width = 0.003"), "depth_sensor.surely_returned_width"),
    "field": (("[map]", '[field]\nsource = "other.keepout"\n[map]'), "field.source"),
    "cap": (("cap = 2.0", "cap = 0.5"), "map.cap: 0.5 m"),
    "no such map": (("[map]", '[map]\nfile = "absent.keepmap"'), "absent.keepmap"),
    "ranges": (("[depth_sensor]", "[depth_sensor]\nleast_range = 20.0"), "least_range 20.0 m"),
    "no expected mesh": (('expected = "box"', 'expected = "absent.stl"'), "absent.stl"),
}


@pytest.mark.parametrize(("change", "named"), REFUSALS.values(), ids=REFUSALS)
def test_a_refusal_is_one_line_that_names_the_entry(tmp_path, change, named):
    assert change[0] in MISSION
    (tmp_path / "mission.toml").write_text(MISSION.replace(*change))
    answer = keepout_command("explore", tmp_path / "mission.toml", "-o", tmp_path / "out")
    assert answer.code == 1
    assert answer.err.startswith("keepout: ")
    assert answer.err.count("\n") == 1
    assert named in answer.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("spacing = 0.25", "spacing = 0.5"), "spacing"),
        (('name = "small"', 'name = "other"'), "'small'"),
        (("radius = 3.0", "radius = 3.5"), "radius"),
        (("surely_returned_width = 0.12", "surely_returned_width = 0.13"), "bounds"),
    ],
    ids=["spacing", "name", "ball", "sensor"],
)
def test_a_map_of_something_else_is_refused_and_unharmed(folder, explored, tmp_path, change, named):
    kept = folder / "out" / "map.keepmap"
    before = kept.read_bytes()
    mission = MISSION.replace("[map]", f'[map]\nfile = "{kept}"').replace(*change)
    (tmp_path / "mission.toml").write_text(mission)
    answer = keepout_command("explore", tmp_path / "mission.toml", "-o", tmp_path / "out")
    assert answer.code == 1
    assert answer.err.count("\n") == 1
    assert str(kept) in answer.err
    assert named in answer.err
    assert kept.read_bytes() == before


def test_a_folder_that_cannot_be_made_is_refused_before_anything_flies(folder, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")

    def flown(*_, **__):
        raise AssertionError("flown")

    monkeypatch.setattr("keepout.exploring.explore.explore", flown)
    answer = keepout_command("explore", folder / "mission.toml", "-o", tmp_path / "file")
    assert answer.code == 1
    assert answer.err.count("\n") == 1
    assert str(tmp_path / "file") in answer.err
    assert (tmp_path / "file").read_text() == "in the way"


def test_the_name_is_exported():
    assert keepout.explore.__module__ == "keepout.exploring.explore"
    assert keepout.Exploration.__module__ == "keepout.exploring.exploration"

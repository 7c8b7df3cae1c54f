"""`keepout inspect`, as a person calls it: it sees all of a box, or refuses in a line and writes nothing."""

import json

import numpy as np
import pytest
from truths.command_line import keepout_command

import keepout
from keepout.flight.record import FlightRecord
from keepout.inspecting.frames_file import coverage_of_files, load_frames

pytestmark = pytest.mark.long

MISSION = """
name = "look"
seed = 1
duration = 2500.0
[target]
source = "box"
[field]
source = "grid"
[chaser]
radius = 0.4
[disturbance]
kind = "none"
[camera]
greatest_range = 6.0
[start]
position = [0.0, 5.0, 2.0]
[inspect]
stand_off = 1.2
patch_size = 0.5
coverage = 0.98
candidates = 300
"""
HALF, RADIUS = np.array([2.0, 1.5, 1.0]), 0.4
"""Of the box and of the chaser, m."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspect")
    (folder / "mission.toml").write_text(MISSION)
    return folder


@pytest.fixture(scope="module")
def inspected(folder):
    return keepout_command("inspect", folder / "mission.toml", "-o", folder / "out", "--json")


def test_it_sees_the_box_and_says_so(folder, inspected):
    summary = inspected.json
    assert {"look.parquet", "frames.parquet", "summary.json", "unseen.json", "index.html", "replay.html"} <= {
        path.name for path in (folder / "out").iterdir()
    }
    assert json.loads((folder / "out" / "summary.json").read_text()) == summary
    assert summary["outcome"] in {"all seen", "98 % asked, seen"}
    assert summary["coverage_possible"] >= 0.97
    assert 0.0 < summary["plan_duration_s"] < 2500.0
    assert summary["coverage_planned_in_time"] == summary["coverage_planned"] >= 0.98 * summary["coverage_upper_bound"]
    assert summary["proof_ended_by_clock"] is False
    assert summary["views_at_least"] <= summary["candidates_short_listed"] <= summary["candidates"]
    assert summary["contact"] is False
    assert summary["start_certified"] is True
    assert summary["coverage_seeable"] >= 0.97
    assert summary["coverage"] <= summary["coverage_upper_bound"] + 1e-9
    assert summary["coverage_lower_bound"] <= summary["coverage_upper_bound"]
    assert summary["seconds"] > 0.0
    assert {"views", "minimum_clearance_m", "delta_v_mps", "duration_s"} <= set(summary)


def test_the_figures_are_those_of_the_flight_and_of_the_true_box(folder, inspected):
    summary = inspected.json
    record = FlightRecord.load(folder / "out" / "look.parquet")
    apart = np.linalg.norm(np.maximum(np.abs(record.position) - HALF, 0.0), axis=1)
    assert apart.min() >= 1.2
    assert summary["minimum_clearance_m"] == pytest.approx(apart.min() - RADIUS, abs=5e-3)
    assert summary["minimum_clearance_m"] <= apart.min() - RADIUS + 1e-9
    assert summary["duration_s"] == record.time[-1]
    pushed = np.linalg.norm(record.force[:-1], axis=1).sum() * (record.time[1] - record.time[0]) / 20.0
    assert summary["delta_v_mps"] == pytest.approx(pushed, rel=1e-6)


def test_the_files_alone_give_the_same_coverage(folder, inspected):
    again = coverage_of_files(folder / "out" / "look.parquet", folder / "out" / "frames.parquet")
    assert again.same
    assert again.coverage == pytest.approx(inspected.json["coverage"], abs=1e-12)
    assert len(again.frames) == inspected.json["frames"]


def test_a_boresight_that_was_changed_in_the_file_is_found_out(folder, inspected, tmp_path):
    import dataclasses

    from keepout.inspecting.frames_file import save_frames

    assert inspected.code == 0
    frames, sha256 = load_frames(folder / "out" / "frames.parquet")
    # It looks away from the box and says that it shows nothing, as is true; but no camera turns so far in a period.
    away = dataclasses.replace(frames[-1], boresight=-frames[-1].boresight, units=frames[-1].units[:0])
    path = save_frames(tmp_path / "frames.parquet", (*frames[:-1], away), target_sha256=sha256)
    again = coverage_of_files(folder / "out" / "look.parquet", path)
    assert len(again.breaches) == 1
    assert "camera.turn_rate" in again.breaches[0]
    assert not again.same


def test_a_table_is_shown_without_json(folder):
    mission = MISSION.replace("duration = 2500.0", "duration = 40.0")
    (folder / "short.toml").write_text(mission)
    answer = keepout_command("inspect", folder / "short.toml", "-o", folder / "short", "--no-figures")
    assert answer.code == 0, answer.err
    assert "Inspection look" in answer.out
    assert "out of time" in answer.out
    assert "written to" in answer.out


REFUSALS = {
    "range": (("greatest_range = 6.0", "greatest_range = 1.1"), "camera.greatest_range: 1.1 m"),
    "period": (("[camera]", "[camera]\nperiod = 2.5"), "camera.period: 2.5 s"),
    "near": (("[0.0, 5.0, 2.0]", "[0.0, 2.5, 0.0]"), "start.position"),
    "profile": (("[camera]", '[control]\nprofile = "paper"\n[camera]'), "control.profile"),
    "stand-off": (("stand_off = 1.2", "stand_off = 0.45"), "inspect.stand_off: 0.45 m"),
    "field": (('source = "grid"', 'source = "absent.keepout"'), "absent.keepout"),
    "light": (
        ("[start]", '[light]\nkind = "fixed"\ndirection = [1, 0, 1]\ngreatest_incidence = 1e-3\n[start]'),
        "light.greatest_incidence: 0.001 rad",
    ),
    "patches": (("patch_size = 0.5", "patch_size = 9.0"), "inspect.patch_size: 9 m"),
}


@pytest.mark.parametrize(("change", "named"), REFUSALS.values(), ids=REFUSALS)
def test_a_refusal_is_one_line_that_names_the_entry(tmp_path, change, named):
    assert change[0] in MISSION
    (tmp_path / "mission.toml").write_text(MISSION.replace(*change))
    answer = keepout_command("inspect", tmp_path / "mission.toml", "-o", tmp_path / "out")
    assert answer.code == 1
    assert answer.err.startswith("keepout: ")
    assert answer.err.count("\n") == 1
    assert named in answer.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("old", ["satellite.glb", "satellite.keepout", "intelsat30", "absent.stl"])
def test_who_means_a_mesh_or_a_field_is_told_what_the_commands_are_called_now(old, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if old.startswith("satellite"):
        (tmp_path / old).write_bytes(b"\x00\x01")
    answer = keepout_command("inspect", old)
    assert answer.code == 1
    assert answer.err.count("\n") == 1
    assert "keepout measure" in answer.err
    assert old.endswith(".keepout") or f"keepout describe {old}" in answer.err


def test_the_names_are_exported():
    assert keepout.inspect.__module__ == "keepout.inspecting.inspect"
    assert keepout.Inspection.__module__ == "keepout.inspecting.inspection"

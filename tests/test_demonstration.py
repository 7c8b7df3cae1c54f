"""The demonstration, `reproduce case1 --quick`, is that of docs/demonstration.md: its flights, files and page."""

import json
from pathlib import Path

import numpy as np
import pytest
from truths.command_line import keepout_command
from truths.replay_page import ReplayPage
from truths.results import Page, check_picture

from keepout.flight.record import FlightRecord
from keepout.mission.scenario import Scenario
from keepout.report.terminal import shown

pytestmark = pytest.mark.long

PAGE = Path(__file__).parents[1] / "docs" / "demonstration.md"


def printed_table() -> dict[str, tuple]:
    """Trapped, within 0.1 m of the goal after (s), least clearance m, final error m, Δv m/s, share of steps saturated.

    The paper's law chatters where it touches its safe set, and another processor's rounding leads to another chatter:
    the tolerances of the test allow for it.
    """
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("| flight | trapped | contact |")) + 2
    table = {}
    for line in lines[first : first + 5]:
        name, trapped, contact, within, clearance, error, speed, saturated = (
            cell.strip() for cell in line.split("|")[1:-1]
        )
        assert contact == "no"
        seconds = None if within == "never" else float(within.removesuffix(" s"))
        share = float(saturated.removesuffix(" %")) / 100.0
        table[name] = (trapped == "**yes**", seconds, float(clearance), float(error), float(speed), share)
    return table


def test_the_demonstration_is_that_of_the_page(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    demonstration = keepout_command("reproduce", "case1", "--quick", "-o", "demo")
    assert demonstration.code == 0, demonstration.err
    assert "…" not in demonstration.out
    summaries = json.loads((tmp_path / "demo" / "summary.json").read_text(encoding="utf-8"))
    expected = printed_table()
    assert [one["name"] for one in summaries] == list(expected)
    assert {one["experiment"] for one in summaries} == {"case1"}
    for one, (trapped, within, clearance, error, speed, saturated) in zip(summaries, expected.values()):
        assert one["trapped"] is trapped
        assert one["contact"] is False
        assert one["first_within_s"] == (within if within is None else pytest.approx(within, rel=0.1))
        assert one["minimum_clearance_m"] == pytest.approx(clearance, abs=0.05)
        assert one["final_error_m"] == pytest.approx(error, abs=0.6 if trapped else 0.15)
        assert one["delta_v_mps"] == pytest.approx(speed, abs=0.5)
        assert one["saturated_fraction"] == pytest.approx(saturated, abs=0.005)
        assert shown(round(one["minimum_clearance_m"], 4)) in demonstration.out
        record = FlightRecord.load(one["flight"])
        scenario = Scenario.parse(json.loads(record.header["scenario"]))
        goal = np.asarray(scenario.goal.position)
        assert scenario.steps == record.steps == 3000
        assert scenario.start.position == tuple(record.position[0])
        # At rest or not, by the longest way between any two samples of the last five minutes.
        last = record.position[-301:]
        apart = np.linalg.norm(last[:, None] - last[None], axis=-1).max()
        assert bool(apart < 0.5 and np.linalg.norm(last[-1] - goal) > 1.0) is trapped
        if scenario.control.profile == "paper":
            # Each flight of a batch had its own goal and k_p: the paper's desired velocity in closed form.
            length = scenario.control.paper.slowing_length
            assert length == one["slowing_length_m"] == (1.5 if "wing" in one["name"] else 20.0)
            desired = -0.1 * np.tanh((record.position - goal) / length)
            np.testing.assert_allclose(record.desired_velocity, desired, atol=1e-12)
    check_reproduction(tmp_path / "demo", "case1", summaries)


def check_reproduction(out: Path, part: str, summaries):
    """The page of a reproduction holds the part's figures and tables as they stand in its folder, and its replay."""
    page = Page.read(out / "index.html")
    assert page.unclosed == []
    for address in page.outside:
        assert address == f"#{part}" or (out / address).stat().st_size > 100
    pictures = {path.stem: path for path in (out / part).glob("*.png")}
    assert (
        {"paths", "barrier", "error", "safe-velocity", "velocity", "wing", "map"} == set(pictures) == set(page.images)
    )
    for name, path in pictures.items():
        assert page.images[name] == path.read_bytes()
        assert f"{part}/{name}.svg" in page.outside
        check_picture(path)
    for table in ("flights", "map"):
        assert f"{part}/{table}.csv" in page.outside
    assert [line[0] for line in page.table[1 : 1 + len(summaries)]] == [one["name"] for one in summaries]
    assert f"{part}/replay.html" in page.outside
    replay = ReplayPage.read(out / part / "replay.html")
    assert list(replay.flights()) == [one["name"] for one in summaries if "wing" not in one["name"]]
    assert [surface["kind"] for surface in replay.told["surfaces"]].count("envelope") >= 1
    for one in summaries:
        if one["name"] in replay.flights():
            recorded = FlightRecord.load(one["flight"]).position
            np.testing.assert_allclose(replay.positions(one["name"]), recorded, rtol=1e-6, atol=1e-6)

"""`reproduce all --quick`, end to end: every part's tables, figures and page; a second run computes nothing anew."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from truths.command_line import keepout_command
from truths.replay_page import ReplayPage
from truths.results import Page, check_picture

from keepout.apps.reproduction import PARTS
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario

pytestmark = pytest.mark.slow

TABLES = {
    "table1": {"errors", "gradient_error"},
    "surfaces": {"surfaces"},
    "volumes": {"volumes"},
    "case1": {"flights", "map"},
    "case2": {"observers"},
    "runtime": {"step-times", "true-cone"},
    "case3": {"flights"},
}
"""Those that every quick run has; `case3` has one more for each campaign."""


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


def run(out):
    return keepout_command("reproduce", "all", "--quick", "--json", "-o", out).json


@pytest.fixture(scope="module")
def rows(out):
    return run(out)


def files(out, pattern):
    return {str(path.relative_to(out)): path.read_bytes() for path in out.glob(pattern)}


def test_every_part_has_rows_tables_and_figures(out, rows):
    assert json.loads((out / "summary.json").read_text(encoding="utf-8")) == rows
    assert list(dict.fromkeys(row["experiment"] for row in rows)) == list(PARTS) == list(TABLES)
    tables = json.loads((out / "tables.json").read_text(encoding="utf-8"))
    assert tables["quick"] is True
    assert [section["name"] for section in tables["sections"]] == list(PARTS)
    for section in tables["sections"]:
        folder = out / section["name"]
        assert section["paper"]
        assert section["ours"]
        named = {table["name"]: table["rows"] for table in section["tables"]}
        assert set(named) >= TABLES[section["name"]]
        assert {path.stem for path in folder.glob("*.csv")} == set(named)
        for name, entries in named.items():
            assert entries
            with (folder / f"{name}.csv").open(encoding="utf-8", newline="") as stream:
                read = list(csv.DictReader(stream))
            assert [list(entry) for entry in read] == [list(entry) for entry in entries]
        pictures = {path.stem for path in folder.glob("*.png")}
        assert {path.stem for path in folder.glob("*.svg")} == pictures
        assert bool(pictures) is (section["name"] not in ("table1", "volumes"))  # table1 draws fits, volumes nothing
        for picture in pictures:
            check_picture(folder / f"{picture}.png")
            assert (folder / f"{picture}.svg").stat().st_size > 1000


def test_the_page_links_only_to_what_is_there(out, rows):
    page = Page.read(out / "index.html")
    assert page.unclosed == []
    linked = {address for address in page.outside if not address.startswith("#")}
    assert {address[1:] for address in page.outside if address.startswith("#")} == set(PARTS)
    for address in linked:
        assert (out / address).stat().st_size > 10
    assert linked == {name for end in ("*.csv", "*.png", "*.svg", "replay.html") for name in files(out, f"*/{end}")}
    # Counted, as figures of two parts may have one name.
    assert (out / "index.html").read_text(encoding="utf-8").count("<img ") == len(files(out, "*/*.png"))


def test_a_second_run_computes_nothing_and_gives_the_same(out, rows):
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/kept/*")}
    tables = files(out, "*/*.csv")
    assert kept
    assert run(out) == rows
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/kept/*")} == kept
    assert files(out, "*/*.csv") == tables


KEPT = Path(__file__).parents[3] / "benchmarks" / "results" / "paper.json"


def table_of(path: Path) -> dict[str, dict]:
    """Give the rows of Case 1's flights in a file of tables, by the flight's name."""
    sections = json.loads(path.read_text(encoding="utf-8"))["sections"]
    tables = next(section["tables"] for section in sections if section["name"] == "case1")
    return {row["flight"]: row for row in next(table["rows"] for table in tables if table["name"] == "flights")}


def test_the_demonstration_flies_as_the_results_tell(out, rows):
    """The paper's law chatters where it touches its safe set, on another processor otherwise: hence the tolerances."""
    summaries = [row for row in rows if row["experiment"] == "case1"]
    names, flown, told = [one["name"] for one in summaries], table_of(out / "tables.json"), table_of(KEPT)
    assert list(flown) == names
    replay = ReplayPage.read(out / "case1" / "replay.html")
    assert list(replay.flights()) == [name for name in names if "wing" not in name]
    for one in summaries:
        row, expected, trapped = flown[one["name"]], told[one["name"]], one["trapped"]
        assert (row["end"], row["contact"]) == (expected["end"], expected["contact"])
        assert one["contact"] is (row["contact"] != "no")
        for key, near in (
            ("within s", {"rel": 0.1}),
            ("least gap m", {"abs": 0.05}),
            ("error m", {"abs": 0.6 if trapped else 0.15}),
        ):
            assert row[key] == (None if expected[key] is None else pytest.approx(expected[key], **near)), key
        record = FlightRecord.load(one["flight"])
        scenario = Scenario.parse(json.loads(record.header["scenario"]))
        goal = np.asarray(scenario.goal.position)
        assert scenario.steps == record.steps == 3000
        # At rest or not, by the longest way between any two samples of the last five minutes.
        last = record.position[-301:]
        apart = np.linalg.norm(last[:, None] - last[None], axis=-1).max()
        assert bool(apart < 0.5 and np.linalg.norm(last[-1] - goal) > 1.0) is trapped
        if scenario.control.profile == "paper":
            # Each flight of a batch had its own goal and k_p: the paper's desired velocity in closed form.
            length = scenario.control.paper.slowing_length
            desired = -0.1 * np.tanh((record.position - goal) / length)
            np.testing.assert_allclose(record.desired_velocity, desired, atol=1e-12)
        if one["name"] in replay.flights():
            np.testing.assert_allclose(replay.positions(one["name"]), record.position, rtol=1e-6, atol=1e-6)

"""Case 1: pairs, counts, kept batches and words; its flights are those of the demonstration (test_demonstration)."""

import csv
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from keepout.experiments import passages as flying
from keepout.experiments.case1 import table_line
from keepout.experiments.case1_map import draw_pairs, map_rows
from keepout.experiments.case1_words import findings
from keepout.experiments.part import Table
from keepout.experiments.passages import Passage, fly_passages
from keepout.experiments.work import Work
from keepout.geometry.target import Target
from keepout.mission.scenario import Scenario
from keepout.report.reproduction import write_table
from keepout.report.terminal import WIDTH, entries_table

SCENARIO = Scenario().replace(name="some", control={"profile": "paper"})


def test_pairs_lie_on_either_side_with_room():
    pairs = np.array(draw_pairs(300, seed=0))
    assert pairs.shape == (300, 2, 3)
    np.testing.assert_array_equal(pairs, draw_pairs(300, seed=0))
    assert not np.array_equal(pairs, draw_pairs(300, seed=1))
    assert (np.abs(pairs[..., [0, 2]]) <= [4.0, 3.0]).all()
    along = pairs[..., 1] * [1.0, -1.0]
    assert ((along >= 5.0) & (along <= 12.0)).all()
    # A box about a target bounds its distance from below, whatever is in it.
    assert np.abs(Target.load("intelsat30").vertices[:, 1]).max() < 5.0 - 0.5 - 0.5


def test_the_map_counts_each_passage_once():
    landed = {
        "first_within_s": np.array([10.0, np.inf, np.inf, 20.0, 30.0, np.inf]),
        "trapped": np.array([False, True, False, False, False, True]),
        "contact": np.array(["no", "yes", "undecided", "yes", "no", "no"]),
        "minimum_clearance_m": np.array([0.3, -0.2, 0.1, 0.5, 0.4, 0.6]),
    }
    first, second = map_rows("skew", [1.5, 20.0], 3, landed)
    assert first == {
        "circulation": "skew",
        "k_p m": 1.5,
        "pairs": 3,
        "trapped": 1,
        "arrived": 1,
        "clean": 1,
        "touched": 2,
        "least gap m": -0.2,
    }
    assert (second["k_p m"], second["trapped"], second["arrived"], second["clean"]) == (20.0, 1, 2, 1)
    assert second["touched"] == 1


def unprepared() -> Any:
    """Stands for a mission that nothing asks for."""


@pytest.fixture
def flown(monkeypatch):
    """Batches that were asked for, as lists of starts; the third stops the run where it is told to."""
    asked = []

    def fly(mission, part, size, guidances, logs):
        asked.append((len(part), size, logs))
        if len(asked) == flown.stops_at:
            raise KeyboardInterrupt
        columns = {name: np.array([one.start[0] for one in part]) for name in ("trapped", "contact")}
        return columns | {"log_time": np.array([[one.start[0]] for one in part[:logs]]).reshape(logs, 1)}

    monkeypatch.setattr(flying, "_fly", fly)
    monkeypatch.setattr(flying, "_own_guidances", lambda mission: None)
    flown = SimpleNamespace(asked=asked, stops_at=0)
    return flown


def test_a_stopped_run_loses_only_the_batch_under_way(tmp_path, flown):
    passages = [Passage((float(i), 10.0, 0.0), (0.0, -10.0, 0.0), 20.0) for i in range(150)]
    work = Work(tmp_path)

    def fly(made_with="field"):
        return fly_passages(work, SCENARIO, passages, unprepared, made_with=[made_with], logs=2)

    flown.stops_at = 3
    with pytest.raises(KeyboardInterrupt):
        fly()
    flown.stops_at = 0
    landed = fly()
    # Every batch is as large as the first, so that one program serves all; the last is flown again, the others not.
    assert flown.asked == [(60, 60, 2), (60, 60, 0), (30, 60, 0), (30, 60, 0)]
    np.testing.assert_array_equal(landed["trapped"], np.arange(150.0))
    np.testing.assert_array_equal(landed["log_time"], [[0.0], [1.0]])
    fly()
    assert len(flown.asked) == 4
    fly("another field")
    assert len(flown.asked) == 7


def row(name, *, trapped, within, contact, barrier, length: float | None = 20.0):
    return {
        "name": name,
        "trapped": trapped,
        "first_within_s": within,
        "slowing_length_m": length,
        "contact_verdict": contact,
        "minimum_clearance_m": 0.125448209545966,
        "minimum_barrier_m": barrier,
        "final_error_m": 12.817127466315696,
    }


ROWS = [
    row("paper without circulation", trapped=True, within=None, contact="no", barrier=-0.01745069403076127),
    row("k_p 15, paper with circulation, 20 Hz", trapped=False, within=2861.05, contact="yes", barrier=-2.763e-05),
    row("default law", trapped=False, within=None, contact="undecided", barrier=0.9, length=None),
]


def test_the_words_are_those_of_the_numbers():
    counts = [{"circulation": "none", "k_p m": 20.0, "trapped": 9, "pairs": 24, "clean": 7, "touched": 6}]
    said = " ".join(findings(ROWS, counts, has_network=False))
    assert "Paper without circulation: comes to rest 12.8 m from the goal, without contact" in said
    assert "is within the goal's tolerance after 2861 s, and touches the target" in said
    assert "Default law: is still under way at the end, 12.8 m from the goal, contact undecided" in said
    assert "its least is -0.0175 m (paper without circulation)" in said
    assert "At k_p = 20 m, of 24 random pairs were trapped, arrived without a touch, touched: none 9, 7, 6." in said
    assert "none of the paper's network was given" in said
    assert "paper's network" not in " ".join(findings(ROWS, counts, has_network=True))


def test_the_table_of_flights_fits_a_terminal_with_a_row_each(tmp_path):
    lines = [table_line(one) for one in ROWS]
    drawn = entries_table("Flights", lines)
    assert [column.header for column in drawn.columns] == list(lines[0])
    assert sum(column.max_width or 0 for column in drawn.columns) + 3 * len(drawn.columns) + 1 <= WIDTH
    with write_table(tmp_path, Table("flights", "", lines)).open(encoding="utf-8") as stream:
        read = list(csv.DictReader(stream))
    assert [one["end"] for one in read] == ["trapped", "arrived", "under way"]
    assert [float(one["least h m"]) for one in read] == [-0.0175, 0.0, 0.9]

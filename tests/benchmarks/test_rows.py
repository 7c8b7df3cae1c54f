"""Rows of `benchmarks/faults.py` and `benchmarks/reach.py`: kept, flown no second time, and summed up."""

import json
from argparse import Namespace
from collections import namedtuple
from types import SimpleNamespace

import faults
import numpy as np
import pytest
import reach
from kept_rows import Rows, show

from keepout.audit.audit import Contact
from keepout.mission.scenario import Scenario


@pytest.mark.parametrize("kept", ["rows.json", None])
def test_a_row_takes_the_place_of_one_flown_with_other_settings(tmp_path, kept):
    path = None if kept is None else tmp_path / "new" / kept
    store = Rows(path, ("name", "seed"), ("version",))
    for row in ({"name": "a", "seed": 0, "version": 1}, {"name": "b", "seed": 0, "version": 1}):
        assert store.find(row) is None
        store.keep(row | {"figure": 1.5})
    store.keep({"name": "a", "seed": 0, "version": 2, "figure": 2.5})
    assert store.find({"name": "a", "seed": 0, "version": 1}) is None
    assert store.find({"name": "a", "seed": 0, "version": 2})["figure"] == 2.5
    assert [(row["name"], row["figure"]) for row in store.kept] == [("b", 1.5), ("a", 2.5)]
    if path is not None:
        assert Rows(path, ("name", "seed"), ("version",)).kept == store.kept == json.loads(path.read_text())


def test_a_table_has_three_digits_and_blanks_for_what_a_row_lacks(capsys):
    show([{"name": "a", "figure": 1.23456}, {"name": "b"}], ("name", "figure"))
    assert capsys.readouterr().out.splitlines()[2:] == ["| a | 1.23 |", "| b |  |"]


def test_rows_of_faults_are_flown_once_and_again_where_the_field_is_another(tmp_path, monkeypatch):
    flown, digests = [], {"here": "1" * 64, "there": "2" * 64}
    world = type("World", (), {"setup": lambda self, told, duration: None})()
    monkeypatch.setattr(faults, "World", lambda name: world)
    monkeypatch.setattr(faults, "look_up", lambda name: (None, None, digests[name]))
    monkeypatch.setattr(faults, "fly_row", lambda world, setup, fault, plan: flown.append(plan) or plan)
    asked = Namespace(
        flights=1520, targets=["here", "there"], duration=60, seed=0, keeps_margin=False, out=tmp_path / "rows.json"
    )
    rows = faults.fly_all(asked, lambda row: None)
    assert len(rows) == len(flown) == 2 * len(faults.ROWS)
    assert {row["flights"] for row in rows} == {10}
    assert faults.fly_all(asked, lambda row: None) == rows
    assert len(flown) == len(rows)
    digests["there"] = "3" * 64
    again = faults.fly_all(asked, lambda row: None)
    assert len(flown) == 3 * len(faults.ROWS)
    assert len(again) == len(rows)
    assert {row["digest"] for row in again} == {"1" * 64, "3" * 64}
    monkeypatch.setattr(faults, "RECIPE", faults.RECIPE + 1)
    faults.fly_all(asked, lambda row: None)
    assert len(flown) == 5 * len(faults.ROWS)


Outcome = namedtuple("Outcome", ("reached", "time_to_reach", "delta_v", "saturated_fraction"))


def part(pairs, reached, seconds, delta_v, contacts, clearances):
    outcome = Outcome(*map(np.array, (reached, seconds, delta_v, np.zeros(len(pairs)))))
    audits = [SimpleNamespace(contact=c, minimum_clearance=m) for c, m in zip(contacts, clearances, strict=True)]
    return np.array(pairs), outcome, tuple(audits), [2.0] * len(pairs)


def test_a_row_of_reach_sums_up_all_parts():
    first = part([0, 2], [True, True], [30.0, 60.0], [1.0, 2.0], [Contact.NO, Contact.YES], [0.5, -0.1])
    second = part([3], [False], [np.inf], [6.0], [Contact.UNDECIDED], [0.0])
    row = reach.figures([first, second], np.array([2.0, np.nan, 3.0, 5.0]), 0.1)
    assert row == {
        "reached": 2,
        "contacts": 1,
        "undecided": 1,
        "minimum_clearance_m": -0.1,
        "saturated_fraction": 0.0,
        "delta_v_mps": 2.0,
        "delta_v_over_floor": 1.0,
        "time_over_bound": pytest.approx(1.75),
    }
    assert reach.figures([], np.empty(0), 0.1) == {}


def test_the_floor_of_delta_v_is_that_of_a_steady_push_and_two_changes_of_speed():
    push = np.tile([0.0, 0.03, 0.04], (2, 101, 1))
    assert reach.floor(Scenario(), push) == pytest.approx(2 * [0.05 * 101 / 20.0 + 0.2])

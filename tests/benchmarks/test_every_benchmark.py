"""Every benchmark can be imported, says what it is and has a command line; its rows are kept and summed up rightly."""

import importlib
import inspect
import json
import sys
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import flight_code_mutants
import mutants
import numpy as np
import pytest
import reach
from kept_rows import Rows

from keepout.core.audit.audit import Contact
from keepout.core.mission.scenario import Scenario

ROOT = Path(__file__).parents[2]
BENCHMARKS = sorted(path.stem for path in (ROOT / "benchmarks").glob("*.py"))
WITHOUT_OPTIONS = {"fields"}


def test_each_mutant_changes_a_text_that_occurs_once():
    python, c = ROOT / "src/keepout", ROOT / "src/keepout/apps/flight_code/sources"
    every = [(python / one.file, one.text) for one in mutants.mutants()]
    every += [(c / file, text) for file, some in flight_code_mutants.MUTANTS.items() for _, text, _ in some]
    wrong = [(path.name, text) for path, text in every if path.read_text(encoding="utf-8").count(text) != 1]
    assert len(every) > 100
    assert not wrong


@pytest.mark.long
@pytest.mark.parametrize("name", BENCHMARKS)
def test_it_is_imported_and_helps(name, monkeypatch, capsys):
    text = (ROOT / "benchmarks" / f"{name}.py").read_text(encoding="utf-8")
    if name == "cluster":
        pytest.importorskip("distributed", reason="needs keepout-gnc[cluster]")
    module = importlib.import_module(name)
    assert (module.__doc__ or "").strip()
    if "__main__" not in text or name in WITHOUT_OPTIONS:
        return
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as stop:
        module.main(*([["--help"]] if inspect.signature(module.main).parameters else []))
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("usage: ")


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
        "clean": 1,
        "contacts": 1,
        "undecided": 1,
        "minimum_clearance_m": -0.1,
        "saturated_fraction": 0.0,
        "delta_v_mps": 2.0,
        "delta_v_over_floor": 1.0,
        "time_over_bound": pytest.approx(1.75),
    }


def test_the_floor_of_delta_v_is_that_of_a_steady_push_and_two_changes_of_speed():
    push = np.tile([0.0, 0.03, 0.04], (2, 101, 1))
    assert reach.floor(Scenario(), push) == pytest.approx(2 * [0.05 * 101 / 20.0 + 0.2])

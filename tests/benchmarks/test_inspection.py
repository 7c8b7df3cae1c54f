"""Rows of `benchmarks/inspection.py` around a box: flown, kept, flown no second time, and compared."""

import json

import inspection
import pytest
from kept_rows import Rows

KEYS = ("coverage", "coverage_seeable", "coverage_upper_bound", "views", "contact", "minimum_clearance_m")
KEYS += ("delta_v_mps", "duration_s", "seconds", "plan_seconds", "shares", *inspection.PLACE)


@pytest.fixture(scope="module")
def box():
    """Give a box that is flown around without the guard, which takes most of the time to compile."""
    chosen = {"field": {"source": "grid"}, "duration": 3000.0, "guard": {"enabled": False}}
    return inspection.Inspected("box", patch=1.0, reach=6.0, **chosen)


def test_a_row_of_a_box_has_the_figures_and_is_kept(box, tmp_path, monkeypatch):
    path = tmp_path / "rows.json"
    rows = Rows(path, inspection.PLACE, inspection.SETTINGS)
    rows.keep(box.plan_of("targets", "plan", "none", 0) | {"coverage_seeable": 0.999})
    shown = inspection.fly(box, ["targets", "dispersed"], rows, flights=1, seed=3)
    calm, row = shown
    assert set(KEYS) <= row.keys()
    assert (row["part"], row["seed"]) == ("dispersed", 3)
    assert row["outcome"] in {"all seen", "99.5 % asked, seen"}
    assert row["contact"] is False
    assert row["minimum_clearance_m"] > 0.9
    assert row["coverage_seeable"] > 0.99
    assert row["coverage_loss"] == 0.999 - row["coverage_seeable"]
    assert calm["coverage_loss"] is None
    assert len(json.loads(path.read_text())) == 2
    monkeypatch.setattr(box, "row", None)
    assert inspection.fly(box, ["targets", "dispersed"], rows, flights=1, seed=3) == shown


def test_a_refusal_is_a_row(monkeypatch):
    monkeypatch.setattr(inspection, "POSITION_ERROR", 5.0)
    guarded = inspection.Inspected("box", patch=1.0, reach=6.0, field={"source": "grid"}, duration=3000.0)
    rows = Rows(None, inspection.PLACE, inspection.SETTINGS)
    (row,) = inspection.fly(guarded, ["dispersed"], rows, flights=1, seed=0)
    assert row["outcome"] == "refused"
    assert row["why"]


def test_dispersed_flights_differ_and_stay_within_their_bounds(box):
    calm = box.flown("targets")
    starts = set()
    for seed in range(20):
        scenario = box.flown("dispersed", seed=seed)
        moved = [abs(a - b) for a, b in zip(scenario.start.position, calm.start.position, strict=True)]
        assert max(moved) <= inspection.BESIDE
        assert scenario.faults.position_noise == scenario.guard.position_error > 0.0
        assert scenario.faults.velocity_noise == scenario.guard.velocity_error > 0.0
        starts.add(scenario.start.position)
    assert len(starts) == 20

"""Case 3: a campaign goes on where it was stopped, and its figures are those of its flights."""

from types import SimpleNamespace

import numpy as np
import pytest

from keepout.apps.reproduction import case3
from keepout.apps.reproduction.in_memory import SERIES, CampaignPlan, FlightSeries
from keepout.apps.reproduction.work import Work
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import silent

RUNS = 7
SAMPLES = 5


def columns(first, last):
    """Flights whose every number tells which flight it is."""
    flight = np.arange(first, last, dtype=float)
    return {
        **{f"start_{axis}": flight + k for k, axis in enumerate("xyz")},
        "reached": flight != 2,
        "final_error": flight,
        "time_to_reach": 100.0 + flight,
        "delta_v": flight,
        "saturated_fraction": 0.0 * flight,
        "guard_interventions": np.zeros(len(flight), int),
        "guard_flags": np.array([""] * len(flight), str),
        "contact": np.array(["yes" if f == 3 else "undecided" if f == 4 else "no" for f in flight], str),
        "minimum_clearance": flight - 3.5,
        "minimum_barrier": flight - 1.5,
        "largest_speed": 0.1 + 0.01 * flight,
    }


class Plan(CampaignPlan):
    """A campaign that flies nothing and may be stopped."""

    def __init__(self, stop_at=None):
        self.flown, self.stop_at = [], stop_at

    def fly(self, first, last, *, batch):
        if first == self.stop_at:
            raise KeyboardInterrupt
        self.flown.append((first, last, batch))
        flight = np.arange(first, last)[:, None]
        values = {name: (flight + 0.1 * np.arange(SAMPLES)).astype(np.float32) for name in SERIES}
        series = FlightSeries(np.arange(SAMPLES, dtype=float), values)
        return SimpleNamespace(columns=lambda: columns(first, last), series=series, starts_drawn_again=11)


def fly(folder, monkeypatch, plan, **changes):
    monkeypatch.setattr(case3, "CHUNK", 3)
    monkeypatch.setattr(case3, "plan_campaign", lambda scenario, target, model: plan)
    scenario = Scenario().replace(campaign={"runs": RUNS}, **changes)
    return case3.flown(Work(folder), scenario, Target.load("intelsat30"), None, silent)


@pytest.mark.long
def test_a_stopped_campaign_goes_on(tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        fly(tmp_path, monkeypatch, Plan(stop_at=6))
    rest, whole, again = Plan(), Plan(), Plan()
    resumed = fly(tmp_path, monkeypatch, rest)
    assert rest.flown == [(6, 7, 3)]
    unbroken = fly(tmp_path / "other", monkeypatch, whole)
    assert whole.flown == [(0, 3, 3), (3, 6, 3), (6, 7, 3)]
    assert set(resumed) == set(unbroken)
    for name, array in unbroken.items():
        np.testing.assert_array_equal(resumed[name], array, err_msg=name)
    np.testing.assert_array_equal(resumed["start_x"], np.arange(RUNS))
    assert resumed["barrier"].shape == (RUNS, SAMPLES)
    fly(tmp_path, monkeypatch, again)
    assert not again.flown
    fly(tmp_path, monkeypatch, again, seed=1)
    assert len(again.flown) == 3


def test_the_figures_are_those_of_the_flights(tmp_path, monkeypatch):
    arrays = fly(tmp_path, monkeypatch, Plan())
    arrays["barrier"][0, 0] = -0.1
    scenario = case3.case3_scenarios(0, quick=True)["iss", case3.PRINTED]
    row = case3.row("iss", case3.PRINTED, scenario, arrays)
    counts = ("flights", "reached", "contacts", "undecided", "starts_below_h_0", "below_h_0", "starts_drawn_again")
    assert [row[name] for name in counts] == [7, 6, 2, 1, 1, 2, 11]
    assert row["minimum_clearance_m"] == -3.5
    assert row["median_time_to_reach_s"] == np.median([100, 101, 103, 104, 105, 106])
    assert row["largest_final_error_m"] == pytest.approx(6.4)
    assert row["over_axis_limit"] == 7


def settings_rows():
    kinds = [(1.5, 0.0, 250, 190, 60), (5.0, 0.4, 240, 240, 0), (10.0, 0.4, 240, 240, 3)]
    names = ("k_p m", "e_∇h", "reached", "clean", "contacts")
    return [{"target": "iss", "flights": 256} | dict(zip(names, kind, strict=True)) for kind in kinds]


def test_the_best_setting_is_that_of_most_clean_flights_and_then_of_fewest_contacts():
    assert case3.best_of(settings_rows(), "iss")["k_p m"] == 5.0

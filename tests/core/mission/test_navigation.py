"""Scenarios with sensors: what flies, what is told of it, and what is refused."""

import dataclasses
import json

import numpy as np
import pytest

from keepout.core.errors import ScenarioError
from keepout.core.mission.build import prepare, require_navigation
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import load_target
from keepout.verbs.check import check, number_refusal

CLOSE = {
    "duration": 150.0,
    "target": {"source": "box"},
    "field": {"source": "grid"},
    "start": {"position": [0.0, 8.0, 4.0]},
    "goal": {"position": [3.0, 8.0, 5.0]},
    "control": {"guidance": "straight"},
    "navigation": {"suite": "close"},
    "thrusters": {"layout": "six", "modulation": "delta-sigma"},
}
"""A short way above a box, with pulses."""


def scenario(**tables):
    return Scenario.parse(CLOSE | tables)


@pytest.fixture(scope="module")
def mission():
    return prepare(scenario())


@pytest.fixture(scope="module")
def flight(mission):
    return mission.fly()


@pytest.fixture(scope="module")
def target():
    return load_target(scenario().target)


@pytest.mark.long
def test_a_flight_by_sensors_and_pulses_arrives(flight):
    told = flight.summary()
    assert told["reached"]
    assert (told["contact_verdict"], told["start_certified"], told["assumptions_broken"]) == ("no", True, [])
    assert (told["guard_interventions"], told["guard_flags"]) == (0, {})
    assert told["saturated_fraction"] < 0.01


@pytest.mark.long
def test_the_truth_is_in_the_known_set_and_the_set_within_its_caps(flight):
    record, guard = flight.record, flight.guard
    for name, cap in (("position", guard["position_error_m"]), ("velocity", guard["velocity_error_mps"])):
        radius = getattr(record, f"known_{name}_error")
        away = np.linalg.norm(getattr(record, f"known_{name}") - getattr(record, name), axis=1)
        assert np.all(away <= radius)
        assert np.all(radius <= cap)
        assert np.all(radius > 0.0)
        assert away.max() > 0.1 * cap  # a set around something else than the sensors' samples would be caught
    assert not record.contradicted.any()


@pytest.mark.long
def test_a_seed_says_everything(mission, flight):
    again, other = (
        dataclasses.replace(mission, surroundings=Surroundings(seeded, mission.target)).fly().record
        for seeded in (mission.scenario, mission.scenario.replace(seed=mission.scenario.seed + 1))
    )
    for name, column in flight.record.columns.items():
        np.testing.assert_array_equal(getattr(again, name), column, err_msg=name)
    assert np.abs(other.estimated_position - flight.record.estimated_position).max() > 1e-3


@pytest.mark.long
def test_what_is_expected_is_what_the_flight_took(flight):
    found, told = check(flight.scenario), flight.summary()
    assert (found.refusals, found.start_certified) == ((), True)
    assert found.expected is not None
    assert told["delta_v_mps"] == pytest.approx(found.expected.delta_v, rel=0.25)
    assert told["time_to_reach_s"] == pytest.approx(found.expected.duration, rel=0.25)


@pytest.mark.long
def test_the_summary_tells_of_the_navigation(flight):
    told, record = flight.summary()["navigation"], flight.record
    assert told["position_error_cap_m"] == flight.guard["position_error_m"] == pytest.approx(0.05)
    assert told["velocity_error_cap_mps"] == flight.guard["velocity_error_mps"] == pytest.approx(0.002)
    wrong = record.estimated_position[:-1] - record.position[:-1]
    assert told["position_error_rms_m"] == pytest.approx(np.sqrt(np.mean(np.sum(wrong**2, axis=1))))
    # What a filter is for: below the raw samples' error, 0.05 sqrt(3/5) m and 0.002 sqrt(3/5) m/s.
    assert told["position_error_rms_m"] < 0.5 * 0.05 * np.sqrt(0.6)
    assert told["velocity_error_rms_mps"] < 0.5 * 0.002 * np.sqrt(0.6)
    assert (told["outliers"], told["contradicted_steps"], told["probability_beyond"]) == (0, 0, 0.0)
    json.dumps(told, allow_nan=False)


@pytest.mark.long
def test_the_guard_assumes_more_the_more_samples_can_be_lost(target):
    def caps(**entries):
        given = scenario(navigation={"suite": "close"} | entries)
        assumed = Surroundings(given, target).guard_assumptions
        return float(assumed.position_error), float(assumed.velocity_error), float(assumed.disturbance)

    none = caps()
    assert none[:2] == pytest.approx((0.05, 0.002))
    before = none
    for missed in (1, 2, 4):
        now = caps(dropout=0.1, most_missed=missed)
        assert now[0] > before[0]
        assert now[1] > before[1]
        before = now
        # A period without a sample adds D T to the velocity's radius; the first estimate is as good as a sample.
        told = caps(dropout=0.1, most_missed=missed, initial_position_error=0.05, initial_velocity_error=0.002)
        assert told[1] == pytest.approx(0.002 + missed * told[2])


SUITE = {"suite": "close"}


@pytest.mark.parametrize(
    ("refusing", "tables", "said"),
    [
        (require_navigation, {"navigation": {"position_noise": 0.1}}, ("position_noise", 'suite is "none"')),
        (require_navigation, {"navigation": {"suite": "far", "position_noise": 0.1}}, ("position_noise", "far")),
        (require_navigation, {"guard": {"position_error": 0.1}}, ("guard.position_error", "leave them out")),
        (require_navigation, {"faults": {"position_noise": 0.1}}, ("faults.position_noise", "leave them out")),
        (number_refusal, {"navigation": SUITE | {"dropout": 0.1}}, ("navigation.dropout: 0.1", "most_missed")),
        (number_refusal, {"navigation": {"suite": "far"}}, ("guard: ", "force_limit is 0.1 N")),
    ],
)
def test_what_cannot_be_flown_is_refused(refusing, tables, said, target):
    try:
        refusal = refusing(scenario(**tables), *[target] * (refusing is number_refusal))
    except ScenarioError as error:
        refusal = error
    assert all(part in str(refusal) for part in said), refusal
    assert "\n" not in str(refusal)

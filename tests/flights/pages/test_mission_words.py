"""What a check says of a scenario: every fault, sensor, thruster and delay that is flown stands in a sentence."""

import pytest

from keepout.core.geometry.target import Target
from keepout.core.mission.entries import FaultsEntry
from keepout.core.mission.scenario import Scenario
from keepout.flights.pages.mission_words import in_words

FAULTS = {
    **{name: 0.0123 for name in FaultsEntry.model_fields if "bias" in name or "noise" in name},
    **{"law": "random", "delay": 7, "dropped": 0.0123, "gain_error": 0.0123, "stuck": "+y", "thruster": 3},
    **{
        "stuck_force": 0.0123,
        "stuck_from": 47.5,
        "abort_at": 47.5,
        "thruster_stuck": "on",
        "noise_correlation_time": 47.5,
    },
}
NEEDS = {
    "stuck_force": {"stuck": "+y"},
    "stuck_from": {"stuck": "+y"},
    "thruster_stuck": {"thruster": 3},
    "noise_correlation_time": {"position_noise_std": 0.1},
}


def said(**tables) -> str:
    return " ".join(in_words(Scenario(target={"source": "box"}, **tables), Target.load("box")))


@pytest.mark.parametrize("fault", FaultsEntry.model_fields)
def test_every_fault_is_said_with_its_number(fault):
    layout = {"thrusters": {"layout": "12"}} if "thruster" in fault else {}
    without = said(**layout, faults=NEEDS.get(fault, {}))
    words = said(**layout, faults=NEEDS.get(fault, {}) | {fault: FAULTS[fault]})
    assert words != without
    assert str(FAULTS[fault]) in words


def test_sensors_thrusters_delay_and_tumbling_are_said():
    plain = said()
    assert "Its thrusters are ideal" in plain
    assert "no sensors fly" in plain
    assert not any(word in plain for word in ("tumbles", "count on", "sticks", "Required"))
    words = said(
        thrusters={"layout": "24", "survive_failure": True, "misalignment": 0.01},
        navigation={"suite": "near"},
        guard={"delay": 2, "mass_error": 0.05},
        attitude={"kind": "tumbling", "angular_velocity": (0.0, 0.02, 0.0), "gravity_gradient": True},
        require={"contact": "proved", "clearance_m": 0.25},
    )
    for part in (
        'Its 24 thrusters (layout "24")',
        "0.01 rad askew; the guard covers one that sticks",
        "range bearing every 1 s, 1 s late, at most 2 lost in a row",
        "target attitude every 2 s",
        "a Kalman filter",
        "count on 2 control periods (2 s)",
        "a mass wrong by up to 0.05 of it",
        "tumbles freely, at first at 1.15 °/s about [0, 0.02, 0]",
        "gravity turns it too",
        "Required: proved free of contact, proved clearance of at least 0.25 m.",
    ):
        assert part in words
    broken = said(thrusters={"layout": "own", "own": [{"position": (0, 0, 0), "direction": (1, 0, 0), "force": 1.0}]})
    assert 'those of layout "own"' in broken  # which the check refuses


def test_legs_zones_corridors_and_the_rule_of_speeds_are_said():
    assert not any(word in said() for word in ("leg", "zone", "corridor", "By the distance"))
    hold = {"name": "far", "position": (15.0, 0.0, 0.0), "dwell": 30.0, "until": "go", "go_at": 150.0}
    words = said(
        duration=900.0,
        leg=[hold, {"position": (3.6, 0.0, 0.0), "speed_limit": 0.04, "within": (200.0, 800.0)}],
        zone=[
            {"name": "ball", "shape": "sphere", "centre": (0.0, 0.0, 0.0), "radius": 12.0, "until": "go"},
            {"shape": "box", "lower": (9.0, 9.0, 9.0), "upper": (10.0, 10.0, 10.0), "axes": "vvlh", "start": 20.0},
        ],
        corridor=[{"port": (2.0, 0.0, 0.0), "axis": (1.0, 0.0, 0.0), "length": 10.0, "radius": 1.5}],
        approach={"speed_by_distance": [(12.0, 0.08), (1.0, 0.02)]},
    )
    for part in (
        'flies 2 legs: leg "far" to [15, 0, 0] m within 0.5 m, held for 30 s and until "go" (in simulation at 150 s)',
        "leg 1 to [3.6, 0, 0] m within 0.5 m at up to 0.04 m/s between 200 s and 800 s.",
        '2 zones: zone "ball", a sphere of 12 m, fixed to the target until "go"',
        "; zone 1, a box, fixed in VVLH from 20 s.",
        "1 corridor: corridor 0, a tube of 1.5 m, within 10 m of the port [2, 0, 0] m.",
        "By the distance to the mesh it flies at up to 0.08 m/s at 12 m, 0.02 m/s at 1 m",
    ):
        assert part in words

"""A scenario's thrusters: which layouts are refused, and what the guard is to assume of the others."""

import numpy as np
import pytest

from keepout.core.errors import ScenarioError
from keepout.core.mission.first_look import look, require_thrusters
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.thrusters.on_off import OnOffThrusters, errors_of, layout_of

FLAT = [
    {"position": [0, 0, 0], "direction": direction, "force": 0.2}
    for direction in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0])
]
UP = {"position": [0, 0, 0], "direction": [0, 0, 1], "force": 0.2}
DOWN = {"position": [0, 0, 0], "direction": [0, 0, -2], "force": 0.2}


def scenario(faults=None, chaser=None, **entries):
    return Scenario().replace(thrusters=entries, faults=faults or {}, chaser=chaser or {})


@pytest.mark.parametrize(("name", "count"), [("six", 6), ("12", 12), ("24", 24)])
def test_presets_share_the_force_limit_among_the_thrusters_of_a_direction(name, count):
    made = layout_of(scenario(layout=name))
    assert made.count == count
    np.testing.assert_allclose(np.maximum(made.pushes(), 0.0).sum(axis=0), 0.1)
    assert isinstance(Surroundings(scenario(layout=name)).thrusters, OnOffThrusters)


def test_a_layout_of_your_own():
    made = layout_of(scenario(layout="own", own=[*FLAT, UP, DOWN]))
    np.testing.assert_allclose(made.direction[5], [0.0, 0.0, -1.0])
    require_thrusters(scenario(layout="own", own=[*FLAT, UP, DOWN], chaser={"force_limit": 0.2}))
    assert errors_of(scenario(layout="own", own=[*FLAT, UP, DOWN])).force_error == pytest.approx(
        np.sqrt(3.0) * 0.2 * 0.01
    )


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"layout": "own", "own": FLAT}, ("4 directions do not span three axes", "singular value 0")),
        ({"layout": "own", "own": [*FLAT, UP]}, ("5 thrusters cannot push every way", "0 N")),
        ({"layout": "six", "force": 0.08}, ("chaser.force_limit: 0.1 N", "give 0.08 N")),
        ({"layout": "six", "survive_failure": True}, ("thruster 0 stuck off", "0 N", "more thrusters")),
        ({"layout": "12", "survive_failure": True}, ("stuck off", "give 0.05 N", "0.1 N", "2 times")),
        ({"layout": "24", "survive_failure": True}, ("give 0.075 N", "1.33 times")),
        ({"layout": "six", "rise_delay": 0.7}, ("rise_delay: 0.7 s", "half of the control period, 1 s")),
        ({"layout": "six", "faults": {"thruster": 6}}, ("faults.thruster: 6", "0 to 5")),
        ({"least_on_time": 0.01, "faults": {"thruster": 1}}, ("thrusters.least_on_time, faults.thruster", '"ideal"')),
    ],
)
def test_layouts_are_refused_with_numbers(entries, said):
    with pytest.raises(ScenarioError) as refusal:
        look(scenario(**entries))
    assert all(part in str(refusal.value) for part in said), refusal.value
    assert "\n" not in str(refusal.value)


def test_the_guard_assumes_a_fault_to_its_detection_and_the_audit_the_guards_excursion():
    covered = errors_of(scenario(layout="12", force=0.1, survive_failure=True, detection_time=4.2))
    assert (covered.fault_force, covered.fault_steps) == (pytest.approx(0.1), 5)
    width, told = errors_of(scenario(layout="six")), Surroundings(scenario(layout="six")).flight_bounds
    assert (told.excursion, told.velocity_excursion) == (width.excursion, width.velocity_excursion)
    # The figures of docs/motion.md: 0.1 N an axis, 20 kg, 1 s, 20 ms.
    assert (width.force_error, width.excursion) == pytest.approx((np.sqrt(3.0) * 1e-3, np.sqrt(3.0) * 0.1 / 640.0))

"""An approach in legs: flown once on a small box, and judged; and what is refused before a flight."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from truths.approaches import CORRIDOR, LEGS, SPHERE, SUN, TREE
from truths.boxes import LEARNED

import keepout
from keepout.core.audit.tube import Contact
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.legs import LegGuidance
from keepout.core.errors import KeepoutError
from keepout.core.mission import approach, zones
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.flights.on_board import OnBoard

_BOX = keepout.Target.load("box")


@pytest.fixture(scope="module")
def mission():
    return prepare(TREE)


@pytest.fixture(scope="module")
def flight(mission):
    return mission.fly()


@pytest.mark.long
def test_an_approach_holds_where_it_is_told_and_enters_nothing(flight):
    assert flight.start_certified
    assert flight.audit.contact is Contact.NO
    assert [(zone.name, zone.entered) for zone in flight.audit.zones] == [
        (name, Contact.NO) for name in ('zone "sphere"', 'zone "sun"', 'corridor "port"')
    ]
    far, near, capture = flight.legs
    assert far.kept
    assert near.kept
    assert capture.kept
    # Left when "go" is said, at the first step after; and once the dwell is over, which counts from nearer on.
    assert far.left == 131.0
    assert 40.0 <= near.held < 55.0
    assert near.largest_error < 0.3
    assert flight.outcome.reached
    summary = flight.summary()
    assert summary["speed_rule_excess_mps"] < 0.005
    assert [leg["name"] for leg in summary["legs"]] == ['leg "far"', 'leg "near"', 'leg "capture"']
    # Before the sphere falls, the chaser stays out of it, and then flies through where it was.
    away = np.linalg.norm(flight.record.position, axis=1)
    assert away[: far.left is not None and 131].min() > 12.5
    assert away[-1] < 12.0


@pytest.mark.slow  # zones of a mesh: core/geometry/test_hulls; the guard beside any field: core/guard/test_invariance
def test_a_law_that_flies_through_is_kept_out_of_a_zone(tmp_path):
    (tmp_path / "wall.obj").write_text(
        trimesh.creation.box(bounds=[[9.0, -9.0, -9.0], [11.0, 9.0, 9.0]]).export(file_type="obj")
    )
    wall = {"name": "wall", "shape": "mesh", "file": str(tmp_path / "wall.obj")}
    tree = {key: value for key, value in TREE.items() if key not in ("leg", "corridor", "approach")}
    tree |= {"zone": [wall], "goal": {"position": [-6.0, 0.0, 0.0]}, "faults": {"law": "through"}}
    tree |= {"control": {"guidance": "straight"}}
    flight = keepout.fly({**tree, "duration": 400.0})
    assert flight.start_certified
    assert flight.outcome.guard_interventions > 0
    assert [zone.entered for zone in flight.audit.zones] == [Contact.NO]
    # It was there: without the guard it would have gone on.
    assert flight.audit.zones[0].measured_clearance < 0.6


REFUSED = [
    ({"zone": [{**SPHERE, "until": None}]}, r'leg "near": .* 3\.94 m inside zone "sphere".* radius is 0\.5 m'),
    ({"zone": [{**SPHERE, "radius": 14.8}]}, r'leg "far": .* 0\.2 m from zone "sphere"'),
    ({"zone": [{**SPHERE, "radius": 19.8}]}, r'start\.position: .* 0\.2 m from zone "sphere"'),
    ({"corridor": [{**CORRIDOR, "port": [4.0, 0.0, 0.0]}]}, r'corridor "port": its port .* 2 m from the mesh'),
    ({"corridor": [{**CORRIDOR, "axis": [0.0, 1.0, 0.0]}]}, r'leg "near": .* beyond the wall of corridor "port"'),
    (
        {"approach": {"speed_by_distance": [[3.0, 0.1], [2.99, 0.01]]}, "leg": [LEGS[2]], "zone": []},
        r"speed_by_distance: .* let the speed fall over",
    ),
    ({"approach": {"speed_by_distance": [[3.0, 0.1], [4.0, 0.01]]}}, "distances must fall"),
    ({"leg": [LEGS[0], {**LEGS[2], "position": [2.55, 0.0, 0.0]}]}, r'leg "capture": .* inside the keep-out zone'),
    ({"leg": [LEGS[0], {**LEGS[2], "within": [700.0, 900.0]}]}, "begins at 700.0 s, and the flight ends at 640.0 s"),
    ({"leg": [{**LEGS[2], "until": "go"}]}, "go_at"),
    ({"leg": LEGS[1:], "zone": [SPHERE]}, 'zone.0.until: "go", and no leg has until = "go"'),
    ({"leg": [{**LEGS[1], "speed_limit": 3.0}, LEGS[2]], "zone": []}, r"leg\.0\.speed_limit: 3\.0 m/s is more than"),
    (
        {"leg": [{**LEGS[1], "axes": "vvlh"}], "attitude": {"kind": "inertial"}, "zone": []},
        "would move over the target",
    ),
    ({"zone": [{**SUN, "shape": "box"}]}, 'shape "box" is made of lower, upper, and has'),
    ({"goal": {"position": [5.0, 0.0, 0.0]}}, "leave goal out"),
    (
        {"leg": [{**LEGS[2], "drift_safe": True}], "zone": []},
        r"leg\.0\.drift_safe: .* approach\.abort_time; it is unset",
    ),
]


@pytest.mark.long
@pytest.mark.parametrize(("change", "said"), REFUSED)
def test_what_cannot_be_flown_is_refused_with_names_and_numbers(change, said):
    with pytest.raises(KeepoutError, match=said):
        prepare({**TREE, **change})


MOUTH = {**CORRIDOR, "radius": 0.4}
ROUGH = {**TREE, "field": {"source": str(LEARNED)}, "zone": [], "leg": [{**LEGS[2], "position": [2.75, 0.0, 0.0]}]}
"""A field that says far less than the distance, and a hold a quarter of a metre from where the chaser would touch."""


@pytest.mark.slow
@pytest.mark.long
def test_room_that_is_proved_clear_is_flown_where_the_field_says_less():
    with pytest.raises(KeepoutError, match=r'leg "capture": .* inside the keep-out zone'):
        prepare({**ROUGH, "corridor": [MOUTH]})
    start = {"position": [6.0, 0.3, 0.0]}
    flight = keepout.fly({**ROUGH, "corridor": [{**MOUTH, "clear_from": 0.51}], "start": start, "duration": 300.0})
    assert flight.start_certified
    assert flight.outcome.reached
    assert flight.outcome.guard_interventions == 0
    assert flight.audit.contact is Contact.NO
    assert [zone.entered for zone in flight.audit.zones] == [Contact.NO]
    assert np.linalg.norm(flight.record.position[-1] - [2.75, 0.0, 0.0]) < 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"clear_from": 0.49}, r"clear_from 0\.49 m, but the mesh is 0\.49\d* m from \[2\.49"),
        ({"clear_from": 0.6, "axis": [1.0, 1.0, 0.0]}, r"and it must be 0\.5 m and a few millimetres"),
        ({"clear_from": 10.0}, "must be less than length"),
    ],
)
def test_room_that_is_not_clear_is_refused_with_both_distances(change, said):
    with pytest.raises(KeepoutError, match=said):
        approach.require_approach(Surroundings(Scenario.of({**ROUGH, "corridor": [{**MOUTH, **change}]}), _BOX))


def test_a_leg_in_inertial_axes_is_where_it_is_as_the_flight_begins():
    orbit = {"semi_major_axis": 7e6, "inclination": 0.7, "true_anomaly": 1.0, "eccentricity": 0.05}
    given = [{"position": [3.0, -6.0, 2.0]}, {"position": [1.0, 8.0, 2.0], "axes": "inertial", "tolerance": 0.3}]
    scenario = Scenario.of({"leg": given, "attitude": {"kind": "inertial"}, "orbit": orbit})
    for flown in (scenario, scenario.replace(orbit={"inclination": 1.2})):
        last = approach.as_flown(flown)
        axes = zones._followed(Surroundings(flown).motion, "inertial", jnp.float64(1.0), 1)[0]
        np.testing.assert_allclose(axes @ np.array(last.leg[1].position), given[1]["position"], atol=1e-12)
        assert last.leg[0] == flown.leg[0]
        assert (last.goal.position, last.goal.tolerance) == (last.leg[1].position, 0.3)
        assert approach.as_flown(last) is last
    with pytest.raises(KeepoutError, match=r'leg\.1\.axes: "inertial", and attitude\.kind is "vvlh"'):
        Scenario.of({"leg": given, "orbit": orbit})


@pytest.mark.long
def test_the_way_of_a_single_leg_is_flown_with_another_speed_too(mission):
    """As campaigns take it that vary what the speed follows from, round zones and without legs."""
    way = mission.setup.controller.law.velocity.guidance.way
    made, place = LegGuidance.of([way], None), jnp.array([12.0, 0.5, 0.0])
    slower = approach.LegPlan(Scenario.of({"zone": [SUN]}), Geodesic(), None).again(made, 0.01, 1.0)
    np.testing.assert_allclose(jnp.linalg.norm(slower.desired_velocity(place)), 0.01, rtol=1e-3)
    wanted = made.desired_velocity(place)
    np.testing.assert_allclose(wanted, way.desired_velocity(place), atol=1e-12)
    np.testing.assert_allclose(jnp.linalg.norm(wanted), way.speed, rtol=1e-2)


def test_earliest_times_follow_from_what_is_said():
    scenario = Scenario.parse({"leg": [*LEGS[:2], {**LEGS[2], "within": [500.0, 640.0]}], "duration": 640.0})
    assert approach.earliest(scenario) == [0.0, 130.0, 500.0]
    assert approach.released(scenario) == [130.0, 500.0, 0.0]
    assert scenario.goal.position == (3.6, 0.0, 0.0)
    assert Scenario.parse(scenario.model_dump()) == scenario


@pytest.mark.long
def test_an_abandoned_mission_flies_back_to_the_hold_before(mission):
    scenario = mission.scenario.replace(faults={"abort_at": 340.0})
    setup = eqx.tree_at(lambda s: s.controller.abort_at, mission.setup, jnp.asarray(340.0))
    flight = replace(mission, surroundings=Surroundings(scenario, mission.target), setup=setup).fly()
    legs, position = flight.record.leg, flight.record.position
    assert (legs[339], legs[340]) == (2, 1)
    assert set(legs[340:]) == {1}
    assert np.linalg.norm(position[-1] - LEGS[1]["position"]) < 0.1
    assert [leg.name for leg in flight.legs] == ['leg "far"', 'leg "near"']
    assert flight.summary()["holds_kept"]
    assert flight.audit.zones_entered is Contact.NO
    assert np.asarray(approach.law_of_legs(scenario, mission.setup.controller.law).abort_at) == 340.0


def test_a_drift_breaks_what_the_guard_assumes():
    scenario = Scenario.parse({**TREE, "approach": {"abort": "drift"}, "faults": {"abort_at": 100.0}})
    assert any("nothing thrusts" in said for said in broken_assumptions(scenario))
    faults = Surroundings(scenario).faults
    state, force = faults.command(faults.initial_state(jax.random.key(0)), jnp.ones(3), jnp.asarray(99.0))
    np.testing.assert_array_equal(force, 1.0)
    state, force = faults.command(state, jnp.ones(3), jnp.asarray(100.0))
    np.testing.assert_array_equal(force, 0.0)
    with pytest.raises(KeepoutError, match="there are no legs"):
        approach.require_approach(Surroundings(Scenario.parse({"faults": {"abort_at": 100.0}})))


@pytest.mark.slow  # compiles the step on board three times; that a setup leads on is in tests/core/flight
def test_words_lead_on_on_board(mission):
    board = OnBoard(approach.by_word(mission.setup), mission.initial)
    go, abort = (board.ready(approach.by_word(mission.setup, go=True, abort=said)) for said in (False, True))
    setup, state = mission.setup, mission.initial
    moved = eqx.filter_jit(lambda now, force: setup.motion.step(now, force, setup.disturbance, 1.0, setup.mass))
    for step in range(700):
        if step in (300, 420):
            (go if step == 300 else abort)()
        force = board.step(float(state.time), state.position, state.velocity)
        state = moved(state, jnp.asarray(force))
        if step == 299:  # nobody said anything yet, whatever the time
            assert np.linalg.norm(state.position - np.array(LEGS[0]["position"])) < 0.1
    assert np.linalg.norm(state.position - np.array(LEGS[0]["position"])) < 0.1


def test_what_is_led_otherwise_refuses_legs_and_zones():
    approach.require_one_leg(Scenario(), "it is led otherwise")
    with pytest.raises(KeepoutError, match=r"leg, zone, corridor, approach\.speed_by_distance: .* led otherwise"):
        approach.require_one_leg(Scenario.parse(TREE), "it is led otherwise")


@pytest.mark.long
def test_drifts_from_a_flight_are_judged_leg_by_leg(flight):
    scenario = flight.scenario.replace(approach={"abort_time": 300.0}, disturbance={"kind": "none"})
    told = replace(flight, scenario=scenario).summary()["drifts"]
    assert [leg["name"] for leg in told] == ['leg "far"', 'leg "near"', 'leg "capture"']
    assert sum(leg["judged"] for leg in told) == 65
    far, _, capture = told
    # At rest 15 m away nothing comes near within five minutes; on the way in to the port 1.6 m away something does.
    assert far["proved_free"] > 0
    assert capture["proved_free"] < capture["judged"]
    assert all(leg["pushed_proved_free"] <= leg["proved_free"] for leg in told)


STOPPED = {"duration": 900.0, "zone": [], "corridor": [], "approach": {"abort_time": 300.0}}


@pytest.mark.slow
@pytest.mark.long
def test_a_leg_is_flown_so_slowly_that_a_drift_from_it_is_safe():
    """Straight towards a box at v, a drift of 300 s goes on for 300 v or so: there is room for that at 6 m."""
    legs = [{"name": "towards", "position": [6.0, 0.0, 0.0], "drift_safe": True}]
    tree = {**TREE, **STOPPED, "leg": legs, "start": {"position": [12.0, 0.0, 0.0]}}
    (leg,) = prepare(tree).scenario.leg
    assert not leg.drift_safe
    assert leg.speed_limit is not None
    assert 0.003 < leg.speed_limit < 4.0 / 300.0
    with pytest.raises(
        KeepoutError, match=r'leg "towards": drift_safe, but at no speed down to 0\.00313 m/s .* for 90000 s'
    ):
        prepare({**tree, "approach": {"abort_time": 9e4}})


@pytest.mark.slow  # two flights; drifts are proved in tests/apps/inspection/test_passive.py
def test_drifts_from_a_leg_that_was_slowed_are_safe_as_flown():
    legs = [LEGS[0], {**LEGS[1], "drift_safe": True}, LEGS[2]]
    before, after = (keepout.fly({**TREE, **STOPPED, "leg": each}).summary()["drifts"][1] for each in (LEGS, legs))
    assert before["proved_free"] < before["judged"]
    assert after["proved_free"] == after["judged"] > before["judged"]

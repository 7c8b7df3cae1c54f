"""Plumes against angles and dense samples, hold points against made-up records, and both together in one judgement."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog
from truths.invented_flight import Invented

from keepout.apps.inspection.limits import (
    Nozzles,
    Protected,
    SparingLaw,
    _on_times,
    holds,
    limits_kept,
    plume_violations,
    sparing,
)
from keepout.core.control.law import PolicyLaw
from keepout.core.flight.loop import fly
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.task_entries import HoldPointEntry

AXES = np.concatenate([-np.eye(3), np.eye(3)])
"""Of the plumes of a push along +x, +y, +z, −x, −y, −z."""


def protected(lower, upper, radius=0.0, half_angle=0.35, reach=30.0):
    return Protected(*(jnp.asarray(given, jnp.float64) for given in ([lower], [upper], [radius], half_angle, reach)))


def told(parts, position, moved=0.0):
    return np.asarray(REACHED(parts, jnp.asarray(position, jnp.float64), jnp.asarray(moved))).T.ravel()


REACHED = eqx.filter_jit(lambda parts, position, moved: parts.reached(position, moved))


number = st.floats(-12.0, 12.0)


@given(st.tuples(number, number, number), st.floats(0.0, 4.0), st.floats(0.05, 1.5), st.floats(1.0, 30.0))
def test_a_ball_is_reached_where_its_angle_from_the_axis_says_so(centre, radius, half_angle, reach):
    """In the plane through axis and centre: inside the cone, beside it, behind its apex, or past its end."""
    answer = told(protected(centre, centre, radius, half_angle, reach), np.zeros(3))
    away = np.linalg.norm(centre)
    for axis, reached in zip(AXES, answer, strict=True):
        angle = np.arccos(np.clip(axis @ centre / max(away, 1e-9), -1.0, 1.0)) if away > 0.0 else 0.0
        beside = max(angle - half_angle, 0.0)
        nearest = min(away * np.cos(beside), reach) if beside < np.pi / 2 else 0.0
        apart = np.hypot(away * np.cos(beside) - nearest, away * np.sin(beside)) if beside < np.pi / 2 else away
        if abs(apart - radius) > 1e-3:
            assert reached == (apart < radius)


@given(st.integers(0, 10_000))
def test_a_box_is_reached_where_one_of_many_points_of_it_is(seed):
    generator = np.random.default_rng(seed)
    lower = generator.uniform(-8.0, 8.0, 3)
    upper = lower + generator.uniform(0.0, 3.0, 3)
    half_angle, reach = generator.uniform(0.1, 1.5), generator.uniform(2.0, 12.0)
    answer = told(protected(lower, upper, 0.0, half_angle, reach), np.zeros(3))
    grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 25).T, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(grid, axis=1)
    for axis, reached in zip(AXES, answer, strict=True):
        inside = (grid @ axis >= away * np.cos(half_angle)) & (away <= reach)
        if inside.any():
            assert reached
        wide = (grid @ axis >= away * np.cos(min(half_angle + 0.15, np.pi / 2))) & (away <= reach + 0.5)
        if not wide.any() and away.min() > 0.5:
            assert not reached


def record(position, force):
    """A record of a chaser that does not move within a step."""
    columns = {"position": np.asarray(position, float), "force": np.asarray(force, float)}
    return Invented(Scenario(), {}, time=np.arange(float(len(position))), **columns).record


def test_only_a_push_whose_plume_reaches_the_part_is_a_violation():
    """The part is at the origin, the chaser 10 m along +x: pushing away (+x) blows at it, pushing nearer does not."""
    place = np.tile([10.0, 0.0, 0.0], (5, 1))
    force = [[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, -0.1], [0, 0, 0], [0.1, 0, 0]]
    parts = protected([-1, -1, -1], [1, 1, 1])
    assert plume_violations(record(place, force), parts, Scenario()).tolist() == [True, False, False, False]
    near = protected([-1, -1, -1], [1, 1, 1], reach=8.9)
    assert not plume_violations(record(place, force), near, Scenario()).any()


def test_a_law_that_spares_a_part_leaves_out_that_component_alone():
    case = Scenario.model_validate({"inspect": {"no_thrust_towards": [{"centre": [0, 0, 0], "radius": 1.0}]}})
    plain = PolicyLaw(jnp.zeros(3), lambda off, velocity, time: jnp.array([0.1, 0.05, -0.02]))
    law = sparing(plain, case)
    assert isinstance(law, SparingLaw)
    assert sparing(plain, Scenario()) is plain
    at = state([10.0, 0.0, 0.0])
    _, command = law.step(law.initial_state(at), at)
    assert np.allclose(command.force, [0.0, 0.05, -0.02])
    at = state([-10.0, 0.0, 0.0])
    assert np.allclose(law.step(law.initial_state(at), at)[1].force, [0.1, 0.05, -0.02])


def state(position):
    return Surroundings(Scenario()).motion.initial_state(np.array(position), np.zeros(3))


def stays(*spells):
    """A record with a sample a second: so many seconds at each place."""
    place = np.concatenate([np.tile(np.asarray(at, float), (seconds, 1)) for at, seconds in spells])
    return record(place, np.zeros_like(place))


FIRST = HoldPointEntry(position=(5.0, 0.0, 0.0), seconds=10.0)
SECOND = HoldPointEntry(position=(0.0, 5.0, 0.0), seconds=5.0)
AWAY = (9.0, 9.0, 9.0)


def test_points_are_kept_that_are_held_in_their_order_and_long_enough():
    flight = stays((AWAY, 3), (FIRST.position, 11), (AWAY, 4), (SECOND.position, 8))
    first, second = holds(flight, (FIRST, SECOND), 0.1)
    assert (first.begun, first.lasted, first.kept) == (3.0, 10.0, True)
    assert (second.begun, second.lasted, second.kept) == (18.0, 7.0, True)
    wrong = stays((SECOND.position, 8), (FIRST.position, 12))
    assert [hold.kept for hold in holds(wrong, (FIRST, SECOND), 0.1)] == [True, False]
    short = stays((FIRST.position, 10), (AWAY, 1), (FIRST.position, 4))
    (hold,) = holds(short, (FIRST,), 0.1)
    assert (hold.kept, hold.begun, hold.lasted) == (False, 0.0, 9.0)
    (hold,) = holds(stays((AWAY, 20)), (FIRST,), 0.1)
    assert not hold.kept


def norms(points):
    return np.linalg.norm(points, axis=-1)


@pytest.mark.long
def test_the_judgement_of_a_flight_names_what_was_asked_for_and_no_more():
    flight = stays((FIRST.position, 20))
    flight.attitude[:, 0] = 1.0

    def judged(case, distance):
        return limits_kept(Scenario.model_validate(case), flight, distance, every=10)

    assert judged({}, norms).summary() == {"limits_kept": True}
    hold, part = {"position": FIRST.position, "seconds": 10.0}, {"lower": [-1, -1, -1], "upper": [1, 1, 1]}
    asked = {"inspect": {"hold_points": [hold], "no_thrust_towards": [part], "passive_safety": 60.0}}
    found = judged(asked, norms).summary()
    assert (found["limits_kept"], found["holds"], found["holds_kept"], found["plume_steps"]) == (True, 1, 1, 0)
    assert found["passive_safe_share"] == 1.0
    assert found["passive_pushed_spread_m"] > found["passive_spread_m"] == 0.0
    assert not judged(asked, lambda points: np.zeros(len(points))).kept


# ---- plumes of a layout's thrusters: where body axes would say the opposite, and which fired, against what was flown

CORNERS = [
    {"position": [0.0, 0.0, 0.0], "direction": list(d), "force": 0.2} for d in itertools.product((1, -1), repeat=3)
]
"""Eight thrusters that push towards the corners of a cube: 54.7° off each axis."""
APART = np.array([8.0, 0.0, 0.0])


def fired_by(own=CORNERS, **entries):
    chosen = {"layout": "own", "own": own, "least_on_time": 0.0} if own else {}
    return Scenario.parse({"thrusters": chosen, "disturbance": {"kind": "none"}, **entries})


def asked(centre, own=CORNERS, radius=0.3, **inspect):
    part = {"centre": list(centre), "radius": radius}
    return fired_by(own, inspect={"no_thrust_towards": [part], "plume_half_angle": 0.3, **inspect})


def pushing(case, force):
    """Judge one step at `APART` in which a force was commanded and given."""
    place, given = np.tile(APART, (2, 1)), np.tile(force, (2, 1))
    columns = {"position": place, "force": given, "guarded_force": given}
    record = Invented(case, {}, time=np.arange(2.0), **columns).record
    return bool(plume_violations(record, Protected.of(case), case)[0])


ALONG, ASIDE = np.zeros(3), APART - 5.0 * np.array([1.0, 1.0, 1.0])
"""Parts behind a push along +x, and behind the thruster that pushes along (1, 1, 1)."""


@pytest.mark.parametrize(
    ("part", "force", "by_axes"), [(ALONG, (0.05, 0, 0), True), (ASIDE, (0.05, 0.05, 0.05), False)]
)
def test_a_layout_blows_where_its_thrusters_point_and_not_along_the_axes(part, force, by_axes):
    assert pushing(asked(part, own=None), force) is by_axes
    assert pushing(asked(part), force) is not by_axes
    assert not pushing(asked(part), np.zeros(3))


def test_the_apex_is_where_the_thruster_is():
    """Those along x sit 3 m to the side: their plume passes a part that one from the centre hits."""
    aside = [[0.0, 3.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    moved = [
        {"position": place, "direction": (sign * axis).tolist(), "force": 0.2}
        for place, axis in zip(aside, np.eye(3))
        for sign in (1, -1)
    ]
    force = np.array([0.05, 0.0, 0.0])
    for part, by_centre in ((ALONG, True), ([0.0, 3.0, 0.0], False)):
        assert pushing(asked(part, own=None), force) is by_centre
        assert pushing(asked(part, own=moved), force) is not by_centre


PUSHES = 0.2 * np.array([thruster["direction"] for thruster in CORNERS]) / np.sqrt(3.0)


def least_propellant(force, most=(1.0,) * 8):
    """Which thrusters fire for a force, by linear program."""
    bounds = [(0.0, share) for share in most]
    return linprog(np.ones(8), A_eq=PUSHES.T, b_eq=force, bounds=bounds, method="highs")


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_what_a_sparing_law_asks_for_fires_no_thruster_that_is_barred(seed):
    generator = np.random.default_rng(seed)
    barred = generator.uniform(size=8) < 0.4
    force = generator.uniform(-0.06, 0.06, 3)
    nozzles = Nozzles.of(fired_by())
    left = np.asarray(eqx.filter_jit(Nozzles.without)(nozzles, jnp.asarray(force), jnp.asarray(barred)))
    found = least_propellant(left)
    assert found.status == 0
    assert np.all(np.asarray(nozzles.gives(jnp.asarray(left)))[barred] < 1e-6)
    free = least_propellant(left, most=np.where(barred, 0.0, 1.0))
    assert free.status == 0
    assert free.fun == pytest.approx(found.fun, abs=1e-6)
    none = nozzles.without(jnp.asarray(force), jnp.zeros(8, bool))
    assert np.allclose(none, force)


@pytest.mark.long
def test_thrusters_that_fired_are_those_of_the_flight_with_its_delay_and_lost_commands():
    """Their pushes times their on-times are the mean forces that the flight recorded."""
    case = fired_by(faults={"delay": 2, "dropped": 0.2}, guard={"enabled": False}, seed=5)
    law = PolicyLaw(jnp.zeros(3), lambda off, velocity, time: 0.04 * jnp.sin(jnp.array([0.3, 0.7, 1.1]) * time))
    around = Surroundings(case)
    log = fly(around.setup(law), around.motion.initial_state(APART, np.zeros(3)), 60, jax.random.key(5))
    record = FlightRecord.of_log(log, scenario=case.model_dump_json(), seed=5)
    flown = jnp.asarray(record.guarded_force), jnp.asarray(record.time)
    on_time = np.asarray(_on_times(Surroundings(case).faults, Surroundings(case).thrusters, *flown, jax.random.key(5)))
    assert np.allclose(on_time @ PUSHES / case.control.period, record.force, atol=1e-12)
    fired = Nozzles.of(case).fired(record, case)
    assert np.array_equal(fired, on_time[:-1] > 0.0)
    assert 0 < fired.sum() < fired.size
    assert not np.allclose(record.force, record.guarded_force)

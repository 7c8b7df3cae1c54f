"""Law and guard by a map: what was certified stays certified, and a chaser flies through updates without a touch."""

import math
from functools import cache
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.boxes import HALF
from truths.depth_views import Box, axes_towards, cube_centres, view_of
from truths.growing_maps import Cubes
from truths.guarded_worlds import motion_state

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.by_map import SLOPE, ByMap, DeclaredBall, MapField, field_of, guard_by_map, require_start
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import FieldError, KeepoutError
from keepout.core.fields.field import values
from keepout.core.flight.loop import begin, fly_segment, joined
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.guard.guard import Guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.arrays import numbers_as_arrays

pytestmark = pytest.mark.long

# --- Certified once, certified for ever -------------------------------------------------------------------------------

SMALL = Cubes((0.0, 0.0, 0.0), 0.8)
AGILE = GuardAssumptions(
    mass=20.0,
    force_limit=0.4,
    period=1.0,
    disturbance_force=0.01,
    angular_rate=0.0,
    angular_acceleration=0.0,
    gravity_gradient=3e-6,
    range_limit=40.0,
    speed_limit=0.2,
)
RADIUS = 0.2
GENERATOR = np.random.default_rng(5)
PLANS = jax.vmap(motion_state)(
    jnp.asarray(GENERATOR.uniform(-1.6, 1.6, (200, 3))), jnp.asarray(GENERATOR.uniform(-0.08, 0.08, (200, 3)))
)
PROBES = GENERATOR.uniform(-2.5, 2.5, (3000, 3))


def small_guard(field):
    return Guard(
        field=field,
        threshold=RADIUS + field.error_bound(RADIUS),
        lipschitz=SLOPE,
        evaluation_error=field.evaluation_error,
        assumptions=AGILE,
    )


@eqx.filter_jit
def certified(guard, plans):
    """The guard's own certification of the braking motion from each state."""
    return jax.vmap(guard.certified)(plans)


def broken_promises(maps):
    """Count the values that fall and the plans that lose their certificate from each map to the next."""
    fallen = lost = 0
    before = before_plans = None
    for solid in maps:
        field = SMALL.field(solid)
        now, plans = values(field, PROBES), np.asarray(certified(small_guard(field), PLANS))
        if before is not None:
            fallen += int((now < before).sum())
            lost += int((before_plans & ~plans).sum())
        before, before_plans = now, plans
    return fallen, lost


def pieces(seed, count=5):
    """Free room in pieces: balls and boxes of cubes, in any order."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        at, size = generator.uniform(-1.2, 1.2, 3), generator.uniform(0.1, 1.3, 3)
        away = np.abs(SMALL.centres - at) / size
        yield (away.max(axis=-1) < 1.0) if generator.uniform() < 0.5 else (np.sum(away**2, axis=-1) < 1.0)


@settings(max_examples=settings().max_examples // 2)  # each proves the plans of six maps
@given(seed=st.integers(0, 2**32 - 1), order=st.permutations(range(5)))
def test_nothing_falls_and_every_plan_stays_certified_while_free_room_grows(seed, order):
    opened, solid = list(pieces(seed)), SMALL.solid
    maps = [solid]
    for number in order:
        solid = solid & ~opened[number]
        maps.append(solid)
    assert broken_promises(maps) == (0, 0)
    # Whatever the order, the same map.
    np.testing.assert_array_equal(SMALL.squares(maps[-1]), SMALL.squares(SMALL.solid & ~np.any(opened, axis=0)))


def test_the_same_check_reports_free_room_that_shrinks():
    opened = list(pieces(6))
    grown = SMALL.solid & ~np.any(opened, axis=0)
    fallen, lost = broken_promises([grown, grown | (opened[0] & SMALL.solid)])
    assert fallen > 0
    assert lost > 0


# --- A flight through updates -----------------------------------------------------------------------------------------

BALL = DeclaredBall((0.0, 0.0, 0.0), 3.0)
SCENARIO = Scenario.parse(
    {
        "name": "unknown",
        "target": {"source": "box"},
        "guard": {"position_error": 0.05, "velocity_error": 0.002},
        "faults": {"position_noise": 0.05, "velocity_noise": 0.002},
        "start": {"position": [0.0, 6.0, 0.0]},
        "safety": {"margin": 0.05},
    }
)
START = np.asarray(SCENARIO.start.position)
LENGTH = 20
BODY = Box(tuple(-HALF), tuple(HALF))
SENSOR = SensorBounds()


def begun():
    return KnownFreeMap.begin(BALL.centre, BALL.radius, bounds=SENSOR, name="box")


def opened(free=None):
    """The field of a map of which the cubes have been freed whose centres (..., 3) are `free`."""
    known = begun()
    if free is not None:
        known.fill(known.free | free(cube_centres(known)))
    return field_of(known)


@cache
def led_by_first_map():
    return ByMap.of(SCENARIO, BALL, opened())


def flown(setup, state):
    """Fly a segment; all are as long, and their numbers arrays, for their programs to be few."""
    return fly_segment(numbers_as_arrays(setup), state, LENGTH)


def law_at(field, goal, position=START):
    return led_by_first_map().by(field).law(np.array(goal), np.array(position))


@eqx.filter_jit
def planned(guard, plan):
    return guard.certified(plan)


LEGS = [(3.5, 3.5, 2.6), (0.0, 0.0, 5.0), (0.0, 0.0, 2.1)]


@pytest.fixture(scope="module")
def flight():
    """It sees with errors at their bounds, maps, and flies by what it saw, to a goal within the ball.

    Each leg takes the field of now and a law for it, and notes of the guard's plan whether it was and is certified.
    """
    camera, generator = Pinhole(160, 120, math.radians(60.0)), np.random.default_rng(0)
    known, logs, plans = begun(), [], []
    leading = led_by_first_map()
    setup = leading.setup(leading.law(np.array(LEGS[0]), np.array(START)))
    state = begin(setup, leading.initial, jax.random.key(0))

    def look(position, at):
        move = generator.normal(size=3)
        view = view_of(
            (BODY,),
            camera,
            SENSOR,
            position,
            axes_towards(np.asarray(at) - position),
            range_error=SENSOR.range_error,
            move=SENSOR.position_error * move / np.linalg.norm(move),
            turn=SENSOR.attitude_error,
            about=generator.normal(size=3),
        )
        assert known.see(view).status is ViewStatus.SEEN

    for goal in LEGS:
        for _ in range(12):
            position = np.asarray(state.motion.position)
            if np.linalg.norm(position - goal) < 0.2:
                break
            for at in (-1.5, 0.0, 1.5):
                look(position, (at, 0.0, 0.0))
            leading = leading.by(field_of(known))
            setup = leading.led_on(setup, leading.law(np.array(goal), position))
            plan = motion_state(state.guard.plan_position, state.guard.plan_velocity)
            plans.append((bool(state.guard.certified), bool(planned(setup.guard, plan))))
            state, log = flown(setup, state)
            logs.append(log)
    log = joined(logs)
    record = SimpleNamespace(**{name: np.asarray(rows) for name, rows in vars(log).items() if rows is not None})
    return SimpleNamespace(record=record, plans=plans)


@pytest.mark.slow
def test_a_map_that_is_no_later_one_is_refused():
    later = opened(lambda p: p[..., 1] >= 2.0)
    after = led_by_first_map().by(later)
    assert after.by(later).guard.field.squares is later.squares
    known = begun()
    for field, said in (
        (opened(), r"\d+ nodes are nearer"),
        (MapField.of(known.squares, known.origin + 0.1, known.spacing), "origin"),
        (MapField.of(known.squares[:-1], known.origin, known.spacing), "nodes come after"),
    ):
        with pytest.raises(FieldError, match=said):
            after.by(field)


def test_a_position_beyond_the_guidances_grid_is_led_back():
    law = law_at(opened(), (0.0, 5.0, 0.0), (0.0, 60.0, 0.0))
    away = law.velocity.guidance.direction(jnp.array([0.0, 60.0, 0.0]))
    np.testing.assert_allclose(away, [0.0, -1.0, 0.0], atol=1e-6)


# --- Numbers and refusals ---------------------------------------------------------------------------------------------


def test_the_guards_numbers_are_those_of_the_theorem():
    guard = led_by_first_map().guard
    assert guard.threshold == pytest.approx(np.hypot(SCENARIO.chaser.radius, 0.1), abs=1e-12)
    assert guard.lipschitz == 1.14
    assert guard.evaluation_error == opened().evaluation_error > 0.0
    far = guard_by_map(SCENARIO, opened(), DeclaredBall((9.0, 0.0, 0.0), 3.0))
    assert far.assumptions.range_limit == pytest.approx(2.0 * 12.0 + 20.0)


def with_errors(position, velocity, **more):
    return SCENARIO.replace(
        guard={"position_error": position, "velocity_error": velocity},
        faults={"position_noise": position, "velocity_noise": velocity},
        **more,
    )


def started(height, speed, guard):
    initial = Surroundings(SCENARIO).motion.initial_state(np.array([0, height, 0]), np.array([0, speed, 0]))
    require_start(SCENARIO, BALL, initial, guard)


def test_what_nothing_can_be_flown_by_is_refused():
    # A room that is free and that nothing leads to.
    pocket = opened(lambda p: np.linalg.norm(p - [0.0, 0.0, 1.8], axis=-1) <= 1.1)
    # Errors so large that nothing is ever far enough away, and such that only the law has none left.
    blind, wide = with_errors(0.2, 0.01, chaser={"speed_limit": 0.05}), SCENARIO.replace(safety={"margin": 0.6})
    guard, of_wide = led_by_first_map().guard, ByMap.of(wide, BALL, opened())
    for refused, said in (
        (lambda: law_at(opened(), (0.0, 0.0, 2.0)), r"goal: .* inside the keep-out zone"),
        (lambda: law_at(pocket, (0.0, 0.0, 1.8)), "not connected to the goal"),
        (lambda: guard_by_map(blind, opened(), BALL), r"map cap: 1.2 m, and the guard certifies .* above 1\.[2-9]"),
        (lambda: of_wide.law(np.array(LEGS[1]), np.array(START)), r"map cap: 1.2 m, and the law leads .* above 1\.2"),
        (lambda: started(3.4, 0.0, guard), "more than 3.500 m"),
        (lambda: started(0.0, 0.0, guard), "more than 3.500 m"),
        (lambda: started(3.6, -0.1, guard), "start slower"),
    ):
        with pytest.raises(KeepoutError, match=said):
            refused()
    started(3.6, -0.1, None)  # without a guard nothing is certified; the ball still counts

"""Law and guard by a map: what was certified stays certified, and a chaser flies through updates without a touch."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.boxes import HALF, box_distance
from truths.growing_maps import Cubes
from truths.guarded_worlds import motion_state

from keepout.audit.audit import Contact, audit
from keepout.errors import ControlError, FieldError, ScenarioError
from keepout.fields.evaluate import values
from keepout.fields.map_field import SLOPE, MapField
from keepout.flight import loop
from keepout.flight.segment import begin, fly_segment, joined
from keepout.geometry.target import Target
from keepout.guard.braking import GuardAssumptions
from keepout.guard.guard import Guard
from keepout.guard.safety_layer import mode
from keepout.guard.status import GuardStatus
from keepout.mapping.known_free import KnownFreeMap
from keepout.mapping.view import SensorBounds
from keepout.mission import environment
from keepout.mission.by_map import (
    DeclaredBall,
    guard_by_map,
    kept_by_law,
    law_by_map,
    led_on,
    require_start,
    setup_by_map,
)
from keepout.mission.scenario import Scenario

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


@settings(max_examples=40)
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
    fallen = lost = 0
    for seed in range(6, 10):
        opened = list(pieces(seed))
        grown = SMALL.solid & ~np.any(opened, axis=0)
        shrunk = grown | (opened[0] & SMALL.solid)
        more = broken_promises([grown, shrunk])
        fallen, lost = fallen + more[0], lost + more[1]
    assert fallen > 100
    assert lost > 5


def test_a_finer_spacing_lowers_the_field():
    """Why there is one level: of the same free room a spline of twice the spacing says more in places."""
    solid = np.zeros_like(SMALL.solid)
    solid[22:24, 22:24, 22:24] = True
    every_second = np.pad(SMALL.squares(solid)[::2, ::2, ::2], 3, constant_values=SMALL.cells**2)
    coarse = MapField.of(every_second, SMALL.origin - 6.0 * SMALL.spacing, 2.0 * SMALL.spacing)
    # Squares count cells of the map's edge, and the coarse field takes them for cells of its own.
    assert (0.5 * values(coarse, PROBES) - values(SMALL.field(solid), PROBES)).max() > 0.03


# --- A flight through updates -----------------------------------------------------------------------------------------

BALL = DeclaredBall((0.0, 0.0, 0.0), 3.0)
SCENARIO = Scenario.parse(
    {
        "name": "unknown",
        "target": {"source": "box"},
        "guard": {"position_error": 0.05, "velocity_error": 0.002},
        "faults": {"position_noise": 0.05, "velocity_noise": 0.002},
        "start": {"position": [0.0, 7.0, 0.0]},
        "goal": {"position": [0.0, 0.0, 2.0]},
    }
)
CUBES = Cubes(BALL.centre, BALL.radius)
BODY = box_distance(CUBES.centres.reshape(-1, 3)).reshape(CUBES.solid.shape) < 0.2
START = np.asarray(SCENARIO.start.position)
LEGS = (
    ((0.0, 5.6, 0.0), lambda p: np.zeros(p.shape[:-1], bool)),
    ((0.0, 3.4, 0.0), lambda p: p[..., 1] > 1.8),
    ((0.3, 1.5, 2.3), lambda p: p[..., 2] > 1.3),
    ((0.0, 0.0, 2.05), lambda p: p[..., 2] > 0.8),
    ((-3.2, 0.0, 0.3), lambda p: np.ones(p.shape[:-1], bool)),
)
LENGTH, MOST = 40, 12


def law_at(field, goal, position, guard, **chosen):
    return law_by_map(SCENARIO, field, goal, position, ball=BALL, guard=guard, **chosen)


def begun():
    field = CUBES.field()
    guard = guard_by_map(SCENARIO, field, BALL)
    setup = setup_by_map(SCENARIO, field, BALL, law_at(field, LEGS[0][0], START, guard), guard)
    initial = setup.motion.initial_state(START, np.zeros(3))
    require_start(SCENARIO, BALL, initial, guard)
    return setup, initial


@pytest.fixture(scope="module")
def flight():
    setup, initial = begun()
    state, solid, logs, plans, reached = begin(setup, initial, jax.random.key(1)), CUBES.solid, [], [], []
    for goal, opened in LEGS:
        solid = solid & ~(opened(CUBES.centres) & ~BODY)
        field = CUBES.field(solid)
        law = law_at(field, goal, np.asarray(state.motion.position), setup.guard)
        setup = led_on(setup, field, law)
        plan = motion_state(state.guard.plan_position, state.guard.plan_velocity)
        plans.append((bool(state.guard.certified), bool(setup.guard.certified(plan))))
        for _ in range(MOST):
            state, log = fly_segment(setup, state, LENGTH)
            logs.append(log)
            if np.linalg.norm(np.asarray(state.motion.position) - goal) < 0.15:
                break
        reached.append(float(np.linalg.norm(np.asarray(state.motion.position) - goal)))
    logs.append(fly_segment(setup, state, 1)[1])
    return SimpleNamespace(log=joined(logs), plans=plans, reached=reached)


def test_every_goal_is_reached_and_the_last_ones_are_within_the_ball(flight):
    assert max(flight.reached) < 0.15
    assert np.linalg.norm(LEGS[3][0]) < BALL.radius - SCENARIO.chaser.radius


def test_the_guard_is_certified_throughout(flight):
    done = np.asarray(mode(flight.log.guard_status))
    assert not (done == GuardStatus.ESCAPING).any()
    assert int(np.bitwise_or.reduce(np.asarray(flight.log.guard_status) - done)) == 0
    assert all(before and after for before, after in flight.plans)
    assert np.isfinite(np.asarray(flight.log.force)).all()


def test_the_law_is_not_held_by_its_guard(flight):
    interventions = np.asarray(mode(flight.log.guard_status)) != 0
    assert interventions.mean() < 0.02


def test_the_audit_on_the_exact_mesh_finds_no_contact(flight):
    record = SimpleNamespace(
        **{name: np.asarray(value) for name, value in vars(flight.log).items() if value is not None}
    )
    target = Target.load("box")
    np.testing.assert_allclose(np.abs(target.vertices).max(axis=0), HALF)
    verdict = audit(
        record,
        target,
        chaser_radius=SCENARIO.chaser.radius,
        bounds=environment.flight_bounds(SCENARIO),
        force_limit=SCENARIO.chaser.force_limit,
        speed_limit=SCENARIO.chaser.speed_limit,
    )
    assert verdict.contact is Contact.NO
    assert verdict.consistent
    # It came near: a sphere of the chaser's radius has some decimetres left.
    assert 0.2 < verdict.minimum_clearance < 0.6


def test_the_disturbance_estimate_does_not_jump_where_goal_and_map_change(flight):
    estimate = np.asarray(flight.log.disturbance_estimate)
    steps = np.linalg.norm(np.diff(estimate, axis=0), axis=1)
    joints = np.arange(LENGTH, len(steps), LENGTH) - 1
    assert steps[joints].max() <= 1.5 * np.quantile(steps, 0.999)


def test_segments_of_a_map_flight_are_one_flight_to_the_bit():
    setup, initial = begun()
    key = jax.random.key(3)
    whole = loop.fly(setup, initial, 60, key)
    state, logs = begin(setup, initial, key), []
    for steps in (LENGTH, 20, 1):
        state, log = fly_segment(setup, state, steps)
        logs.append(log)
    rows = joined(logs)
    for field in dataclasses.fields(whole):
        one, other = getattr(whole, field.name), getattr(rows, field.name)
        if one is not None:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


def test_one_program_flies_every_map_and_goal():
    setup, initial = begun()
    state, compiled = begin(setup, initial, jax.random.key(2)), []
    state, _ = fly_segment(setup, state, LENGTH)
    field = CUBES.field(CUBES.solid & ~(LEGS[1][1](CUBES.centres) & ~BODY))
    after = led_on(setup, field, law_at(field, LEGS[1][0], np.asarray(state.motion.position), setup.guard))

    def listen(event, _, **__):
        compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        fly_segment(after, state, LENGTH)
        assert compiled == []
        fly_segment(after, state, 2, longest=16 * LENGTH)  # another room is another program
        assert compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_a_known_free_map_has_such_a_field():
    bounds = SensorBounds(
        range_error=0.03,
        position_error=0.05,
        attitude_error=0.005,
        surely_returned_width=0.05,
        rays_across=3,
        sure_empty_range=15.0,
        least_range=0.3,
        greatest_range=15.0,
    )
    known = KnownFreeMap.begin(BALL.centre, BALL.radius, bounds=bounds, name="box")
    field = MapField.of(known.squares, known.origin, known.spacing)
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (2000, 3))
    assert field.cap == pytest.approx(known.cap)
    away = np.linalg.norm(points - np.array(BALL.centre), axis=1) - BALL.radius
    assert np.all(values(field, points) <= np.hypot(np.maximum(away, 0.0), known.spacing) + 1e-12)
    assert np.all(values(field, points)[away > known.cap + 0.5] > known.cap - 1e-9)


def test_a_map_that_is_no_later_one_is_refused():
    setup, _ = begun()
    opened = CUBES.field(CUBES.solid & (CUBES.centres[..., 1] < 2.0))
    law = law_at(opened, (0.0, 5.0, 0.0), START, setup.guard)
    after = led_on(setup, opened, law)
    led_on(after, opened, law)
    with pytest.raises(FieldError, match=r"\d+ nodes are nearer"):
        led_on(after, CUBES.field(), law)
    shifted = MapField.of(CUBES.squares(), CUBES.origin + 0.1, CUBES.spacing)
    with pytest.raises(FieldError, match="origin"):
        led_on(after, shifted, law)
    with pytest.raises(FieldError, match="nodes come after"):
        led_on(after, MapField.of(CUBES.squares()[:-1], CUBES.origin, CUBES.spacing), law)


def test_a_position_beyond_the_guidances_grid_is_led_back():
    setup, _ = begun()
    law = law_at(CUBES.field(), (0.0, 5.0, 0.0), (0.0, 60.0, 0.0), setup.guard)
    away = law.velocity.guidance.direction(jnp.array([0.0, 60.0, 0.0]))
    np.testing.assert_allclose(away, [0.0, -1.0, 0.0], atol=1e-6)


# --- Numbers and refusals ---------------------------------------------------------------------------------------------


def test_the_guards_numbers_are_those_of_the_theorem():
    field = CUBES.field()
    guard = guard_by_map(SCENARIO, field, BALL)
    radius = SCENARIO.chaser.radius
    assert guard.threshold == pytest.approx(np.hypot(radius, 0.1), abs=1e-12)
    assert guard.lipschitz == 1.14
    assert guard.evaluation_error == field.evaluation_error > 0.0
    # Twice the furthest of ball, start and goal and 20 m, as with a mesh that reaches as far.
    assert guard.assumptions.range_limit == pytest.approx(2.0 * 7.0 + 20.0)
    far = guard_by_map(SCENARIO, field, DeclaredBall((9.0, 0.0, 0.0), 3.0))
    assert far.assumptions.range_limit == pytest.approx(2.0 * 12.0 + 20.0)


def with_errors(position, velocity, **more):
    return Scenario.parse(
        {
            "guard": {"position_error": position, "velocity_error": velocity},
            "faults": {"position_noise": position, "velocity_noise": velocity},
            "start": {"position": [0.0, 7.0, 0.0]},
            **more,
        }
    )


@pytest.mark.parametrize(
    ("position", "velocity", "keeps_margin"), [(0.0, 0.0, False), (0.1, 0.004, False), (0.0, 0.0, True)]
)
def test_the_guard_passes_on_what_the_law_does_at_its_own_edge(position, velocity, keeps_margin):
    scenario = with_errors(position, velocity).replace(guard={"keeps_margin": keeps_margin})
    solid = CUBES.solid & (CUBES.centres[..., 1] < 1.0)
    field = CUBES.field(solid)
    guard = guard_by_map(scenario, field, BALL)
    offset = kept_by_law(scenario, field, guard)
    assert offset > guard.least_value
    goal = np.array([0.0, 1.0 + offset + 0.02, 0.0])
    law = law_by_map(scenario, field, goal, START, ball=BALL, guard=guard)
    setup = setup_by_map(scenario, field, BALL, law, guard)
    state = begin(setup, setup.motion.initial_state(START, np.zeros(3)), jax.random.key(0))
    _, log = fly_segment(setup, state, 300)
    assert np.linalg.norm(np.asarray(log.position[-1]) - goal) < 0.1
    assert not np.asarray(mode(log.guard_status)).any()


def test_a_cap_that_leaves_no_room_is_refused():
    # Errors so large that nothing is ever far enough away, and such that only the law has none left.
    with pytest.raises(ScenarioError, match=r"map cap: 1.2 m, and the guard certifies plans only .* above 1\.[2-9]"):
        guard_by_map(with_errors(0.2, 0.01, chaser={"speed_limit": 0.05}), CUBES.field(), BALL)
    wide = with_errors(0.05, 0.002, safety={"margin": 0.6})
    guard = guard_by_map(wide, CUBES.field(), BALL)
    with pytest.raises(ScenarioError, match=r"map cap: 1.2 m, and the law leads only .* above 1\.2"):
        law_by_map(wide, CUBES.field(), (0.0, 5.0, 0.0), START, ball=BALL, guard=guard)


def test_a_start_within_the_ball_or_too_fast_is_refused():
    setup, _ = begun()
    guard = setup.guard
    for position, velocity, said in (
        ((0.0, 3.4, 0.0), (0.0, 0.0, 0.0), "more than 3.500 m"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "more than 3.500 m"),
        ((0.0, 3.6, 0.0), (0.0, -0.1, 0.0), "start slower"),
    ):
        start = setup.motion.initial_state(np.asarray(position), np.asarray(velocity))
        with pytest.raises(ScenarioError, match=said):
            require_start(SCENARIO, BALL, start, guard)
    # Without a guard nothing is certified; the ball still counts.
    require_start(
        SCENARIO, BALL, setup.motion.initial_state(np.array([0.0, 3.6, 0.0]), np.array([0.0, -0.1, 0.0])), None
    )


def test_a_goal_in_what_is_not_known_free_is_refused():
    setup, _ = begun()
    with pytest.raises(ControlError, match=r"goal: .* inside the keep-out zone"):
        law_at(CUBES.field(), (0.0, 0.0, 2.0), START, setup.guard)
    # A room that is free and that nothing leads to.
    pocket = CUBES.solid & (np.linalg.norm(CUBES.centres - [0.0, 0.0, 1.8], axis=-1) > 1.1)
    with pytest.raises(ControlError, match="not connected to the goal"):
        law_at(CUBES.field(pocket), (0.0, 0.0, 1.8), START, setup.guard)
    paper = SCENARIO.model_copy(update={"control": SCENARIO.control.model_copy(update={"profile": "paper"})})
    with pytest.raises(ScenarioError, match="paper"):
        law_by_map(paper, CUBES.field(), (0.0, 5.0, 0.0), START, ball=BALL)

"""Plumes against angles and dense samples, hold points against made-up records, and both together in one judgement."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.invented_flight import Invented

from keepout.control.policy import PolicyLaw
from keepout.inspecting.limits import holds, limits_kept
from keepout.inspecting.plume import Protected, SparingLaw, plume_violations, sparing
from keepout.mission.inspection_entries import HoldPointEntry
from keepout.mission.scenario import Scenario

AXES = np.concatenate([-np.eye(3), np.eye(3)])
"""Of the plumes of a push along +x, +y, +z, −x, −y, −z."""


def protected(lower, upper, radius=0.0, half_angle=0.35, reach=30.0):
    return Protected(*(jnp.asarray(given, jnp.float64) for given in ([lower], [upper], [radius], half_angle, reach)))


def told(parts, position, moved=0.0):
    return np.asarray(REACHED(parts, jnp.asarray(position, jnp.float64), jnp.asarray(moved))).T.ravel()


REACHED = eqx.filter_jit(lambda parts, position, moved: parts.reached(position, moved))


number = st.floats(-12.0, 12.0)


@settings(max_examples=60, deadline=None)
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


@settings(max_examples=40, deadline=None)
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


def test_a_part_that_grows_and_a_chaser_that_moves_are_the_same():
    place = np.array([6.0, 3.0, 0.0])
    for size in (0.0, 0.5, 1.0, 1.5, 2.0, 3.0):
        parts = protected([0, 0, 0], [0, 0, 0], size)
        assert np.array_equal(told(parts, place), told(protected([0, 0, 0], [0, 0, 0], 0.0), place, size))


def record(position, force, period=1.0):
    """A record of a chaser that does not move within a step."""
    rows = len(position)
    columns = {"position": np.asarray(position, float), "force": np.asarray(force, float)}
    return Invented(Scenario(), {}, time=period * np.arange(rows), **columns).record


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
    from keepout.mission.environment import relative_motion

    return relative_motion(Scenario()).initial_state(np.array(position), np.zeros(3))


def stays(*spells):
    """A record with a sample a second: so many seconds at each place."""
    place = np.concatenate([np.tile(np.asarray(at, float), (seconds, 1)) for at, seconds in spells])
    return record(place, np.zeros_like(place))


FIRST = HoldPointEntry(position=(5.0, 0.0, 0.0), seconds=10.0)
SECOND = HoldPointEntry(position=(0.0, 5.0, 0.0), seconds=5.0)
AWAY = (9.0, 9.0, 9.0)


def test_points_held_in_their_order_are_kept():
    flight = stays((AWAY, 3), (FIRST.position, 11), (AWAY, 4), (SECOND.position, 8))
    first, second = holds(flight, (FIRST, SECOND), 0.1)
    assert (first.begun, first.lasted, first.kept) == (3.0, 10.0, True)
    assert (second.begun, second.lasted, second.kept) == (18.0, 7.0, True)


def test_points_held_in_the_wrong_order_too_short_or_never_are_not_kept():
    wrong = stays((SECOND.position, 8), (FIRST.position, 12))
    assert [hold.kept for hold in holds(wrong, (FIRST, SECOND), 0.1)] == [True, False]
    short = stays((FIRST.position, 10), (AWAY, 1), (FIRST.position, 4))
    (hold,) = holds(short, (FIRST,), 0.1)
    assert (hold.kept, hold.begun, hold.lasted) == (False, 0.0, 9.0)
    (hold,) = holds(stays((AWAY, 20)), (FIRST,), 0.1)
    assert not hold.kept
    assert np.isnan(hold.begun)


def test_the_judgement_of_a_flight_names_what_was_asked_for_and_no_more():
    flight = stays((FIRST.position, 20))
    free = limits_kept(Scenario(), flight, lambda points: np.linalg.norm(points, axis=-1))
    assert free.summary() == {"limits_kept": True}
    asked = {
        "inspect": {
            "hold_points": [{"position": FIRST.position, "seconds": 10.0}],
            "no_thrust_towards": [{"lower": [-1, -1, -1], "upper": [1, 1, 1]}],
            "passive_safety": 60.0,
        }
    }
    flight.attitude[:, 0] = 1.0
    strict = limits_kept(
        Scenario.model_validate(asked), flight, lambda points: np.linalg.norm(points, axis=-1), every=10
    )
    found = strict.summary()
    assert (found["limits_kept"], found["holds"], found["holds_kept"], found["plume_steps"]) == (True, 1, 1, 0)
    assert found["passive_safe_share"] == 1.0
    assert found["passive_pushed_spread_m"] > found["passive_spread_m"] == 0.0
    tight = limits_kept(Scenario.model_validate(asked), flight, lambda points: np.zeros(len(points)), every=10)
    assert not tight.kept

"""The flight loop: one step, shared by single flights, batches and real-time use; and what became of a flight.

The order within a step is fixed: estimate, control law, guard, what of the command arrives, thrusters, what they give,
motion.

A flight may be flown in segments: what leads it, its field and its goal may be others in each, and its memories go on.
A flight's setup is data to the compiled program. So one program flies every segment of one room, whatever map, goal and
guidance it has, as long as their arrays keep their shapes and everything that is no array stays equal.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.control.law import Command
from keepout.core.errors import FlightError
from keepout.core.flight.navigation import KnownSet
from keepout.core.flight.setup import FlightSetup, flown_setup
from keepout.core.guard.safety_layer import mode
from keepout.core.motion.arrays import Scalar, Vector
from keepout.core.motion.relative import MotionState

_THRUSTERS = 2**30
_SENSORS, _FIRST = _THRUSTERS + 1, _THRUSTERS + 2
"""Folded into a flight's key for what is drawn of its thrusters, its sensors and its first estimate."""


class LoopState(eqx.Module):
    """What is carried from one control step to the next."""

    motion: MotionState
    controller: PyTree
    guard: PyTree
    faults: PyTree
    thrusters: PyTree = ()
    sensors: PyTree = ()
    navigation: PyTree = ()


class FlightLog(eqx.Module):
    """One row of a flight for each control step; each entry holds from its time until the next.

    Positions m, velocities m/s, forces N, in the target's body axes; time s. position, velocity, attitude (body ←
    VVLH), angular_velocity: the truth. estimated_*: what the control law was told. commanded_force: the control law's;
    guarded_force: after the guard; force: truly applied, held until the next row or, of pulses, their mean until then.
    disturbance: at the row's time. barrier h (m), backstepping_barrier h₁, lyapunov V₁, and the statuses: as the
    control law and the guard gave them; guard_status is 0 in every row of a flight without a guard. field_value (m): at
    the true position, not a number without a field. saturated: whether a thruster reached its limit. target_orbit: the
    target's ECI state, where it is perturbed. propellant: burnt from the row until the next, kg, where the thrusters
    tell it. known_position, known_velocity: with sensors, the centre of the set that the guard is told;
    known_position_error, known_velocity_error: its radii; outliers: samples that the law's estimate left out;
    contradicted: whether the set's samples cannot all be within their bounds. leg: under way, counted from 0, where the
    law flies several.
    """

    time: Float[Array, "*rows"]
    position: Float[Array, "*rows 3"]
    velocity: Float[Array, "*rows 3"]
    attitude: Float[Array, "*rows 4"]
    angular_velocity: Float[Array, "*rows 3"]
    estimated_position: Float[Array, "*rows 3"]
    estimated_velocity: Float[Array, "*rows 3"]
    commanded_force: Float[Array, "*rows 3"]
    guarded_force: Float[Array, "*rows 3"]
    force: Float[Array, "*rows 3"]
    disturbance: Float[Array, "*rows 3"]
    disturbance_estimate: Float[Array, "*rows 3"]
    desired_velocity: Float[Array, "*rows 3"]
    safe_velocity: Float[Array, "*rows 3"]
    barrier: Float[Array, "*rows"]
    backstepping_barrier: Float[Array, "*rows"]
    lyapunov: Float[Array, "*rows"]
    field_value: Float[Array, "*rows"]
    control_status: Int[Array, "*rows"]
    guard_status: Int[Array, "*rows"]
    saturated: Bool[Array, "*rows"]
    target_orbit: Float[Array, "*rows 6"] | None = None
    propellant: Float[Array, "*rows"] | None = None
    known_position: Float[Array, "*rows 3"] | None = None
    known_velocity: Float[Array, "*rows 3"] | None = None
    known_position_error: Float[Array, "*rows"] | None = None
    known_velocity_error: Float[Array, "*rows"] | None = None
    outliers: Int[Array, "*rows"] | None = None
    contradicted: Bool[Array, "*rows"] | None = None
    leg: Int[Array, "*rows"] | None = None


def start(setup: FlightSetup, initial: MotionState, key: PRNGKeyArray) -> LoopState:
    """Give the loop's state before the first step. The control law starts from the estimate, not from the truth."""
    faults = setup.faults.initial_state(key)
    thrusters = setup.thrusters.initial_state(jax.random.fold_in(key, _THRUSTERS))
    if setup.navigation is None:
        faults, estimate = setup.faults.estimate(faults, initial)
        return LoopState(initial, *memories(setup, estimate), faults, thrusters)
    sensors = setup.navigation.suite.initial_state(jax.random.fold_in(key, _SENSORS), initial)
    known = setup.navigation.begin(setup.navigation.first_estimate(jax.random.fold_in(key, _FIRST), initial))
    # Law and guard start from what the first step will know: the same samples, drawn with the same keys.
    knowledge = setup.navigation.know(known, setup.navigation.suite.sample(sensors, initial)[1])[1]
    law, guard = memories(setup, knowledge.estimate, knowledge.known.state)
    return LoopState(initial, law, guard, faults, thrusters, sensors, known)


def memories(
    setup: FlightSetup,
    estimate: MotionState,
    known: MotionState | None = None,
    under_way: Float[Array, "steps 3"] | None = None,
) -> tuple[PyTree, PyTree]:
    """Give the states of control law and guard before their first `command`; the guard's is () where there is none.

    The law starts from `estimate`, and so does the guard unless it is told of another state, `known`. Forces
    `under_way` (N, the oldest first) were commanded before and have not taken effect; without them nothing was.
    """
    told = estimate if known is None else known
    if under_way is None:
        law = setup.controller.initial_state(estimate)
        return law, () if setup.guard is None else setup.guard.initial_state(told)
    law = setup.controller.begun_with(estimate, under_way)
    return law, () if setup.guard is None else setup.guard.begun_with(told, under_way)


def command(
    setup: FlightSetup,
    controller_state: PyTree,
    guard_state: PyTree,
    estimate: MotionState,
    known: KnownSet | None = None,
) -> tuple[PyTree, PyTree, Command, Vector, Int[Array, ""]]:
    """Run the on-board part of a step: control law, then guard, which is told of the set `known` where there is one.

    Returns the new states of law and guard, the law's `Command`, the force after the guard (N, body axes) and the
    guard's status.
    """
    controller_state, order = setup.controller.step(controller_state, estimate)
    if setup.guard is None:
        return controller_state, guard_state, order, order.force, jnp.zeros((), jnp.int32)
    if known is None:
        guard_state, force, status = setup.guard.filter(guard_state, estimate, order.force, order.disturbance_estimate)
    else:
        guard_state, force, status = setup.guard.filter(
            guard_state,
            known.state,
            order.force,
            order.disturbance_estimate,
            errors=known.errors,
            contradicted=known.contradicted,
        )
    controller_state = setup.controller.with_applied_force(controller_state, force)
    return controller_state, guard_state, order, force, jnp.asarray(status, jnp.int32)


def step(setup: FlightSetup, state: LoopState) -> tuple[LoopState, FlightLog]:
    """Fly one control period; the row describes its start and what was done over it."""
    truth, navigation = state.motion, setup.navigation
    if navigation is None:
        faults, estimate = setup.faults.estimate(state.faults, truth)
        sensors, knowing, knowledge, known = state.sensors, state.navigation, None, None
    else:
        sensors, samples = navigation.suite.sample(state.sensors, truth)
        knowing, knowledge = navigation.know(state.navigation, samples)
        faults, estimate, known = state.faults, knowledge.estimate, knowledge.known
    controller, guard, order, guarded, guard_status = command(setup, state.controller, state.guard, estimate, known)
    if navigation is not None:
        knowing = navigation.told(knowing, guarded)
    faults, arrived = setup.faults.command(faults, guarded, truth.time)
    thrusters, firing = setup.thrusters.fire(state.thrusters, arrived)
    faults, force = setup.faults.actuate(faults, firing.force, truth.time)
    motion = setup.motion.step(truth, force, setup.disturbance, setup.period, setup.mass, firing.pulses)
    row = FlightLog(
        time=truth.time,
        position=truth.position,
        velocity=truth.velocity,
        attitude=truth.attitude,
        angular_velocity=truth.angular_velocity,
        estimated_position=estimate.position,
        estimated_velocity=estimate.velocity,
        commanded_force=order.force,
        guarded_force=guarded,
        force=force,
        disturbance=setup.disturbance.force(truth.time),
        disturbance_estimate=order.disturbance_estimate,
        desired_velocity=order.desired_velocity,
        safe_velocity=order.safe_velocity,
        barrier=order.barrier,
        backstepping_barrier=order.backstepping_barrier,
        lyapunov=order.lyapunov,
        field_value=jnp.full((), jnp.nan) if setup.field is None else setup.field.value(truth.position),
        control_status=order.status,
        guard_status=guard_status,
        saturated=setup.thrusters.saturated(arrived),
        target_orbit=truth.target_orbit,
        propellant=firing.propellant,
        known_position=None if known is None else known.state.position,
        known_velocity=None if known is None else known.state.velocity,
        known_position_error=None if known is None else known.errors[0],
        known_velocity_error=None if known is None else known.errors[1],
        outliers=None if knowledge is None else knowledge.outliers.astype(jnp.int32),
        contradicted=None if known is None else known.contradicted,
        leg=None if order.leg is None else order.leg.astype(jnp.int32),
    )
    return LoopState(motion, controller, guard, faults, thrusters, sensors, knowing), row


def trace(setup: FlightSetup, initial: MotionState, steps: int, key: PRNGKeyArray) -> FlightLog:
    """Fly `steps` control periods: `steps` + 1 rows, the last one at the end of the flight. To be used inside a `jit`.

    The last row's forces are what would have been done next.
    """
    return jax.lax.scan(lambda state, _: step(setup, state), start(setup, initial, key), length=steps + 1)[1]


def fly(setup: FlightSetup, initial: MotionState, steps: int, key: PRNGKeyArray) -> FlightLog:
    """Fly as `trace` does, compiled: one program serves all flights of a room (`room_for`)."""
    rows = steps + 1
    return rows_of(_flown(flown_setup(setup), initial, as_count(rows), key, room_for(rows)), rows)


def as_count(rows: int) -> Int[Array, ""]:
    """Give a number of rows as an array, so that it is data to a compiled program."""
    return jax.device_put(np.asarray(rows, dtype=np.int32))


def room_for(rows: int) -> int:
    """Give the number of rows for which a program is made that is to log so many: a power of four, at least 16."""
    power = (rows - 1).bit_length()
    return 1 << max(4, power + power % 2)


def advanced(setup: FlightSetup, state: LoopState, rows: Int[Array, ""], room: int) -> tuple[LoopState, FlightLog]:
    """Fly so many control periods, `room` at most: the state after them, and their rows. To be used inside a `jit`.

    The log has `room` rows, of which those beyond `rows` mean nothing (`rows_of`).
    """
    arrays, still = eqx.partition(setup, eqx.is_array)
    # So that it is traced once, for the rows' shapes and for the flight.
    once = jax.jit(lambda arrays, state: step(eqx.combine(arrays, still), state), inline=True)
    shapes = jax.eval_shape(once, arrays, state)[1]
    empty = jax.tree.map(lambda row: jnp.zeros((room, *row.shape), row.dtype), shapes)

    def advance(place: Int[Array, ""], flown: tuple[LoopState, FlightLog]) -> tuple[LoopState, FlightLog]:
        state, log = flown
        state, row = once(arrays, state)
        put = jax.lax.dynamic_update_index_in_dim
        return state, jax.tree.map(lambda column, entry: put(column, entry, place, 0), log, row)

    return jax.lax.fori_loop(0, rows, advance, (state, empty))


def rows_of(log: FlightLog, rows: int) -> FlightLog:
    """Give the first rows of a log: cut outside of JAX, which would compile a program for each number of them."""

    def cut(column: Array) -> Array:
        return column[:rows] if isinstance(column, Tracer) else jax.device_put(np.asarray(column)[:rows])

    return jax.tree.map(cut, log)


@kept_jit
def _flown(setup: FlightSetup, initial: MotionState, rows: Int[Array, ""], key: PRNGKeyArray, room: int) -> FlightLog:
    return advanced(setup, start(setup, initial, key), rows, room)[1]


begin = kept_jit(start)
"""`start`, compiled: `begin(setup, initial, key) -> LoopState`, the state before the first segment."""


@kept_jit
def _fly(setup: FlightSetup, state: LoopState, rows: Int[Array, ""], room: int) -> tuple[LoopState, FlightLog]:
    return advanced(setup, state, rows, room)


def fly_segment(
    setup: FlightSetup, state: LoopState, steps: int, *, longest: int | None = None
) -> tuple[LoopState, FlightLog]:
    """Fly `steps` control periods from a state: the state after them, and a row for the start of each.

    Law and guard go on with what they remember: the law's observer, the force held, the commands under way, the guard's
    plan. That is right as long as what is new in `setup` leaves the meaning of these: another goal, guidance or tuning,
    and a field that says nowhere less than the one before (docs/mapping.md). One program serves all numbers of
    steps up to its room.

    A whole flight's record has one more row, of its end: fly a last segment of one step and keep its row only.

    Args:
        setup: of the segment.
        state: after the one before.
        steps: of the segment.
        longest: of a flight's segments, in steps: the room that its one program is made for. By default the steps.

    Raises:
        FlightError: fewer than one step, or more than the longest.

    """
    if steps < 1:
        raise FlightError(f"segment: steps is {steps}; at least 1 is needed")
    if longest is not None and steps > longest:
        raise FlightError(f"segment: steps is {steps}; longest is {longest}")
    room = room_for(steps if longest is None else longest)
    state, log = _fly(setup, state, as_count(steps), room)
    return state, rows_of(log, steps)


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Put the rows of segments flown one after another into one log."""
    # Not by a compiled program: of thousands of segments that takes minutes to compile.
    return jax.tree.map(lambda *rows: jax.device_put(np.concatenate([np.asarray(row) for row in rows])), *logs)


STATUSES = 16
"""Status values 0 to 15 are counted apart; a status beyond counts as the last."""


class FlightOutcome(eqx.Module):
    """Summary of one flight (leading axes: of many).

    Attributes:
        minimum_barrier: the least h, m.
        final_error: ‖r − goal‖ at the end, m.
        reached: whether the chaser was closer to the goal than the tolerance from some time until the end, and the
            flight is finite.
        time_to_reach: that time, s after the start; infinite if not reached.
        delta_v: Σ ‖F‖ T/m over the steps flown, m/s.
        saturated_fraction: of the steps flown, those in which a thruster reached its limit.
        guard_interventions: steps in which the guard replaced the command.
        control_status_counts: steps by status value.
        guard_status_counts: likewise, without the guard's flags.
        guard_flags: every flag that the guard raised, as bits.
        finite: whether every position, velocity and force is a number.
        propellant: burnt over the steps flown, kg; None where the thrusters do not tell it.

    """

    minimum_barrier: Float[Array, "*flights"]
    final_error: Float[Array, "*flights"]
    reached: Bool[Array, "*flights"]
    time_to_reach: Float[Array, "*flights"]
    delta_v: Float[Array, "*flights"]
    saturated_fraction: Float[Array, "*flights"]
    guard_interventions: Int[Array, "*flights"]
    control_status_counts: Int[Array, "*flights 16"]
    guard_status_counts: Int[Array, "*flights 16"]
    guard_flags: Int[Array, "*flights"]
    finite: Bool[Array, "*flights"]
    propellant: Float[Array, "*flights"] | None = None


def outcome(setup: FlightSetup, log: FlightLog) -> FlightOutcome:
    """Summarise one flight's log (`steps` + 1 rows; what was done in the last row was not flown)."""
    return _summary(log, setup.goal, setup.tolerance, setup.period, setup.mass)


@jax.jit  # of the numbers alone, so that flights of one length share a program whatever steers them
def _summary(log: FlightLog, goal: Vector, tolerance: Scalar, period: Scalar, mass: Scalar) -> FlightOutcome:
    error = jnp.linalg.norm(log.position - goal, axis=-1)
    near = error < tolerance  # false where the error is not a number
    away = jnp.where(near, -1, jnp.arange(near.shape[0]))
    arrival = jnp.max(away) + 1
    finite = jnp.all(jnp.isfinite(log.position)) & jnp.all(jnp.isfinite(log.velocity))
    finite = finite & jnp.all(jnp.isfinite(log.force[:-1]))
    reached = near[-1] & finite
    guard_status = log.guard_status[:-1]
    guard_mode = mode(guard_status)
    arrival_time = log.time[jnp.minimum(arrival, near.shape[0] - 1)] - log.time[0]
    return FlightOutcome(
        minimum_barrier=jnp.min(log.barrier),
        final_error=error[-1],
        reached=reached,
        time_to_reach=jnp.where(reached, arrival_time, jnp.inf),
        delta_v=jnp.sum(jnp.linalg.norm(log.force[:-1], axis=-1)) * period / mass,
        saturated_fraction=jnp.mean(log.saturated[:-1].astype(jnp.float64)),
        guard_interventions=jnp.sum(guard_mode != 0),
        control_status_counts=_count(log.control_status[:-1]),
        guard_status_counts=_count(guard_mode),
        guard_flags=jnp.bitwise_or.reduce(guard_status - guard_mode),
        finite=finite,
        propellant=None if log.propellant is None else jnp.sum(log.propellant[:-1]),
    )


def _count(status: Int[Array, "steps"]) -> Int[Array, "16"]:
    known = jnp.clip(status, 0, STATUSES - 1)
    return jnp.sum(known[:, None] == jnp.arange(STATUSES), axis=0)

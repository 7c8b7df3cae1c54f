"""The velocity program solved: whether it can be met at all, its solution, and the solution's derivative.

The solution has a closed form where a half-space and a speed limit are all there is. Else the interior point
(`interior_point`) says which rows hold with equality; Newton's method on these (`active_set`) finds the optimum to
rounding, and gives the derivative.
"""

import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from keepout.core.control.active_set import Active, Stationary, identify, polish, sensitivity
from keepout.core.control.interior_point import interior_point
from keepout.core.control.unit_program import (
    HalfSpaces,
    UnitProgram,
    VelocityProgram,
    escape_velocity,
    length,
    nearest_row,
    or_one,
    passable,
    row_length,
    row_lengths,
    to_conic,
    to_unit,
)
from keepout.core.motion.arrays import Flag, Scalar, Vector

_EDGE = 1e-11  # below this much room (in units of speed) the feasible set is one point: the escape velocity
_AT_APEX = 1e-13


class ConeStatus(enum.IntEnum):
    """How a solve ended."""

    SOLVED = 0
    INFEASIBLE = 1  # no velocity satisfies the barrier row: the answer is the fastest way out
    STALLED = 2  # the interior point's best iterate, whose optimality could not be verified to rounding
    NOT_FINITE = 3  # the data hold NaN or infinity: the answer is zero
    NO_WAY_OUT = 4  # infeasible, and with e ≥ ‖n‖ no velocity is known to lead out either: the answer is zero


class ConeSolution(eqx.Module):
    """Answer of the velocity program.

    `velocity` (3,) m/s; `status` a `ConeStatus`; `room` in m/s: barrier_rate + g_max, the program is feasible
    exactly if it is not negative (closed form, `escape_velocity`; above what any row can use it is cut off);
    `iterations` of the interior point.
    """

    velocity: Vector
    status: Int[Array, ""]
    room: Scalar
    iterations: Int[Array, ""]


class _Outcome(NamedTuple):
    """A solve in the unit program's scale, with everything its derivative needs."""

    at: Stationary
    active: Active
    escaping: Flag
    resting: Flag
    status: Int[Array, ""]
    room: Scalar
    iterations: Int[Array, ""]


def _rest_is_optimal(unit: UnitProgram) -> Flag:
    """Whether v = 0 solves a program whose barrier row has its apex there (barrier_rate = 0).

    The pull at rest q = v_c + 2 p max(Υ, 0) T must lie in the polar of {n·v ≥ e‖v‖}: ‖q + λn‖ ≤ λe for some λ ≥ 0.
    """
    pull = unit.desired
    if unit.circulation is not None:
        push = 2.0 * unit.circulation.weight * jnp.maximum(unit.circulation.rate, 0.0)
        pull = pull + push * unit.circulation.tangent
    along = jnp.sum(pull * unit.normal)
    spread = jnp.sum(unit.normal**2) - unit.error**2
    optimal = (spread <= 0.0) | ((along <= 0.0) & (along * along >= jnp.sum(pull**2) * spread))
    return optimal if unit.half_spaces is None else optimal & jnp.all(unit.half_spaces.rates >= 0.0)


def _iterate(unit: UnitProgram, easy: Flag) -> tuple[Active, Stationary, Flag, Int[Array, ""]]:
    """Interior point and polish. Where a closed form answers (`easy`) they work on a program that they can finish."""
    tame = unit._replace(barrier_rate=jnp.where(easy, 3.0, unit.barrier_rate))
    if unit.half_spaces is not None:
        rates = jnp.where(easy, 3.0, unit.half_spaces.rates)
        tame = tame._replace(half_spaces=HalfSpaces(unit.half_spaces.normals, rates))
    iterate = interior_point(to_conic(tame))
    return *polish(tame, *identify(tame, iterate)), iterate.iterations


def _project(unit: UnitProgram) -> tuple[Active, Stationary, Flag, Int[Array, ""]]:
    """Project onto a half-space and a ball, in closed form: onto the ball, else the plane, else their circle."""
    assert unit.speed is not None
    n, desired, rate, limit = unit.normal, unit.desired, unit.barrier_rate, unit.speed
    square = jnp.sum(n * n)
    square = or_one(square)
    speed = length(desired)
    in_ball = desired * jnp.minimum(1.0, limit / or_one(speed))
    along = jnp.sum(n * desired)
    on_plane = desired - (along + rate) / square * n
    foot = -rate / square * n
    tangent = desired - along / square * n
    spread = length(tangent)
    radius = jnp.sqrt(jnp.maximum(limit * limit - jnp.sum(foot * foot), 0.0))
    on_circle = foot + radius * tangent / or_one(spread)
    ball = jnp.sum(n * in_ball) + rate >= 0.0
    plane = length(on_plane) <= limit
    stretch = jnp.where(
        ball, jnp.maximum(speed / limit, 1.0), jnp.where(plane, 1.0, spread / jnp.maximum(radius, _EDGE))
    )
    at = Stationary(
        jnp.where(ball, in_ball, jnp.where(plane, on_plane, on_circle)),
        jnp.where(ball, 0.0, -(stretch * rate + along) / square),
        stretch - 1.0,
    )
    limited = jnp.where(ball, speed > limit, ~plane)
    return Active(~ball, limited, jnp.zeros(3)), at, jnp.asarray(True), jnp.asarray(0, dtype=jnp.int32)


def _solve_unit(program: VelocityProgram) -> _Outcome:
    unit = to_unit(program)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(program)]))
    # Non-finite data are replaced by harmless ones here and answered with zero below.
    unit = jax.tree.map(lambda x: jnp.where(finite, x, 1.0), unit)
    nearest = nearest_row(unit)[1]
    gain, escape = escape_velocity(nearest)
    room = nearest.barrier_rate + gain
    unit = passable(unit)
    escaping = room <= _EDGE
    resting = (jnp.abs(unit.barrier_rate) <= _AT_APEX) & (unit.error > 0.0) & _rest_is_optimal(unit)
    easy = escaping | resting
    rows = (program.gradient_error, program.circulation, program.box, program.half_spaces)
    simple = all(row is None for row in rows)
    active, at, good, iterations = _project(unit) if simple else _iterate(unit, easy)
    velocity = jnp.where(escaping, escape, jnp.where(resting, 0.0, at.velocity))
    status = jnp.where(good | easy, ConeStatus.SOLVED, ConeStatus.STALLED)
    infeasible = jnp.where(gain > 0.0, ConeStatus.INFEASIBLE, ConeStatus.NO_WAY_OUT)
    status = jnp.where(room < 0.0, infeasible, status)
    status = jnp.where(finite, status, ConeStatus.NOT_FINITE).astype(jnp.int32)
    at = at._replace(velocity=jnp.where(finite, velocity, 0.0))
    return _Outcome(at, active, escaping, resting, status, room, iterations)


def _answer(program: VelocityProgram, outcome: _Outcome) -> Vector:
    """Return the solution in m/s."""
    return to_unit(program).size * outcome.at.velocity


def _change(primals: tuple, tangents: tuple, *, apart: bool) -> Vector:
    """Return the derivative of the solution, m/s, from the optimality conditions."""
    program, outcome = primals
    unit, change = jax.jvp(to_unit, (program,), (tangents[0],))
    (_, _), (_, escape_change) = jax.jvp(lambda unit: escape_velocity(nearest_row(unit)[1]), (unit,), (change,))
    unit, change = jax.jvp(passable, (unit,), (change,))
    inside = sensitivity(unit, change, outcome.active, outcome.at, apart=apart)
    derivative = jnp.where(outcome.escaping, escape_change, jnp.where(outcome.resting, 0.0, inside))
    derivative = unit.size * derivative + change.size * outcome.at.velocity
    return jnp.where(outcome.status == ConeStatus.NOT_FINITE, 0.0, derivative)


# The primal of each rule is the function itself again, so that a derivative taken of a derivative's primal is not lost.
_velocity = jax.custom_jvp(_answer)
_velocity.defjvp(lambda primals, tangents: (_velocity(*primals), _change(primals, tangents, apart=True)))
_velocity_forward = jax.custom_jvp(_answer)
_velocity_forward.defjvp(
    lambda primals, tangents: (_velocity_forward(*primals), _change(primals, tangents, apart=False))
)


def solve(program: VelocityProgram, *, forward: bool = False) -> ConeSolution:
    """Solve one velocity program (paper Eq. cbf_socp_CI); batches through `jax.vmap`.

    The velocity carries its exact first derivative with respect to every entry of the program (optimality conditions
    on the active set), forwards and backwards; second derivatives are not defined. With `forward` it is taken forwards
    only, which is cheaper where it is taken in every control step. Away from changes of the active set the solution is
    differentiable; at one the derivative is that of one side.

    Method: primal-dual interior point (`interior_point`), then Newton on the active set (`polish`); a half-space with a
    speed limit alone has a closed form. Feasibility is closed form, and an infeasible program answers with the fastest
    way out, status `INFEASIBLE`; where there is none (e ≥ ‖n‖), with zero, status `NO_WAY_OUT`.
    """
    data = jax.lax.stop_gradient(program)
    outcome = jax.lax.stop_gradient(_solve_unit(data))
    row = row_length(data)
    if data.half_spaces is not None:
        row = jnp.append(row, row_lengths(data.half_spaces))[nearest_row(to_unit(data))[0]]
    room = outcome.room * to_unit(data).size * row
    velocity = (_velocity_forward if forward else _velocity)(program, outcome)
    return ConeSolution(velocity, outcome.status, room, outcome.iterations)

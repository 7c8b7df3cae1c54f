"""The optimum of a velocity program to rounding: Newton's method on the rows that hold with equality.

The interior point's last iterate says which rows these are; the set is changed where the answer asks for it. The same
equations give the derivative.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from keepout.core.control.interior_point import TINY, Factors, Iterate, back_substitute, factor
from keepout.core.control.unit_program import UnitProgram, length, objective_slope, or_one
from keepout.core.motion.arrays import Flag, Scalar, Vector

_FEASIBLE = 1e-12
_OPTIMAL = 1e-11
_NEWTON_STEPS = 3
_TRIES = 12
_COINCIDING = 1e-12


class Active(NamedTuple):
    """Which rows hold with equality: barrier, speed cone, for each component −1, 0 or 1 for the box, half-spaces."""

    barrier: Flag
    speed: Flag
    box: Vector
    half_spaces: Bool[Array, "rows"] | None = None


class Stationary(NamedTuple):
    """Velocity and the multipliers of the barrier row, the speed cone and the half-spaces; or a change of them."""

    velocity: Vector
    barrier: Scalar
    speed: Scalar
    half_spaces: Float[Array, "rows"] | None = None


class _Equations(NamedTuple):
    """Values of the equations' left-hand sides; or a change of them."""

    stationarity: Vector
    barrier: Scalar
    speed: Scalar
    half_spaces: Float[Array, "rows"] | None = None


def identify(unit: UnitProgram, iterate: Iterate) -> tuple[Active, Stationary]:
    """Active rows (multiplier larger than slack) and starting multipliers from an interior-point iterate."""
    slope = objective_slope(unit)
    point, slacks, row_multipliers = iterate.at.point, iterate.at.slacks, iterate.at.multipliers.lines
    multipliers = iterate.at.multipliers.cones[:, 0]
    gaps = slacks.cones[:, 0] - jnp.sqrt(jnp.sum(slacks.cones[:, 1:] ** 2, axis=-1))
    row = 0 if unit.circulation is None else 1
    if unit.gradient_error is None:
        multipliers = jnp.concatenate([row_multipliers[row : row + 1], multipliers])
        gaps = jnp.concatenate([slacks.lines[row : row + 1], gaps])
    touching = multipliers > gaps
    values = jnp.where(touching, multipliers * slope, 0.0)
    speed, speed_value = jnp.asarray(False), jnp.asarray(0.0)
    if unit.speed is not None:
        speed, speed_value = touching[1], values[1] / unit.speed
    box = jnp.zeros(3)
    if unit.box is not None:
        held = jnp.where(row_multipliers > slacks.lines, 1.0, 0.0)
        box = held[-6:-3] - held[-3:]
    further, further_values = None, None
    if unit.half_spaces is not None:
        first = row + (unit.gradient_error is None)
        lines = slice(first, first + len(unit.half_spaces.rates))
        further = row_multipliers[lines] > slacks.lines[lines]
        further_values = jnp.where(further, row_multipliers[lines] * slope, 0.0)
    return Active(touching[0], speed, box, further), Stationary(point[:3], values[0], speed_value, further_values)


def _shortfall(unit: UnitProgram, velocity: Vector) -> Scalar:
    assert unit.circulation is not None
    return jnp.maximum(unit.circulation.rate - jnp.sum(unit.circulation.tangent * velocity), 0.0)


def _direction(velocity: Vector) -> tuple[Vector, Scalar]:
    speed = length(velocity)
    return velocity / or_one(speed), speed


def _residuals(unit: UnitProgram, active: Active, at: Stationary) -> tuple[_Equations, Vector]:
    """Return the equations' values, and the stationarity residual before held components were taken out."""
    v = at.velocity
    direction, speed = _direction(v)
    force = v - unit.desired - at.barrier * (unit.normal - unit.error * direction) + at.speed * v
    if unit.circulation is not None:
        force = force - 2.0 * unit.circulation.weight * _shortfall(unit, v) * unit.circulation.tangent
    further = None
    if unit.half_spaces is not None and at.half_spaces is not None:
        force = force - jnp.sum(at.half_spaces[:, None] * unit.half_spaces.normals, axis=0)
        further = jnp.sum(unit.half_spaces.normals * v, axis=-1) + unit.half_spaces.rates
    stationarity = force
    if unit.box is not None:
        stationarity = jnp.where(active.box != 0.0, v - active.box * unit.box, force)
    barrier = jnp.sum(unit.normal * v) - unit.error * speed + unit.barrier_rate
    limit = jnp.zeros_like(speed) if unit.speed is None else 0.5 * (jnp.sum(v * v) - unit.speed**2)
    return _Equations(stationarity, barrier, limit, further), force


def _correction(
    unit: UnitProgram, active: Active, at: Stationary, values: _Equations, *, apart: bool = False
) -> Stationary:
    """Return the change of (v, λ_b, λ_s) that cancels `values` to first order, inactive rows left out.

    `apart` keeps what depends on `values` in arrays of its own: JAX then sees that the answer is linear in them, which
    a derivative taken backwards needs. Else three columns are one array, and one operation serves all of them.
    """
    v = at.velocity
    direction, speed = _direction(v)
    curvature = at.barrier * unit.error / or_one(speed)
    gradient = unit.normal - unit.error * direction
    hessian = (1.0 + at.speed + curvature) * jnp.eye(3) - curvature * direction[:, None] * direction
    if unit.circulation is not None:
        tangent = unit.circulation.tangent
        push = jnp.where(_shortfall(unit, v) > 0.0, 2.0 * unit.circulation.weight, 0.0)
        hessian = hessian + push * tangent[:, None] * tangent
    free = jnp.where(active.box == 0.0, 1.0, 0.0)
    fixed = -(1.0 - free) * values.stationarity
    barrier_value = values.barrier + jnp.sum(gradient * fixed)
    speed_value = values.speed + jnp.sum(v * fixed)
    rhs = values.stationarity + jnp.sum(hessian * fixed, axis=-1)
    if unit.half_spaces is not None:
        factors = factor(free[:, None] * free * hessian + jnp.diag(1.0 - free))
        return _of_all_rows(unit, active, values, fixed, factors, free * rhs, jnp.stack([gradient, -v]))
    if apart:
        columns = [free * rhs, free * gradient, free * v]
    else:
        whole = free[:, None] * jnp.stack([rhs, gradient, v], axis=1)
        columns = [whole[:, i] for i in range(3)]
    factors = factor(free[:, None] * free * hessian + jnp.diag(1.0 - free))
    from_rhs, from_gradient, from_velocity = (back_substitute(factors, column) for column in columns)

    # Schur complement of the active rows; an inactive row keeps its multiplier's change at zero.
    bb = jnp.where(active.barrier, jnp.sum(columns[1] * from_gradient), 1.0)
    ss = jnp.where(active.speed, jnp.sum(columns[2] * from_velocity), 1.0)
    bs = jnp.where(active.barrier & active.speed, jnp.sum(columns[1] * from_velocity), 0.0)
    target_b = jnp.where(active.barrier, jnp.sum(columns[1] * from_rhs) - barrier_value, 0.0)
    target_s = jnp.where(active.speed, speed_value - jnp.sum(columns[2] * from_rhs), 0.0)
    determinant = bb * ss - bs * bs
    safe = jnp.where(determinant > 1e-14 * bb * ss, determinant, jnp.inf)
    barrier = (ss * target_b + bs * target_s) / safe
    limit = (bs * target_b + bb * target_s) / safe
    return Stationary(fixed - from_rhs + from_gradient * barrier - from_velocity * limit, barrier, limit)


def _of_all_rows(
    unit: UnitProgram,
    active: Active,
    values: _Equations,
    fixed: Vector,
    factors: Factors,
    rhs: Vector,
    gradients: Float[Array, "2 3"],
) -> Stationary:
    """Return the correction of a program with half-spaces, from the factors of the free components' Hessian.

    `fixed` is the change of the held components, `gradients` those of the barrier row and the speed limit.
    """
    assert unit.half_spaces is not None
    assert active.half_spaces is not None
    assert values.half_spaces is not None
    gradients = jnp.concatenate([gradients, unit.half_spaces.normals])
    missed = jnp.concatenate([jnp.stack([values.barrier, -values.speed]), values.half_spaces])
    missed = missed + jnp.sum(gradients * fixed, axis=-1)
    from_rhs = back_substitute(factors, rhs)
    columns = jnp.where(active.box == 0.0, gradients, 0.0).T
    from_rows = back_substitute(factors, columns)

    # Schur complement of the active rows; an inactive row, or one that nothing free moves, keeps its multiplier.
    schur = jnp.sum(columns[:, :, None] * from_rows[:, None, :], axis=0)
    size = jnp.diagonal(schur)
    acting = jnp.concatenate([jnp.stack([active.barrier, active.speed]), active.half_spaces]) & (size > 0.0)
    # Of rows that all but coincide, or are more than can meet in a point, the change of multipliers is then large with
    # opposite signs, and the sign says which of them are to be let go.
    size = jnp.where(acting, size * (1.0 + _COINCIDING), 1.0)
    schur = jnp.where(acting[:, None] & acting & ~jnp.eye(len(size), dtype=bool), schur, jnp.diag(size))
    wanted = jnp.where(acting, jnp.sum(columns * from_rhs[:, None], axis=0) - missed, 0.0)
    change = back_substitute(factor(schur), wanted)
    return Stationary(fixed - from_rhs + jnp.sum(from_rows * change, axis=1), change[0], change[1], change[2:])


class _Attempt(NamedTuple):
    """An active set, the point that Newton's method found on it, and whether that point is the optimum."""

    active: Active
    at: Stationary
    optimal: Flag
    tries: Int[Array, ""]


def _newton(unit: UnitProgram, active: Active, start: Stationary) -> tuple[Stationary, Scalar]:
    """Take Newton steps on one active set; returns the point and the length of the last change of velocity."""
    at, change = start, jnp.asarray(jnp.inf)
    for _ in range(_NEWTON_STEPS):
        step = _correction(unit, active, at, _residuals(unit, active, at)[0])
        change = jnp.max(jnp.abs(step.velocity))
        # Where the barrier is a cone its curvature goes with 1/‖v‖: a longer step would leap over the solution.
        curved = active.barrier & (unit.error > 0.0)
        room = 0.7 * length(at.velocity) / jnp.maximum(length(step.velocity), TINY)
        share = jnp.where(curved, jnp.minimum(1.0, room), 1.0)
        at = jax.tree.map(lambda value, slope, share=share: value + share * slope, at, step)
    return at, change


def _judge(unit: UnitProgram, active: Active, at: Stationary, change: Scalar) -> tuple[Flag, Active, Stationary]:
    """Say whether a point satisfies every optimality condition to rounding; if not, which set to try next.

    Rows with a multiplier of the wrong sign are let go, rows that are violated are taken up.
    """
    values, force = _residuals(unit, active, at)
    optimal = _OPTIMAL * objective_slope(unit)
    # A steep penalty leaves rounding errors in the residual that do not move the velocity: then the last step tells.
    good = (jnp.max(jnp.abs(values.stationarity)) <= optimal) | (change <= _OPTIMAL)

    rising = at.barrier >= -optimal
    good &= jnp.where(active.barrier, jnp.abs(values.barrier) <= _FEASIBLE, values.barrier >= -_FEASIBLE) & rising
    kept = rising & ~((values.barrier > _FEASIBLE) & (at.barrier <= optimal))
    barrier, barrier_broken = active.barrier & kept, ~active.barrier & (values.barrier < -_FEASIBLE)
    speed, speed_broken = active.speed, jnp.asarray(False)
    if unit.speed is not None:
        limit = _FEASIBLE * unit.speed**2
        rising = at.speed >= -optimal
        good &= jnp.where(speed, jnp.abs(values.speed) <= limit, values.speed <= limit) & rising
        kept = rising & ~((values.speed < -limit) & (at.speed <= optimal))
        speed, speed_broken = active.speed & kept, ~active.speed & (values.speed > limit)
    box, beyond = active.box, jnp.zeros(3, dtype=bool)
    if unit.box is not None:
        # At a held component the objective must still fall towards the outside.
        released = box * force > optimal
        beyond = (box == 0.0) & (jnp.abs(at.velocity) > unit.box * (1.0 + _FEASIBLE))
        good &= ~jnp.any(beyond | released)
        box = jnp.where(beyond, jnp.sign(at.velocity), jnp.where(released, 0.0, box))
    # A point far outside the box says nothing about the other rows.
    inside = ~jnp.any(beyond)
    barrier, speed = barrier | (barrier_broken & inside), speed | (speed_broken & inside)
    further, multipliers = None, None
    if active.half_spaces is not None and at.half_spaces is not None and values.half_spaces is not None:
        slack, rising = values.half_spaces, at.half_spaces >= -optimal
        good &= jnp.all(jnp.where(active.half_spaces, (jnp.abs(slack) <= _FEASIBLE) & rising, slack >= -_FEASIBLE))
        further = active.half_spaces & rising & ~((slack > _FEASIBLE) & (at.half_spaces <= optimal))
        further = further | ((slack < -_FEASIBLE) & inside & ~active.half_spaces)
        multipliers = jnp.where(further, at.half_spaces, 0.0)
    if unit.box is not None:
        # At a corner of the box nothing can move: a further row takes the place of the face that holds least.
        cornered = jnp.all(box != 0.0)
        cornered = cornered & (barrier | speed if further is None else barrier | speed | jnp.any(further))
        box = jnp.where(cornered & (jnp.abs(force) <= jnp.min(jnp.abs(force))), 0.0, box)
    chosen = Active(barrier, speed, box, further)
    again = Stationary(at.velocity, jnp.where(barrier, at.barrier, 0.0), jnp.where(speed, at.speed, 0.0), multipliers)
    return good, chosen, again


def polish(unit: UnitProgram, active: Active, start: Stationary) -> tuple[Active, Stationary, Flag]:
    """Solve on the active set, and change the set as long as the answer asks for it (primal-dual active set).

    Returns the set, the point and whether every optimality condition holds to rounding; where none did, the set and
    the point given.
    """

    def attempt(last: _Attempt) -> _Attempt:
        at, change = _newton(unit, last.active, last.at)
        good, chosen, again = _judge(unit, last.active, at, change)
        return _Attempt(_choose(good, last.active, chosen), _choose(good, at, again), good, last.tries + 1)

    first = _Attempt(active, start, jnp.asarray(False), jnp.asarray(0, dtype=jnp.int32))
    end = jax.lax.while_loop(lambda a: (~a.optimal) & (a.tries < _TRIES), attempt, first)
    return _choose(end.optimal, end.active, active), _choose(end.optimal, end.at, start), end.optimal


def _choose(condition: Flag, yes: Any, no: Any) -> Any:
    """Take one of two pytrees as a whole."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def sensitivity(unit: UnitProgram, change: UnitProgram, active: Active, at: Stationary, *, apart: bool) -> Vector:
    """Directional derivative of the solution for a change of the program's data, active set held.

    `apart` as of `_correction`.
    """
    v = at.velocity
    direction, speed = _direction(v)
    force = -change.desired - at.barrier * (change.normal - change.error * direction)
    if unit.circulation is not None and change.circulation is not None:
        data, moved, short = unit.circulation, change.circulation, _shortfall(unit, v)
        short_change = jnp.where(short > 0.0, moved.rate - jnp.sum(moved.tangent * v), 0.0)
        force = force - 2.0 * moved.weight * short * data.tangent
        force = force - 2.0 * data.weight * (short_change * data.tangent + short * moved.tangent)
    further = None
    if change.half_spaces is not None and at.half_spaces is not None:
        force = force - jnp.sum(at.half_spaces[:, None] * change.half_spaces.normals, axis=0)
        further = jnp.sum(change.half_spaces.normals * v, axis=-1) + change.half_spaces.rates
    if unit.box is not None and change.box is not None:
        force = jnp.where(active.box != 0.0, -active.box * change.box, force)
    barrier = jnp.sum(change.normal * v) - change.error * speed + change.barrier_rate
    limit = jnp.zeros_like(speed)
    if unit.speed is not None and change.speed is not None:
        limit = -unit.speed * change.speed
    return _correction(unit, active, at, _Equations(force, barrier, limit, further), apart=apart).velocity

"""The velocity program: what is asked, its units taken out, whether it can be met at all, and its solution.

The solution has a closed form where a half-space and a speed limit are all there is. Else the interior point
(`interior_point`) says which rows hold with equality; Newton's method on these finds the optimum to rounding, changes
the set where the answer asks for it, and gives the derivative.
"""

import enum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from keepout.core.control.interior_point import TINY, ConicProgram, Iterate, back_substitute, factor, interior_point
from keepout.core.errors import ControlError
from keepout.core.motion.arrays import Flag, Scalar, Vector

_FAR = 3.0  # more than √3, the largest speed inside the unit box: a row beyond it never acts
_NARROWEST = 1e-8
_FEASIBLE = 1e-12
_OPTIMAL = 1e-11
_NEWTON_STEPS = 3
_TRIES = 12


class Circulation(eqx.Module):
    """The relaxed circulation inequality tangent · v − rate ≥ σ with penalty weight · σ² (paper Eq. cbf_socp_CI).

    `tangent` (3,) is T = Ω ∇f̃, `rate` is Υ(h) in m/s, `weight` is p.
    """

    tangent: Vector
    rate: Scalar
    weight: Scalar


class VelocityProgram(eqx.Module):
    """Minimise ½‖desired − v‖² + p σ² over the safe velocities v with a speed cone beside the box.

    Paper Eq. cbf_socp_CI.

    The constraints are normal · v + barrier_rate ≥ gradient_error ‖v‖; tangent · v − rate ≥ σ where `circulation` is
    given; |v_i| ≤ box where given; ‖v‖ ≤ speed where given. A constraint that is absent (None) has no row, and
    without `gradient_error` (e_∇h) the barrier row is a half-space. At least one of box and
    speed must be given. Velocities in m/s; `normal` is ∇f̃, `barrier_rate` is α(h) in m/s.

    Raises `ControlError` if neither box nor speed is given.
    """

    desired: Vector
    normal: Vector
    barrier_rate: Scalar
    gradient_error: Scalar | None = None
    circulation: Circulation | None = None
    box: Scalar | None = None
    speed: Scalar | None = None

    def __check_init__(self) -> None:
        if self.box is None and self.speed is None:
            raise ControlError("velocity program: neither a box nor a speed limit is given; give at least one, in m/s")


class UnitProgram(NamedTuple):
    """The program with velocities in units of `size`, a speed in m/s, and every row divided by its length."""

    desired: Vector
    normal: Vector
    barrier_rate: Scalar
    gradient_error: Scalar | None
    circulation: Circulation | None
    box: Scalar | None
    speed: Scalar | None
    size: Scalar

    @property
    def error(self) -> Scalar:
        """The gradient error e, zero where the barrier row is a half-space."""
        return jnp.zeros_like(self.barrier_rate) if self.gradient_error is None else self.gradient_error


def _or_one(size: Scalar) -> Scalar:
    """Give a size that may be divided by: one for zero."""
    return jnp.where(size > 0.0, size, 1.0)


def length(vector: Vector) -> Scalar:
    """Euclidean norm, free of overflow, with a zero derivative at zero."""
    largest = jnp.max(jnp.abs(vector))
    unit = jax.lax.stop_gradient(_or_one(largest))
    square = jnp.sum((vector / unit) ** 2)
    return jnp.where(largest > 0.0, unit * jnp.sqrt(jnp.where(largest > 0.0, square, 1.0)), 0.0)


def row_length(program: VelocityProgram) -> Scalar:
    """‖n‖ + e, by which the barrier row is divided; one for an empty row."""
    error = 0.0 if program.gradient_error is None else program.gradient_error
    return _or_one(length(program.normal) + error)


def _largest_speed(program: VelocityProgram) -> Scalar:
    """Largest speed that the limits leave, m/s: what the program's velocities are measured in."""
    limits = [limit for limit in (program.speed, program.box) if limit is not None]
    size = limits[0] if len(limits) == 1 else jnp.minimum(*limits)
    if program.gradient_error is not None:
        # With e > ‖n‖ the barrier row holds only for speeds below α/(e − ‖n‖).
        excess = program.gradient_error - length(program.normal)
        narrow = (excess > 0.0) & (program.barrier_rate > 0.0)
        within = program.barrier_rate / jnp.where(narrow, excess, 1.0)
        size = jnp.where(narrow, jnp.minimum(size, jnp.maximum(within, _NARROWEST * size)), size)
    return _or_one(size)


def to_unit(program: VelocityProgram) -> UnitProgram:
    """Divide velocities by the largest speed and rows by their length, and pull rows that can never act close by.

    Neither changes the solution; both keep the interior point's numbers near one.
    """
    size = _largest_speed(program)
    row = row_length(program)
    circulation = None
    if program.circulation is not None:
        tangent, rate, weight = program.circulation.tangent, program.circulation.rate, program.circulation.weight
        tangent_length = length(tangent)
        unit = _or_one(tangent_length)
        rate = jnp.where(tangent_length > 0.0, rate / (unit * size), -_FAR)
        circulation = Circulation(tangent / unit, jnp.maximum(rate, -_FAR), weight * unit * unit)
    return UnitProgram(
        desired=program.desired / size,
        normal=program.normal / row,
        barrier_rate=jnp.clip(program.barrier_rate / (row * size), -1e6, _FAR),
        gradient_error=None if program.gradient_error is None else program.gradient_error / row,
        circulation=circulation,
        box=None if program.box is None else jnp.minimum(program.box / size, _FAR),
        speed=None if program.speed is None else jnp.minimum(program.speed / size, _FAR),
        size=size,
    )


def objective_slope(unit: UnitProgram) -> Scalar:
    """Return the objective's steepest slope; dividing by it keeps multipliers near one for far-off velocities."""
    slope = jnp.maximum(1.0, length(unit.desired))
    if unit.circulation is not None:
        slope = jnp.maximum(slope, 2.0 * unit.circulation.weight * jnp.maximum(unit.circulation.rate, 0.0))
    return slope


def escape_velocity(unit: UnitProgram) -> tuple[Scalar, Vector]:
    """Return the largest g = n · v − e ‖v‖ inside box and speed limit, and the velocity that reaches it.

    That velocity is the fastest way out.

    Closed form. For a given length the best velocity fills the components of largest |n_i| up to the box and shares
    the rest in proportion to n (water filling); so with k components at the box, the length is either free, where
    the row's slope vanishes, or at the speed limit. The program is feasible exactly if barrier_rate ≥ −g.
    """
    n, e, box, limit = unit.normal, unit.error, unit.box, unit.speed
    if box is None:
        assert limit is not None
        size = length(n)
        gain = limit * jnp.maximum(size - e, 0.0)
        return gain, jnp.where(gain > 0.0, limit * n / _or_one(size), 0.0)

    descending = -jnp.sort(-jnp.abs(n))
    multipliers = []
    for filled in range(4):
        remaining = jnp.sum(descending[filled:] ** 2)
        safe = _or_one(remaining)
        if limit is not None:
            budget = jnp.maximum(limit * limit - filled * box * box, 0.0)
            multipliers.append(jnp.where(remaining > 0.0, jnp.sqrt(_or_one(budget) / safe), 0.0))
        if filled:
            excess = e * e - remaining
            multipliers.append(jnp.where(excess > 0.0, jnp.sqrt(filled / _or_one(excess)) * box, 1e12))
    best, velocity = jnp.zeros_like(e), jnp.zeros_like(n)
    for multiplier in multipliers:
        candidate = jnp.clip(n * multiplier, -box, box)
        if limit is not None:
            candidate = candidate * jnp.minimum(1.0, limit / _or_one(length(candidate)))
        gain = jnp.sum(n * candidate) - e * length(candidate)
        better = gain > best
        best, velocity = jnp.where(better, gain, best), jnp.where(better, candidate, velocity)
    return best, velocity


def to_conic(unit: UnitProgram) -> ConicProgram:
    """Rows and cones for the interior point; the circulation slack w = −σ is a fourth unknown with its own row.

    Rows: circulation, then the barrier where it is a half-space. Cones: else the barrier, then the speed limit.
    """
    slope = objective_slope(unit)
    n = 3 if unit.circulation is None else 4
    quadratic, linear = jnp.ones(3), -unit.desired
    normal = jnp.pad(unit.normal, (0, n - 3))
    rows, offsets, cones, heads = [jnp.zeros((0, n))], [], [jnp.zeros((0, 4, n))], []
    if unit.circulation is not None:
        quadratic = jnp.append(quadratic, 2.0 * unit.circulation.weight)
        linear = jnp.append(linear, 0.0)
        rows.append(jnp.append(unit.circulation.tangent, 1.0)[None])
        offsets.append(-unit.circulation.rate)
    if unit.gradient_error is None:
        rows.append(normal[None])
        offsets.append(unit.barrier_rate)
    else:
        cones.append(jnp.concatenate([normal[None], unit.gradient_error * jnp.eye(3, n)])[None])
        heads.append(unit.barrier_rate)
    if unit.speed is not None:
        cones.append(jnp.eye(4, n, k=-1)[None])
        heads.append(unit.speed)
    return ConicProgram(
        quadratic=quadratic / slope,
        linear=linear / slope,
        rows=jnp.concatenate(rows),
        row_offsets=jnp.asarray(offsets, dtype=float),
        bounds=jnp.zeros(0) if unit.box is None else jnp.full(3, unit.box),
        cones=jnp.concatenate(cones),
        cone_offsets=jnp.asarray(heads, dtype=float).reshape(-1, 1) * jnp.asarray([1.0, 0.0, 0.0, 0.0]),
    )


class Active(NamedTuple):
    """Which rows hold with equality: barrier, speed cone, and for each component −1, 0 or 1 for the box."""

    barrier: Flag
    speed: Flag
    box: Vector


class Stationary(NamedTuple):
    """Velocity and the multipliers of the barrier row and the speed cone; or a change of them."""

    velocity: Vector
    barrier: Scalar
    speed: Scalar


class _Equations(NamedTuple):
    """Values of the equations' left-hand sides; or a change of them."""

    stationarity: Vector
    barrier: Scalar
    speed: Scalar


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
    return Active(touching[0], speed, box), Stationary(point[:3], values[0], speed_value)


def _shortfall(unit: UnitProgram, velocity: Vector) -> Scalar:
    assert unit.circulation is not None
    return jnp.maximum(unit.circulation.rate - jnp.sum(unit.circulation.tangent * velocity), 0.0)


def _direction(velocity: Vector) -> tuple[Vector, Scalar]:
    speed = length(velocity)
    return velocity / _or_one(speed), speed


def _residuals(unit: UnitProgram, active: Active, at: Stationary) -> tuple[_Equations, Vector]:
    """Return the equations' values, and the stationarity residual before held components were taken out."""
    v = at.velocity
    direction, speed = _direction(v)
    force = v - unit.desired - at.barrier * (unit.normal - unit.error * direction) + at.speed * v
    if unit.circulation is not None:
        force = force - 2.0 * unit.circulation.weight * _shortfall(unit, v) * unit.circulation.tangent
    stationarity = force
    if unit.box is not None:
        stationarity = jnp.where(active.box != 0.0, v - active.box * unit.box, force)
    barrier = jnp.sum(unit.normal * v) - unit.error * speed + unit.barrier_rate
    limit = jnp.zeros_like(speed) if unit.speed is None else 0.5 * (jnp.sum(v * v) - unit.speed**2)
    return _Equations(stationarity, barrier, limit), force


def _correction(
    unit: UnitProgram, active: Active, at: Stationary, values: _Equations, *, apart: bool = False
) -> Stationary:
    """Return the change of (v, λ_b, λ_s) that cancels `values` to first order, inactive rows left out.

    `apart` keeps what depends on `values` in arrays of its own: JAX then sees that the answer is linear in them, which
    a derivative taken backwards needs. Else three columns are one array, and one operation serves all of them.
    """
    v = at.velocity
    direction, speed = _direction(v)
    curvature = at.barrier * unit.error / _or_one(speed)
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
    # A point far outside the box says nothing about the other two rows.
    inside = ~jnp.any(beyond)
    barrier, speed = barrier | (barrier_broken & inside), speed | (speed_broken & inside)
    if unit.box is not None:
        # At a corner of the box nothing can move: a further row takes the place of the face that holds least.
        cornered = jnp.all(box != 0.0) & (barrier | speed)
        box = jnp.where(cornered & (jnp.abs(force) <= jnp.min(jnp.abs(force))), 0.0, box)
    chosen = Active(barrier, speed, box)
    again = Stationary(at.velocity, jnp.where(barrier, at.barrier, 0.0), jnp.where(speed, at.speed, 0.0))
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
    if unit.box is not None and change.box is not None:
        force = jnp.where(active.box != 0.0, -active.box * change.box, force)
    barrier = jnp.sum(change.normal * v) - change.error * speed + change.barrier_rate
    limit = jnp.zeros_like(speed)
    if unit.speed is not None and change.speed is not None:
        limit = -unit.speed * change.speed
    return _correction(unit, active, at, _Equations(force, barrier, limit), apart=apart).velocity


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
    return (spread <= 0.0) | ((along <= 0.0) & (along * along >= jnp.sum(pull**2) * spread))


def _iterate(unit: UnitProgram, easy: Flag) -> tuple[Active, Stationary, Flag, Int[Array, ""]]:
    """Interior point and polish. Where a closed form answers (`easy`) they work on a program that they can finish."""
    tame = unit._replace(barrier_rate=jnp.where(easy, 3.0, unit.barrier_rate))
    iterate = interior_point(to_conic(tame))
    return *polish(tame, *identify(tame, iterate)), iterate.iterations


def _project(unit: UnitProgram) -> tuple[Active, Stationary, Flag, Int[Array, ""]]:
    """Project onto a half-space and a ball, in closed form: onto the ball, else the plane, else their circle."""
    assert unit.speed is not None
    n, desired, rate, limit = unit.normal, unit.desired, unit.barrier_rate, unit.speed
    square = jnp.sum(n * n)
    square = _or_one(square)
    speed = length(desired)
    in_ball = desired * jnp.minimum(1.0, limit / _or_one(speed))
    along = jnp.sum(n * desired)
    on_plane = desired - (along + rate) / square * n
    foot = -rate / square * n
    tangent = desired - along / square * n
    spread = length(tangent)
    radius = jnp.sqrt(jnp.maximum(limit * limit - jnp.sum(foot * foot), 0.0))
    on_circle = foot + radius * tangent / _or_one(spread)
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
    gain, escape = escape_velocity(unit)
    room = unit.barrier_rate + gain
    escaping = room <= _EDGE
    resting = (jnp.abs(unit.barrier_rate) <= _AT_APEX) & (unit.error > 0.0) & _rest_is_optimal(unit)
    easy = escaping | resting
    simple = program.gradient_error is None and program.circulation is None and program.box is None
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
    (_, _), (_, escape_change) = jax.jvp(escape_velocity, (unit,), (change,))
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
    room = outcome.room * to_unit(data).size * row_length(data)
    velocity = (_velocity_forward if forward else _velocity)(program, outcome)
    return ConeSolution(velocity, outcome.status, room, outcome.iterations)

"""The velocity program: what is asked, its units taken out, and how fast it can be left where it cannot be met."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from keepout.core.control.interior_point import ConicProgram
from keepout.core.errors import ControlError
from keepout.core.motion.arrays import Scalar, Vector

_FAR = 3.0  # more than √3, the largest speed inside the unit box: a row beyond it never acts
_NARROWEST = 1e-8


class Circulation(eqx.Module):
    """The relaxed circulation inequality tangent · v − rate ≥ σ with penalty weight · σ² (paper Eq. cbf_socp_CI).

    `tangent` (3,) is T = Ω ∇f̃, `rate` is Υ(h) in m/s, `weight` is p.
    """

    tangent: Vector
    rate: Scalar
    weight: Scalar


class HalfSpaces(eqx.Module):
    """The rows normals · v + rates ≥ 0: the barrier condition of each further thing to stay clear of.

    `normals` (rows, 3) are the gradients of exact distances, `rates` (rows,) α of their barriers, m/s; a row that is
    never to act has a large finite rate.
    """

    normals: Float[Array, "rows 3"]
    rates: Float[Array, "rows"]


class VelocityProgram(eqx.Module):
    """Minimise ½‖desired − v‖² + p σ² over the safe velocities v with a speed cone beside the box.

    Paper Eq. cbf_socp_CI.

    The constraints are normal · v + barrier_rate ≥ gradient_error ‖v‖; tangent · v − rate ≥ σ where `circulation` is
    given; |v_i| ≤ box where given; ‖v‖ ≤ speed where given. A constraint that is absent (None) has no row, and
    without `gradient_error` (e_∇h) the barrier row is a half-space. At least one of box and
    speed must be given. Velocities in m/s; `normal` is ∇f̃, `barrier_rate` is α(h) in m/s. `half_spaces` are barrier
    rows of further things.

    Raises `ControlError` if neither box nor speed is given.
    """

    desired: Vector
    normal: Vector
    barrier_rate: Scalar
    gradient_error: Scalar | None = None
    circulation: Circulation | None = None
    box: Scalar | None = None
    speed: Scalar | None = None
    half_spaces: HalfSpaces | None = None

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
    half_spaces: HalfSpaces | None
    size: Scalar

    @property
    def error(self) -> Scalar:
        """The gradient error e, zero where the barrier row is a half-space."""
        return jnp.zeros_like(self.barrier_rate) if self.gradient_error is None else self.gradient_error


def or_one(size: Float[Array, "*rows"]) -> Float[Array, "*rows"]:
    """Give a size that may be divided by: one for zero."""
    return jnp.where(size > 0.0, size, 1.0)


def length(vector: Vector) -> Scalar:
    """Euclidean norm, free of overflow, with a zero derivative at zero."""
    largest = jnp.max(jnp.abs(vector))
    unit = jax.lax.stop_gradient(or_one(largest))
    square = jnp.sum((vector / unit) ** 2)
    return jnp.where(largest > 0.0, unit * jnp.sqrt(jnp.where(largest > 0.0, square, 1.0)), 0.0)


def row_length(program: VelocityProgram) -> Scalar:
    """‖n‖ + e, by which the barrier row is divided; one for an empty row."""
    error = 0.0 if program.gradient_error is None else program.gradient_error
    return or_one(length(program.normal) + error)


def row_lengths(half_spaces: HalfSpaces) -> Float[Array, "rows"]:
    """Give the lengths by which half-spaces are divided."""
    return or_one(jax.vmap(length)(half_spaces.normals))


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
    return or_one(size)


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
        unit = or_one(tangent_length)
        rate = jnp.where(tangent_length > 0.0, rate / (unit * size), -_FAR)
        circulation = Circulation(tangent / unit, jnp.maximum(rate, -_FAR), weight * unit * unit)
    half_spaces = None
    if program.half_spaces is not None:
        normals, lengths = program.half_spaces.normals, row_lengths(program.half_spaces)
        rates = jnp.clip(program.half_spaces.rates / (lengths * size), -1e6, _FAR)
        half_spaces = HalfSpaces(normals / lengths[:, None], rates)
    return UnitProgram(
        desired=program.desired / size,
        normal=program.normal / row,
        barrier_rate=jnp.clip(program.barrier_rate / (row * size), -1e6, _FAR),
        gradient_error=None if program.gradient_error is None else program.gradient_error / row,
        circulation=circulation,
        box=None if program.box is None else jnp.minimum(program.box / size, _FAR),
        speed=None if program.speed is None else jnp.minimum(program.speed / size, _FAR),
        half_spaces=half_spaces,
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
        return gain, jnp.where(gain > 0.0, limit * n / or_one(size), 0.0)

    descending = -jnp.sort(-jnp.abs(n))
    multipliers = []
    for filled in range(4):
        remaining = jnp.sum(descending[filled:] ** 2)
        safe = or_one(remaining)
        if limit is not None:
            budget = jnp.maximum(limit * limit - filled * box * box, 0.0)
            multipliers.append(jnp.where(remaining > 0.0, jnp.sqrt(or_one(budget) / safe), 0.0))
        if filled:
            excess = e * e - remaining
            multipliers.append(jnp.where(excess > 0.0, jnp.sqrt(filled / or_one(excess)) * box, 1e12))
    best, velocity = jnp.zeros_like(e), jnp.zeros_like(n)
    for multiplier in multipliers:
        candidate = jnp.clip(n * multiplier, -box, box)
        if limit is not None:
            candidate = candidate * jnp.minimum(1.0, limit / or_one(length(candidate)))
        gain = jnp.sum(n * candidate) - e * length(candidate)
        better = gain > best
        best, velocity = jnp.where(better, gain, best), jnp.where(better, candidate, velocity)
    return best, velocity


def nearest_row(unit: UnitProgram) -> tuple[Int[Array, ""], UnitProgram]:
    """Give the barrier row of the least rate, 0 the first, and the program with that row alone."""
    if unit.half_spaces is None:
        return jnp.zeros((), jnp.int32), unit
    rates = jnp.append(unit.barrier_rate, unit.half_spaces.rates)
    normals = jnp.concatenate([unit.normal[None], unit.half_spaces.normals])
    row = jnp.argmin(rates).astype(jnp.int32)
    error = None if unit.gradient_error is None else jnp.where(row == 0, unit.gradient_error, 0.0)
    alone = unit._replace(normal=normals[row], barrier_rate=rates[row], gradient_error=error, half_spaces=None)
    return row, alone


def passable(unit: UnitProgram) -> UnitProgram:
    """Relax all barrier rows but the nearest, so that the program is feasible exactly if that row alone can be met.

    Where every rate is at least zero rest is feasible, and nothing is relaxed. Inside of something, where a rate is
    negative, some velocity must lead out of what is nearest; here the one that leads out twice as fast as it must,
    straight where the limits leave that. Another row that forbids it is relaxed until it allows it, no more. So a row
    is changed by little where the chaser is inside by little, and nothing jumps.
    """
    if unit.half_spaces is None:
        return unit
    nearest, alone = nearest_row(unit)
    gain, escape = escape_velocity(alone)
    n, missing, size = alone.normal, jnp.maximum(-alone.barrier_rate, 0.0), length(alone.normal)
    steep = jnp.maximum(size - alone.error, 0.0)
    straight = n * (2.0 * missing / (or_one(size) * or_one(steep)))
    fits = steep > 0.0
    if unit.box is not None:
        fits = jnp.all(jnp.abs(straight) <= unit.box)
    if unit.speed is not None:
        fits = fits & (length(straight) <= unit.speed)
    way = jnp.where(fits, straight, jnp.minimum(2.0 * missing / or_one(gain), 1.0) * escape)
    first = jnp.maximum(unit.barrier_rate, unit.error * length(way) - jnp.sum(unit.normal * way))
    normals, rates = unit.half_spaces.normals, unit.half_spaces.rates
    others = jnp.maximum(rates, -jnp.sum(normals * way, axis=-1))
    kept = nearest == jnp.arange(len(rates) + 1)
    return unit._replace(
        barrier_rate=jnp.where(kept[0], unit.barrier_rate, first),
        half_spaces=HalfSpaces(normals, jnp.where(kept[1:], rates, others)),
    )


def to_conic(unit: UnitProgram) -> ConicProgram:
    """Rows and cones for the interior point; the circulation slack w = −σ is a fourth unknown with its own row.

    Rows: circulation, then the barrier where it is a half-space, then the half-spaces. Cones: else the barrier, then
    the speed limit.
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
    if unit.half_spaces is not None:
        rows.append(jnp.pad(unit.half_spaces.normals, ((0, 0), (0, n - 3))))
        offsets.extend(unit.half_spaces.rates)
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

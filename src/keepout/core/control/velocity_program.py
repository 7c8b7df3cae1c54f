"""The velocity program as data: what is asked, its units taken out, and whether it can be met at all."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.errors import ControlError

_FAR = 3.0  # more than √3, the largest speed inside the unit box: a row beyond it never acts
_NARROWEST = 1e-8


class Circulation(eqx.Module):
    """The relaxed circulation inequality tangent · v − rate ≥ σ with penalty weight · σ² (paper Eq. cbf_socp_CI).

    `tangent` (3,) is T = Ω ∇f̃, `rate` is Υ(h) in m/s, `weight` is p.
    """

    tangent: Float[Array, "3"]
    rate: Float[Array, ""]
    weight: Float[Array, ""]


class VelocityProgram(eqx.Module):
    """Minimise ½‖desired − v‖² + p σ² over the safe velocities v with a speed cone beside the box.

    Paper Eq. cbf_socp_CI.

    The constraints are normal · v + barrier_rate ≥ gradient_error ‖v‖; tangent · v − rate ≥ σ where `circulation` is
    given; |v_i| ≤ box where given; ‖v‖ ≤ speed where given. A constraint that is absent (None) has no row, and
    without `gradient_error` (e_∇h) the barrier row is a half-space. At least one of box and
    speed must be given. Velocities in m/s; `normal` is ∇f̃, `barrier_rate` is α(h) in m/s.

    Raises `ControlError` if neither box nor speed is given.
    """

    desired: Float[Array, "3"]
    normal: Float[Array, "3"]
    barrier_rate: Float[Array, ""]
    gradient_error: Float[Array, ""] | None = None
    circulation: Circulation | None = None
    box: Float[Array, ""] | None = None
    speed: Float[Array, ""] | None = None

    def __check_init__(self) -> None:
        if self.box is None and self.speed is None:
            raise ControlError("velocity program: neither a box nor a speed limit is given; give at least one, in m/s")


class UnitProgram(NamedTuple):
    """The program with velocities in units of `size`, a speed in m/s, and every row divided by its length."""

    desired: Float[Array, "3"]
    normal: Float[Array, "3"]
    barrier_rate: Float[Array, ""]
    gradient_error: Float[Array, ""] | None
    circulation: Circulation | None
    box: Float[Array, ""] | None
    speed: Float[Array, ""] | None
    size: Float[Array, ""]

    @property
    def error(self) -> Float[Array, ""]:
        """The gradient error e, zero where the barrier row is a half-space."""
        return jnp.zeros_like(self.barrier_rate) if self.gradient_error is None else self.gradient_error


def _length_or_one(length: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(length > 0.0, length, 1.0)


def length(vector: Float[Array, "3"]) -> Float[Array, ""]:
    """Euclidean norm, free of overflow, with a zero derivative at zero."""
    largest = jnp.max(jnp.abs(vector))
    unit = jax.lax.stop_gradient(_length_or_one(largest))
    square = jnp.sum((vector / unit) ** 2)
    return jnp.where(largest > 0.0, unit * jnp.sqrt(jnp.where(largest > 0.0, square, 1.0)), 0.0)


def row_length(program: VelocityProgram) -> Float[Array, ""]:
    """‖n‖ + e, by which the barrier row is divided; one for an empty row."""
    error = 0.0 if program.gradient_error is None else program.gradient_error
    return _length_or_one(length(program.normal) + error)


def _largest_speed(program: VelocityProgram) -> Float[Array, ""]:
    """Largest speed that the limits leave, m/s: what the program's velocities are measured in."""
    limits = [limit for limit in (program.speed, program.box) if limit is not None]
    size = limits[0] if len(limits) == 1 else jnp.minimum(*limits)
    if program.gradient_error is not None:
        # With e > ‖n‖ the barrier row holds only for speeds below α/(e − ‖n‖).
        excess = program.gradient_error - length(program.normal)
        narrow = (excess > 0.0) & (program.barrier_rate > 0.0)
        within = program.barrier_rate / jnp.where(narrow, excess, 1.0)
        size = jnp.where(narrow, jnp.minimum(size, jnp.maximum(within, _NARROWEST * size)), size)
    return _length_or_one(size)


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
        unit = _length_or_one(tangent_length)
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


def objective_slope(unit: UnitProgram) -> Float[Array, ""]:
    """Return the objective's steepest slope; dividing by it keeps multipliers near one for far-off velocities."""
    slope = jnp.maximum(1.0, length(unit.desired))
    if unit.circulation is not None:
        slope = jnp.maximum(slope, 2.0 * unit.circulation.weight * jnp.maximum(unit.circulation.rate, 0.0))
    return slope


def escape_velocity(unit: UnitProgram) -> tuple[Float[Array, ""], Float[Array, "3"]]:
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
        return gain, jnp.where(gain > 0.0, limit * n / _length_or_one(size), 0.0)

    descending = -jnp.sort(-jnp.abs(n))
    multipliers = []
    for filled in range(4):
        remaining = jnp.sum(descending[filled:] ** 2)
        safe = _length_or_one(remaining)
        if limit is not None:
            budget = jnp.maximum(limit * limit - filled * box * box, 0.0)
            multipliers.append(jnp.where(remaining > 0.0, jnp.sqrt(_length_or_one(budget) / safe), 0.0))
        if filled:
            excess = e * e - remaining
            multipliers.append(jnp.where(excess > 0.0, jnp.sqrt(filled / _length_or_one(excess)) * box, 1e12))
    best, velocity = jnp.zeros_like(e), jnp.zeros_like(n)
    for multiplier in multipliers:
        candidate = jnp.clip(n * multiplier, -box, box)
        if limit is not None:
            candidate = candidate * jnp.minimum(1.0, limit / _length_or_one(length(candidate)))
        gain = jnp.sum(n * candidate) - e * length(candidate)
        better = gain > best
        best, velocity = jnp.where(better, gain, best), jnp.where(better, candidate, velocity)
    return best, velocity

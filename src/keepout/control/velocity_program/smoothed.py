"""The velocity program with a logarithmic barrier of finite weight: a solution whose Jacobian is continuous.

v_s of the plain program is continuous, but its Jacobian jumps where the active set changes, and backstepping assumes
that it does not. Here every constraint is replaced by −τ log(slack) (−½τ log of the cone's determinant) in the
objective: the minimiser is smooth, strictly inside, and tends to the plain solution with τ → 0 (Boyd & Vandenberghe,
section 11.2).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from keepout.control.velocity_program import interior_point
from keepout.control.velocity_program.cone import ConeSolution, ConeStatus, status_of
from keepout.control.velocity_program.interior_point import ConicProgram, back_substitute, factor
from keepout.control.velocity_program.program import (
    UnitProgram,
    VelocityProgram,
    escape_velocity,
    objective_slope,
    row_length,
    to_conic,
    to_unit,
)

_EDGE = 1e-9
_OPTIMAL = 1e-5
"""Newton decrement of objective/τ, self-concordant: every slack is then known to about this share of itself."""
_POLISH_STEPS = 24


class _Point(NamedTuple):
    unknowns: Float[Array, " n"]
    velocity: Float[Array, "3"]
    escaping: Bool[Array, ""]
    status: Int[Array, ""]
    room: Float[Array, ""]
    iterations: Int[Array, ""]


def _slacks(conic: ConicProgram, x: Float[Array, " n"]) -> tuple[Array, Array, Array, Array]:
    """Return the slacks of the rows, of x ≤ bounds and −x ≤ bounds, and of the cones (four entries each) at x."""
    held = x[: conic.bounds.shape[0]]
    return (
        conic.row_offsets + jnp.sum(conic.rows * x, axis=-1),
        conic.bounds - held,
        conic.bounds + held,
        conic.cone_offsets + jnp.sum(conic.cones * x, axis=-1),
    )


def _least_slack(conic: ConicProgram, x: Float[Array, " n"]) -> Float[Array, ""]:
    *lines, cones = _slacks(conic, x)
    inside = cones[:, 0] - jnp.sqrt(jnp.sum(cones[:, 1:] ** 2, axis=-1))
    return jnp.min(jnp.concatenate([*lines, inside]))


def _gradient(conic: ConicProgram, weight: Float[Array, ""], x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the gradient of objective plus barrier at x."""
    rows, below, above, cones = _slacks(conic, x)
    determinant = cones[:, 0] ** 2 - jnp.sum(cones[:, 1:] ** 2, axis=-1)
    mirrored = cones * jnp.asarray([1.0, -1.0, -1.0, -1.0]) / determinant[:, None]
    force = jnp.sum(conic.rows / rows[:, None], axis=0) + jnp.sum(conic.cones * mirrored[:, :, None], axis=(0, 1))
    force = force + jnp.pad(1.0 / above - 1.0 / below, (0, x.size - below.size))
    return conic.quadratic * x + conic.linear - weight * force


def _scaled_weight(unit: UnitProgram, weight: Float[Array, ""]) -> Float[Array, ""]:
    return weight / (unit.size**2 * objective_slope(unit))


def _solve(program: VelocityProgram, weight: Float[Array, ""]) -> _Point:
    unit = to_unit(program)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves((program, weight))]))
    unit = jax.tree.map(lambda x: jnp.where(finite, x, 1.0), unit)
    gain, escape = escape_velocity(unit)
    room = unit.barrier_rate + gain
    escaping = room <= _EDGE
    conic = to_conic(unit._replace(barrier_rate=jnp.where(escaping, 3.0, unit.barrier_rate)))
    tau = jnp.where(finite, _scaled_weight(unit, weight), 1.0)
    iterate = interior_point.solve(conic, complementarity=tau)
    x = iterate.point

    def newton(_: int | Int[Array, ""], at: tuple[Array, Array]) -> tuple[Array, Array]:
        x, _ = at
        gradient = _gradient(conic, tau, x)
        step = back_substitute(factor(jax.jacfwd(lambda y: _gradient(conic, tau, y))(x)), gradient)
        # Objective over τ is self-concordant: this damping keeps every step inside (Boyd & Vandenberghe, section 9.6).
        decrement = jnp.sqrt(jnp.maximum(jnp.sum(step * gradient), 0.0) / tau)
        return x - jnp.where(decrement > 0.25, 1.0 / (1.0 + decrement), 1.0) * step, decrement

    x, decrement = jax.lax.fori_loop(0, _POLISH_STEPS, newton, (x, jnp.asarray(jnp.inf)))
    good = (_least_slack(conic, x) > 0.0) & (decrement <= _OPTIMAL)
    x = jnp.where(good, x, iterate.point)
    velocity = jnp.where(finite, jnp.where(escaping, escape, x[:3]), 0.0)
    status = status_of(solved=good | escaping, room=room, gain=gain, finite=finite)
    return _Point(x, velocity, escaping, status, room, iterate.iterations)


@jax.custom_jvp
def _velocity(program: VelocityProgram, weight: Float[Array, ""], point: _Point) -> Float[Array, "3"]:
    """Return the solution in m/s."""
    return to_unit(program).size * point.velocity


@_velocity.defjvp
def _velocity_jvp(primals: tuple, tangents: tuple) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    program, weight, point = primals

    def gradient(data: VelocityProgram, tau: Float[Array, ""], x: Float[Array, " n"]) -> Float[Array, " n"]:
        unit = to_unit(data)
        unit = unit._replace(barrier_rate=jnp.where(point.escaping, 3.0, unit.barrier_rate))
        return _gradient(to_conic(unit), _scaled_weight(unit, tau), x)

    unit, change = jax.jvp(to_unit, (program,), (tangents[0],))
    (_, _), (_, escape_change) = jax.jvp(escape_velocity, (unit,), (change,))
    _, moved = jax.jvp(lambda p, w: gradient(p, w, point.unknowns), (program, weight), (tangents[0], tangents[1]))
    hessian = jax.jacfwd(lambda x: gradient(program, weight, x))(point.unknowns)
    inside = -back_substitute(factor(hessian), moved)[:3]
    derivative = jnp.where(point.escaping, escape_change, inside)
    derivative = unit.size * derivative + change.size * point.velocity
    return _velocity(program, weight, point), jnp.where(point.status == ConeStatus.NOT_FINITE, 0.0, derivative)


def solve_smoothed(program: VelocityProgram, weight: Float[Array, ""]) -> ConeSolution:
    """Solve the program with every constraint replaced by a logarithmic barrier of weight τ (m²/s², positive).

    Same answer and conventions as `cone.solve`, and the Jacobian is continuous wherever the program is strictly
    feasible and the circulation's tangent is not zero (there its row vanishes). At a constraint the solution keeps a
    distance of about τ over the multiplier.
    """
    data = jax.lax.stop_gradient((program, weight))
    point = jax.lax.stop_gradient(_solve(*data))
    room = point.room * to_unit(data[0]).size * row_length(data[0])
    return ConeSolution(_velocity(program, weight, point), point.status, room, point.iterations)

"""A primal-dual interior point for tiny cone programs, many at a time.

Nesterov-Todd scaling and Mehrotra's predictor-corrector as in Vandenberghe, "The CVXOPT linear and quadratic cone
program solvers" (2010), sections 4 to 7. At three or four unknowns a matrix call costs more than the arithmetic, so
products are written out as elementwise multiplications and sums, and **the axis of programs is the last one**: every
operation then runs along consecutive numbers. `jax.vmap` of `solve` leads there by itself.

The program is  minimise ½ xᵀ diag(quadratic) x + linearᵀ x  over x, with  row_offsets + rows x ≥ 0,  |x_i| ≤ bounds_i
for the first unknowns, and  cone_offsets + cones x  in second-order cones of four entries (head first).
"""

import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from keepout.core.control.velocity_program import (
    UnitProgram,
    VelocityProgram,
    escape_velocity,
    length,
    objective_slope,
    row_length,
    to_unit,
)

MAXIMUM_ITERATIONS = 18
CHUNK = 128
"""Programs solved together on a CPU: their iterates stay in cache."""
_RESIDUAL = 1e-6
_GAP = 1e-9
_LOWEST_LEVEL = 1e-11
_CENTRING_FLOOR = 1e-3
_TINY = 1e-300
_MIRROR = np.array([1.0, -1.0, -1.0, -1.0])[:, None]
_APEX = np.array([1.0, 0.0, 0.0, 0.0])[:, None]


class ConicProgram(NamedTuple):
    """The data of one program with n unknowns, l half-lines, m bounds and k second-order cones."""

    quadratic: Float[Array, " n"]
    linear: Float[Array, " n"]
    rows: Float[Array, "l n"]
    row_offsets: Float[Array, " l"]
    bounds: Float[Array, " m"]
    cones: Float[Array, "k 4 n"]
    cone_offsets: Float[Array, "k 4"]


class Iterate(NamedTuple):
    """Point, slacks and multipliers: of the lines (rows, then x ≤ bounds, then −x ≤ bounds) and of the cones."""

    point: Float[Array, " n"]
    row_slacks: Float[Array, " lines"]
    row_multipliers: Float[Array, " lines"]
    cone_slacks: Float[Array, "k 4"]
    cone_multipliers: Float[Array, "k 4"]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


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


class _Step(NamedTuple):
    """Changes of the entries of an `Iterate`. Here and below every array has a last axis of programs, b."""

    point: Float[Array, "n b"]
    row_slacks: Float[Array, "lines b"]
    row_multipliers: Float[Array, "lines b"]
    cone_slacks: Float[Array, "k 4 b"]
    cone_multipliers: Float[Array, "k 4 b"]


class _Scaling(NamedTuple):
    """Nesterov-Todd scaling of the cones: W = beta (2 v vᵀ − J), W² = beta² (2 w wᵀ − J), scaled = W z = W⁻¹ s."""

    beta: Float[Array, "k 1 b"]
    v: Float[Array, "k 4 b"]
    w: Float[Array, "k 4 b"]
    scaled: Float[Array, "k 4 b"]


def _reflect(x: Float[Array, "k 4 b"]) -> Float[Array, "k 4 b"]:
    """J x: the tail's sign changed."""
    return x * _MIRROR


def _dot(a: Float[Array, "k i b"], b: Float[Array, "k i b"]) -> Float[Array, "k 1 b"]:
    return jnp.sum(a * b, axis=1, keepdims=True)


def _join(head: Float[Array, "k 1 b"], tail: Float[Array, "k 3 b"]) -> Float[Array, "k 4 b"]:
    return jnp.concatenate([head, tail], axis=1)


def _size(x: Float[Array, "k 4 b"]) -> Float[Array, "k 1 b"]:
    """√(xᵀ J x), from the two factors head ± ‖tail‖ so that no digits cancel near the boundary."""
    tail = jnp.sqrt(_dot(x[:, 1:], x[:, 1:]))
    return jnp.sqrt(jnp.maximum((x[:, :1] - tail) * (x[:, :1] + tail), _TINY))


def _jordan_product(a: Float[Array, "k 4 b"], b: Float[Array, "k 4 b"]) -> Float[Array, "k 4 b"]:
    return _join(_dot(a, b), a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:])


def _jordan_divide(a: Float[Array, "k 4 b"], b: Float[Array, "k 4 b"]) -> Float[Array, "k 4 b"]:
    """Return the u with a ∘ u = b."""
    head = _dot(_reflect(a), b) / _size(a) ** 2
    return _join(head, (b[:, 1:] - head * a[:, 1:]) / a[:, :1])


def _nesterov_todd(slack: Float[Array, "k 4 b"], multiplier: Float[Array, "k 4 b"]) -> _Scaling:
    slack_size, multiplier_size = _size(slack), _size(multiplier)
    s, z = slack / slack_size, multiplier / multiplier_size
    w = (s + _reflect(z)) / (2.0 * jnp.sqrt((1.0 + _dot(s, z)) / 2.0))
    v = (w + _APEX) / jnp.sqrt(2.0 * (w[:, :1] + 1.0))
    beta = jnp.sqrt(slack_size / multiplier_size)
    return _Scaling(beta, v, w, beta * (2.0 * v * _dot(v, multiplier) - _reflect(multiplier)))


def _scale(scaling: _Scaling, x: Float[Array, "k 4 b"]) -> Float[Array, "k 4 b"]:
    return scaling.beta * (2.0 * scaling.v * _dot(scaling.v, x) - _reflect(x))


def _unscale(scaling: _Scaling, x: Float[Array, "k 4 b"]) -> Float[Array, "k 4 b"]:
    mirrored = _reflect(scaling.v)
    return (2.0 * mirrored * _dot(mirrored, x) - _reflect(x)) / scaling.beta


def _cone_room(point: Float[Array, "k 4 b"], direction: Float[Array, "k 4 b"]) -> Float[Array, "k b"]:
    """Inverse of the largest step that keeps `point + step · direction` in the cones (scaled coordinates)."""
    size = _size(point)
    p = point / size
    head = _dot(_reflect(p), direction)
    tail = direction[:, 1:] - (head + direction[:, :1]) / (p[:, :1] + 1.0) * p[:, 1:]
    return ((jnp.sqrt(_dot(tail, tail)) - head) / size)[:, 0]


class _Linear:
    """The products of the constraints' matrix G (rows, both signs of the bounds, cones) that the method needs."""

    def __init__(self, program: ConicProgram):
        self.rows, self.cones = program.rows, program.cones
        self.bounded, self.unknowns = program.bounds.shape[0], program.linear.shape[0]
        # Gᵀ J G of each cone, which no iteration changes.
        signs = _MIRROR[:, :, None, None]
        self.form = jnp.sum(signs * self.cones[:, :, :, None] * self.cones[:, :, None, :], axis=1)

    def of_rows(self, x: Float[Array, "n b"]) -> Float[Array, "lines b"]:
        held = x[: self.bounded]
        return jnp.concatenate([jnp.sum(self.rows * x, axis=1), -held, held])

    def of_cones(self, x: Float[Array, "n b"]) -> Float[Array, "k 4 b"]:
        return jnp.sum(self.cones * x, axis=2)

    def _spread(self, upper: Float[Array, "m b"]) -> Float[Array, "n b"]:
        return jnp.pad(upper, ((0, self.unknowns - self.bounded), (0, 0)))

    def _split(self, values: Float[Array, "lines b"]) -> tuple[Array, Array, Array]:
        first = self.rows.shape[0]
        second = first + self.bounded
        return values[:first], values[first:second], values[second:]

    def transposed(self, row_part: Float[Array, "lines b"], cone_part: Float[Array, "k 4 b"]) -> Float[Array, "n b"]:
        rows, upper, lower = self._split(row_part)
        result = jnp.sum(self.rows * rows[:, None], axis=0) + jnp.sum(self.cones * cone_part[:, :, None], axis=(0, 1))
        return result + self._spread(lower - upper)

    def newton_matrix(
        self, quadratic: Float[Array, "n b"], weights: Float[Array, "lines b"], scaling: _Scaling
    ) -> Float[Array, "n n b"]:
        """diag(quadratic) + Gᵀ W⁻² G, with W⁻² = beta⁻² (2 (Jw)(Jw)ᵀ − J)."""
        rows, upper, lower = self._split(weights)
        diagonal = jnp.eye(self.unknowns)[:, :, None] * (quadratic + self._spread(upper + lower))
        matrix = diagonal + jnp.sum(rows[:, None, None] * self.rows[:, :, None] * self.rows[:, None, :], axis=0)
        y = jnp.sum(_reflect(scaling.w)[:, :, None] * self.cones, axis=1)
        cones = (2.0 * y[:, :, None] * y[:, None, :] - self.form) / scaling.beta[:, :, None] ** 2
        return matrix + jnp.sum(cones, axis=0)


def factor(matrix: Float[Array, "n n *b"]) -> tuple[list[list[Array]], list[Array]]:
    """Factor small symmetric positive definite matrices as L D Lᵀ; returns the rows of L below its diagonal, and D."""
    lower: list[list[Array]] = []
    pivots: list[Array] = []
    for i in range(matrix.shape[0]):
        row: list[Array] = []
        for j in range(i):
            row.append((matrix[i, j] - sum(row[k] * lower[j][k] * pivots[k] for k in range(j))) / pivots[j])
        pivot = matrix[i, i] - sum(row[k] * row[k] * pivots[k] for k in range(i))
        lower.append(row)
        pivots.append(jnp.where(jnp.abs(pivot) > _TINY, pivot, _TINY))
    return lower, pivots


def back_substitute(factors: tuple[list[list[Array]], list[Array]], rhs: Float[Array, "n *b"]) -> Float[Array, "n *b"]:
    """Solve L D Lᵀ x = rhs."""
    lower, pivots = factors
    n = len(pivots)
    x = [rhs[i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - lower[i][k] * x[k]
    x = [value / pivot for value, pivot in zip(x, pivots, strict=True)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - lower[k][i] * x[k]
    return jnp.stack(x)


def interior_point(program: ConicProgram) -> Iterate:
    """Solve the program.

    Infeasible start, predictor-corrector steps, a floor under the centring parameter, and a fraction of the step to the
    boundary that tends to one with the affine step. Returns the last iterate; `converged` says whether residuals and
    gap came below tolerance within `MAXIMUM_ITERATIONS`.
    """
    return _each(_solve_many(_each(program, lambda x: x[None])), lambda x: x[0])


@jax.custom_batching.custom_vmap
def _solve_many(programs: ConicProgram) -> Iterate:
    """Solve programs along a first axis, on a CPU in chunks."""
    count = programs.linear.shape[0]
    if count <= 2 * CHUNK or jax.default_backend() != "cpu":
        return _first_axis(_solve_chunk(_last_axis(programs)))
    chunks = -(-count // CHUNK)
    index = np.minimum(np.arange(chunks * CHUNK), count - 1).reshape(chunks, CHUNK)
    answers = jax.lax.map(
        lambda chunk: _first_axis(_solve_chunk(_last_axis(chunk))), _each(programs, lambda x: x[index])
    )
    return _each(answers, lambda x: x.reshape(chunks * CHUNK, *x.shape[2:])[:count])


@_solve_many.def_vmap
def _merge_axes(axis_size: int, batched: PyTree, programs: ConicProgram) -> tuple[Iterate, PyTree]:
    """Let a further axis of programs join the first."""

    def merge(x: Array, has_axis: bool) -> Array:
        whole = x if has_axis else jnp.broadcast_to(x, (axis_size, *x.shape))
        return whole.reshape(axis_size * whole.shape[1], *whole.shape[2:])

    answers = _solve_many(jax.tree.map(merge, programs, batched[0]))
    answers = _each(answers, lambda x: x.reshape(axis_size, x.shape[0] // axis_size, *x.shape[1:]))
    return answers, _each(answers, lambda _: True)


def _each(tree: PyTree, function: Callable[[Array], Array | bool]) -> PyTree:
    return jax.tree.map(function, tree)


def _last_axis(tree: PyTree) -> PyTree:
    return _each(tree, lambda x: jnp.moveaxis(x, 0, -1))


def _first_axis(tree: PyTree) -> PyTree:
    return _each(tree, lambda x: jnp.moveaxis(x, -1, 0))


def _solve_chunk(program: ConicProgram) -> Iterate:
    """Solve programs along the last axis until the last of them is done; finished ones are frozen."""
    linear = _Linear(program)
    bounds = program.bounds
    row_offsets = jnp.concatenate([program.row_offsets, bounds, bounds])
    cones = program.cones.shape[0]
    degree = row_offsets.shape[0] + cones

    def residuals(at: Iterate | _Step) -> tuple[Array, Array, Array]:
        """Dual residual P x + c − Gᵀ z, and slack residuals s − offset − G x of rows and cones."""
        return (
            program.quadratic * at.point + program.linear - linear.transposed(at.row_multipliers, at.cone_multipliers),
            at.row_slacks - row_offsets - linear.of_rows(at.point),
            at.cone_slacks - program.cone_offsets - linear.of_cones(at.point),
        )

    def iteration(at: Iterate) -> Iterate:
        dual, row_residuals, cone_residuals = residuals(at)
        scaling = _nesterov_todd(at.cone_slacks, at.cone_multipliers)
        products = at.row_slacks * at.row_multipliers
        squares = _jordan_product(scaling.scaled, scaling.scaled)
        mean = (jnp.sum(products, axis=0) + jnp.sum(squares[:, 0], axis=0)) / degree
        weights = at.row_multipliers / at.row_slacks
        factors = factor(linear.newton_matrix(program.quadratic, weights, scaling))

        def direction(row_targets: Array, cone_targets: Array) -> _Step:
            row_part = (at.row_multipliers * row_residuals + row_targets) / at.row_slacks
            quotient = _jordan_divide(scaling.scaled, cone_targets)
            cone_part = _unscale(scaling, _unscale(scaling, cone_residuals) + quotient)
            point = back_substitute(factors, linear.transposed(row_part, cone_part) - dual)
            row_change, cone_change = linear.of_rows(point), linear.of_cones(point)
            return _Step(
                point,
                row_change - row_residuals,
                row_part - weights * row_change,
                cone_change - cone_residuals,
                cone_part - _unscale(scaling, _unscale(scaling, cone_change)),
            )

        def room(step: _Step) -> Array:
            """Inverse of the largest step to the boundary (zero or less if there is none)."""
            inverse = jnp.concatenate(
                [
                    -step.row_slacks / at.row_slacks,
                    -step.row_multipliers / at.row_multipliers,
                    _cone_room(scaling.scaled, _unscale(scaling, step.cone_slacks)),
                    _cone_room(scaling.scaled, _scale(scaling, step.cone_multipliers)),
                ]
            )
            return jnp.max(inverse, axis=0)

        affine = direction(-products, -squares)
        affine_length = 1.0 / jnp.maximum(room(affine), 1.0)
        centring = jnp.maximum((1.0 - affine_length) ** 3, _CENTRING_FLOOR)
        # Below the floor the scaling has lost its digits, and the polish is better at what remains.
        level = jnp.maximum(centring * mean, _LOWEST_LEVEL)
        second = _jordan_product(_unscale(scaling, affine.cone_slacks), _scale(scaling, affine.cone_multipliers))
        combined = direction(
            level - products - affine.row_slacks * affine.row_multipliers, level * _APEX - squares - second
        )
        fraction = jnp.maximum(0.9, 1.0 - 0.5 * (1.0 - affine_length))
        length = fraction / jnp.maximum(room(combined), fraction)
        moved = _Step(*(old + length * change for old, change in zip(at[:5], combined, strict=True)))
        residual = jnp.max(jnp.concatenate([jnp.abs(x).reshape(-1, x.shape[-1]) for x in residuals(moved)]), axis=0)
        gap = jnp.sum(moved.row_slacks * moved.row_multipliers, axis=0)
        gap = jnp.abs(gap + jnp.sum(moved.cone_slacks * moved.cone_multipliers, axis=(0, 1)))
        # A step that lost its digits is refused and ends the iteration: the polish decides what the last good one is
        # worth.
        healthy = jnp.isfinite(residual + gap)
        going = unfinished(at)
        kept = _Step(*(jnp.where(going & healthy, new, old) for new, old in zip(moved, at[:5], strict=True)))
        done = healthy & (residual <= _RESIDUAL) & (gap <= _GAP)
        count = jnp.where(healthy, at.iterations + 1, MAXIMUM_ITERATIONS)
        return Iterate(
            *kept, converged=at.converged | (going & done), iterations=jnp.where(going, count, at.iterations)
        )

    def unfinished(at: Iterate) -> Bool[Array, " b"]:
        return (~at.converged) & (at.iterations < MAXIMUM_ITERATIONS)

    start = Iterate(
        point=jnp.zeros_like(program.linear),
        row_slacks=jnp.maximum(row_offsets, 1.0),
        row_multipliers=jnp.ones_like(row_offsets),
        cone_slacks=jnp.maximum(program.cone_offsets[:, :1], 1.0) * _APEX,
        cone_multipliers=jnp.ones_like(program.cone_offsets) * _APEX,
        converged=jnp.zeros(program.linear.shape[-1:], dtype=bool),
        iterations=jnp.zeros(program.linear.shape[-1:], dtype=jnp.int32),
    )
    return jax.lax.while_loop(lambda at: jnp.any(unfinished(at)), iteration, start)


_FEASIBLE = 1e-12
_OPTIMAL = 1e-11
_NEWTON_STEPS = 3
_TRIES = 12


class Active(NamedTuple):
    """Which rows hold with equality: barrier, speed cone, and for each component −1, 0 or 1 for the box."""

    barrier: Bool[Array, ""]
    speed: Bool[Array, ""]
    box: Float[Array, "3"]


class Stationary(NamedTuple):
    """Velocity and the multipliers of the barrier row and the speed cone; or a change of them."""

    velocity: Float[Array, "3"]
    barrier: Float[Array, ""]
    speed: Float[Array, ""]


class _Equations(NamedTuple):
    """Values of the equations' left-hand sides; or a change of them."""

    stationarity: Float[Array, "3"]
    barrier: Float[Array, ""]
    speed: Float[Array, ""]


def identify(unit: UnitProgram, iterate: Iterate) -> tuple[Active, Stationary]:
    """Active rows (multiplier larger than slack) and starting multipliers from an interior-point iterate."""
    slope = objective_slope(unit)
    multipliers = iterate.cone_multipliers[:, 0]
    gaps = iterate.cone_slacks[:, 0] - jnp.sqrt(jnp.sum(iterate.cone_slacks[:, 1:] ** 2, axis=-1))
    row = 0 if unit.circulation is None else 1
    if unit.gradient_error is None:
        multipliers = jnp.concatenate([iterate.row_multipliers[row : row + 1], multipliers])
        gaps = jnp.concatenate([iterate.row_slacks[row : row + 1], gaps])
    touching = multipliers > gaps
    values = jnp.where(touching, multipliers * slope, 0.0)
    speed, speed_value = jnp.asarray(False), jnp.asarray(0.0)
    if unit.speed is not None:
        speed, speed_value = touching[1], values[1] / unit.speed
    box = jnp.zeros(3)
    if unit.box is not None:
        held = jnp.where(iterate.row_multipliers > iterate.row_slacks, 1.0, 0.0)
        box = held[-6:-3] - held[-3:]
    return Active(touching[0], speed, box), Stationary(iterate.point[:3], values[0], speed_value)


def _shortfall(unit: UnitProgram, velocity: Float[Array, "3"]) -> Float[Array, ""]:
    assert unit.circulation is not None
    return jnp.maximum(unit.circulation.rate - jnp.sum(unit.circulation.tangent * velocity), 0.0)


def _direction(velocity: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    speed = length(velocity)
    return velocity / jnp.where(speed > 0.0, speed, 1.0), speed


def _residuals(unit: UnitProgram, active: Active, at: Stationary) -> tuple[_Equations, Float[Array, "3"]]:
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
    curvature = at.barrier * unit.error / jnp.where(speed > 0.0, speed, 1.0)
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
    optimal: Bool[Array, ""]
    tries: Int[Array, ""]


def _newton(unit: UnitProgram, active: Active, start: Stationary) -> tuple[Stationary, Float[Array, ""]]:
    """Take Newton steps on one active set; returns the point and the length of the last change of velocity."""
    at, change = start, jnp.asarray(jnp.inf)
    for _ in range(_NEWTON_STEPS):
        step = _correction(unit, active, at, _residuals(unit, active, at)[0])
        change = jnp.max(jnp.abs(step.velocity))
        # Where the barrier is a cone its curvature goes with 1/‖v‖: a longer step would leap over the solution.
        curved = active.barrier & (unit.error > 0.0)
        room = 0.7 * length(at.velocity) / jnp.maximum(length(step.velocity), _TINY)
        share = jnp.where(curved, jnp.minimum(1.0, room), 1.0)
        at = jax.tree.map(lambda value, slope, share=share: value + share * slope, at, step)
    return at, change


def _judge(
    unit: UnitProgram, active: Active, at: Stationary, change: Float[Array, ""]
) -> tuple[Bool[Array, ""], Active, Stationary]:
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


def polish(unit: UnitProgram, active: Active, start: Stationary) -> tuple[Active, Stationary, Bool[Array, ""]]:
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


def _choose(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    """Take one of two pytrees as a whole."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def sensitivity(
    unit: UnitProgram, change: UnitProgram, active: Active, at: Stationary, *, apart: bool
) -> Float[Array, "3"]:
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


def status_of(
    *, solved: Bool[Array, ""], room: Float[Array, ""], gain: Float[Array, ""], finite: Bool[Array, ""]
) -> Int[Array, ""]:
    """Return the `ConeStatus` of a solve from its room and the largest g = n·v − e‖v‖ that any velocity reaches."""
    status = jnp.where(solved, ConeStatus.SOLVED, ConeStatus.STALLED)
    infeasible = jnp.where(gain > 0.0, ConeStatus.INFEASIBLE, ConeStatus.NO_WAY_OUT)
    status = jnp.where(room < 0.0, infeasible, status)
    return jnp.where(finite, status, ConeStatus.NOT_FINITE).astype(jnp.int32)


class ConeSolution(eqx.Module):
    """Answer of the velocity program.

    `velocity` (3,) m/s; `status` a `ConeStatus`; `room` in m/s: barrier_rate + g_max, the program is feasible
    exactly if it is not negative (closed form, `program.py`; above what any row can use it is cut off);
    `iterations` of the interior point.
    """

    velocity: Float[Array, "3"]
    status: Int[Array, ""]
    room: Float[Array, ""]
    iterations: Int[Array, ""]


class _Outcome(NamedTuple):
    """A solve in the unit program's scale, with everything its derivative needs."""

    at: Stationary
    active: Active
    escaping: Bool[Array, ""]
    resting: Bool[Array, ""]
    status: Int[Array, ""]
    room: Float[Array, ""]
    iterations: Int[Array, ""]


def _rest_is_optimal(unit: UnitProgram) -> Bool[Array, ""]:
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


def _iterate(unit: UnitProgram, easy: Bool[Array, ""]) -> tuple[Active, Stationary, Bool[Array, ""], Int[Array, ""]]:
    """Interior point and polish. Where a closed form answers (`easy`) they work on a program that they can finish."""
    tame = unit._replace(barrier_rate=jnp.where(easy, 3.0, unit.barrier_rate))
    iterate = interior_point(to_conic(tame))
    return *polish(tame, *identify(tame, iterate)), iterate.iterations


def _project(unit: UnitProgram) -> tuple[Active, Stationary, Bool[Array, ""], Int[Array, ""]]:
    """Project onto a half-space and a ball, in closed form: onto the ball, else the plane, else their circle."""
    assert unit.speed is not None
    n, desired, rate, limit = unit.normal, unit.desired, unit.barrier_rate, unit.speed
    square = jnp.sum(n * n)
    square = jnp.where(square > 0.0, square, 1.0)
    speed = length(desired)
    in_ball = desired * jnp.minimum(1.0, limit / jnp.where(speed > 0.0, speed, 1.0))
    along = jnp.sum(n * desired)
    on_plane = desired - (along + rate) / square * n
    foot = -rate / square * n
    tangent = desired - along / square * n
    spread = length(tangent)
    radius = jnp.sqrt(jnp.maximum(limit * limit - jnp.sum(foot * foot), 0.0))
    on_circle = foot + radius * tangent / jnp.where(spread > 0.0, spread, 1.0)
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
    status = status_of(solved=good | easy, room=room, gain=gain, finite=finite)
    at = at._replace(velocity=jnp.where(finite, velocity, 0.0))
    return _Outcome(at, active, escaping, resting, status, room, iterations)


def _answer(program: VelocityProgram, outcome: _Outcome) -> Float[Array, "3"]:
    """Return the solution in m/s."""
    return to_unit(program).size * outcome.at.velocity


def _change(primals: tuple, tangents: tuple, *, apart: bool) -> Float[Array, "3"]:
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
    only, which is cheaper where it is taken in every control step. Away from
    changes of the active set the solution is differentiable; at one the derivative is that of one side.

    Method: primal-dual interior point (`interior_point`), then Newton on the active set (`active_set`); a half-space
    with a speed limit alone has a closed form. Feasibility is closed
    form, and an infeasible program answers with the fastest way out, status `INFEASIBLE`; where there is none
    (e ≥ ‖n‖), with zero, status `NO_WAY_OUT`.
    """
    data = jax.lax.stop_gradient(program)
    outcome = jax.lax.stop_gradient(_solve_unit(data))
    room = outcome.room * to_unit(data).size * row_length(data)
    velocity = (_velocity_forward if forward else _velocity)(program, outcome)
    return ConeSolution(velocity, outcome.status, room, outcome.iterations)

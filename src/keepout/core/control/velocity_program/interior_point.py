"""A primal-dual interior point for tiny cone programs, many at a time.

Nesterov-Todd scaling and Mehrotra's predictor-corrector as in Vandenberghe, "The CVXOPT linear and quadratic cone
program solvers" (2010), sections 4 to 7. At three or four unknowns a matrix call costs more than the arithmetic, so
products are written out as elementwise multiplications and sums, and **the axis of programs is the last one**: every
operation then runs along consecutive numbers. `jax.vmap` of `solve` leads there by itself.

The program is  minimise ½ xᵀ diag(quadratic) x + linearᵀ x  over x, with  row_offsets + rows x ≥ 0,  |x_i| ≤ bounds_i
for the first unknowns, and  cone_offsets + cones x  in second-order cones of four entries (head first).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

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


def solve(program: ConicProgram) -> Iterate:
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

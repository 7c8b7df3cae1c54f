"""A primal-dual interior point for tiny cone programs.

Nesterov-Todd scaling and Mehrotra's predictor-corrector as in Vandenberghe, "The CVXOPT linear and quadratic cone
program solvers" (2010), sections 4 to 7. Products are written as elementwise multiplications and sums: at three or
four unknowns a matrix call costs more than the arithmetic, and a batch (through `vmap`) fuses.

The program is  minimise ½ xᵀ diag(quadratic) x + linearᵀ x  over x, with  row_offsets + rows x ≥ 0  and
cone_offsets + cones x  in second-order cones of four entries (head first).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

MAXIMUM_ITERATIONS = 18
_RESIDUAL = 1e-6
_GAP = 1e-9
_LOWEST_LEVEL = 1e-11
_CENTRING_FLOOR = 1e-3
_TINY = 1e-300


class ConicProgram(NamedTuple):
    """The data of one program with n unknowns, l half-lines and k second-order cones."""

    quadratic: Float[Array, " n"]
    linear: Float[Array, " n"]
    rows: Float[Array, "l n"]
    row_offsets: Float[Array, " l"]
    cones: Float[Array, "k 4 n"]
    cone_offsets: Float[Array, "k 4"]


class Iterate(NamedTuple):
    """Point, slacks and multipliers of the iteration."""

    point: Float[Array, " n"]
    row_slacks: Float[Array, " l"]
    row_multipliers: Float[Array, " l"]
    cone_slacks: Float[Array, "k 4"]
    cone_multipliers: Float[Array, "k 4"]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]


class _Step(NamedTuple):
    """Changes of the entries of an `Iterate`."""

    point: Float[Array, " n"]
    row_slacks: Float[Array, " l"]
    row_multipliers: Float[Array, " l"]
    cone_slacks: Float[Array, "k 4"]
    cone_multipliers: Float[Array, "k 4"]


class _Scaling(NamedTuple):
    """Nesterov-Todd scaling of the cones: W = beta (2 v vᵀ − J), W² = beta² (2 w wᵀ − J), scaled = W z = W⁻¹ s."""

    beta: Float[Array, "k 1"]
    v: Float[Array, "k 4"]
    w: Float[Array, "k 4"]
    scaled: Float[Array, "k 4"]


def _reflect(x: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """J x: the tail's sign changed."""
    return x * jnp.asarray([1.0, -1.0, -1.0, -1.0])


def _dot(a: Float[Array, "... m"], b: Float[Array, "... m"]) -> Float[Array, "... 1"]:
    return jnp.sum(a * b, axis=-1, keepdims=True)


def _join(head: Float[Array, "... 1"], tail: Float[Array, "... 3"]) -> Float[Array, "... 4"]:
    return jnp.concatenate([head, tail], axis=-1)


def _size(x: Float[Array, "k 4"]) -> Float[Array, "k 1"]:
    """√(xᵀ J x), from the two factors head ± ‖tail‖ so that no digits cancel near the boundary."""
    tail = jnp.sqrt(_dot(x[:, 1:], x[:, 1:]))
    return jnp.sqrt(jnp.maximum((x[:, :1] - tail) * (x[:, :1] + tail), _TINY))


def _jordan_product(a: Float[Array, "k 4"], b: Float[Array, "k 4"]) -> Float[Array, "k 4"]:
    return _join(_dot(a, b), a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:])


def _jordan_divide(a: Float[Array, "k 4"], b: Float[Array, "k 4"]) -> Float[Array, "k 4"]:
    """Return the u with a ∘ u = b."""
    head = _dot(_reflect(a), b) / _size(a) ** 2
    return _join(head, (b[:, 1:] - head * a[:, 1:]) / a[:, :1])


def _nesterov_todd(slack: Float[Array, "k 4"], multiplier: Float[Array, "k 4"]) -> _Scaling:
    slack_size, multiplier_size = _size(slack), _size(multiplier)
    s, z = slack / slack_size, multiplier / multiplier_size
    w = (s + _reflect(z)) / (2.0 * jnp.sqrt((1.0 + _dot(s, z)) / 2.0))
    v = (w + jnp.asarray([1.0, 0.0, 0.0, 0.0])) / jnp.sqrt(2.0 * (w[:, :1] + 1.0))
    beta = jnp.sqrt(slack_size / multiplier_size)
    return _Scaling(beta, v, w, beta * (2.0 * v * _dot(v, multiplier) - _reflect(multiplier)))


def _scale(scaling: _Scaling, x: Float[Array, "k 4"]) -> Float[Array, "k 4"]:
    return scaling.beta * (2.0 * scaling.v * _dot(scaling.v, x) - _reflect(x))


def _unscale(scaling: _Scaling, x: Float[Array, "k 4"]) -> Float[Array, "k 4"]:
    mirrored = _reflect(scaling.v)
    return (2.0 * mirrored * _dot(mirrored, x) - _reflect(x)) / scaling.beta


def _cone_room(point: Float[Array, "k 4"], direction: Float[Array, "k 4"]) -> Float[Array, ""]:
    """Inverse of the largest step that keeps `point + step · direction` in the cones (scaled coordinates)."""
    size = _size(point)
    p = point / size
    head = _dot(_reflect(p), direction)
    tail = direction[:, 1:] - (head + direction[:, :1]) / (p[:, :1] + 1.0) * p[:, 1:]
    return jnp.max((jnp.sqrt(_dot(tail, tail)) - head) / size)


def eliminate(matrix: Float[Array, "n n"], rhs: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Solve a small symmetric positive definite system by Gauss-Jordan elimination without pivoting."""
    n = matrix.shape[0]
    table = jnp.concatenate([matrix, rhs], axis=1)
    for k in range(n):
        row = table[k] / jnp.where(jnp.abs(table[k, k]) > _TINY, table[k, k], _TINY)
        others = jnp.asarray([0.0 if i == k else 1.0 for i in range(n)])[:, None]
        unit = 1.0 - others
        table = others * (table - table[:, k : k + 1] * row) + unit * row
    return table[:, n:]


def _residuals(program: ConicProgram, at: Iterate) -> tuple[Array, Array, Array]:
    """Dual residual P x + c − Gᵀ z, and slack residuals s − offset − G x of rows and cones."""
    dual = program.quadratic * at.point + program.linear
    dual = dual - jnp.sum(program.rows * at.row_multipliers[:, None], axis=0)
    dual = dual - jnp.sum(program.cones * at.cone_multipliers[:, :, None], axis=(0, 1))
    rows = at.row_slacks - program.row_offsets - jnp.sum(program.rows * at.point, axis=-1)
    cones = at.cone_slacks - program.cone_offsets - jnp.sum(program.cones * at.point, axis=-1)
    return dual, rows, cones


def _newton_matrix(program: ConicProgram, weights: Float[Array, " l"], scaling: _Scaling) -> Float[Array, "n n"]:
    """diag(quadratic) + Gᵀ W⁻² G, with W⁻² = beta⁻² (2 (Jw)(Jw)ᵀ − J)."""
    matrix = jnp.diag(program.quadratic)
    matrix = matrix + jnp.sum(weights[:, None, None] * program.rows[:, :, None] * program.rows[:, None, :], axis=0)
    y = jnp.sum(_reflect(scaling.w)[:, :, None] * program.cones, axis=1)
    signs = jnp.asarray([1.0, -1.0, -1.0, -1.0])[None, :, None, None]
    form = jnp.sum(signs * program.cones[:, :, :, None] * program.cones[:, :, None, :], axis=1)
    return matrix + jnp.sum((2.0 * y[:, :, None] * y[:, None, :] - form) / scaling.beta[:, :, None] ** 2, axis=0)


def solve(program: ConicProgram, *, complementarity: float | Float[Array, ""] = 0.0) -> Iterate:
    """Solve the program, or follow its central path to s ∘ z = `complementarity`.

    Infeasible start, predictor-corrector steps, a floor under the centring parameter, and a fraction of the step to the
    boundary that tends to one with the affine step. Returns the last iterate; `converged` says whether residuals and
    gap came below tolerance within `MAXIMUM_ITERATIONS`.
    """
    n_rows, n_cones = program.rows.shape[0], program.cones.shape[0]
    degree = n_rows + n_cones
    target = jnp.asarray(complementarity, dtype=program.linear.dtype)
    apex = jnp.asarray([1.0, 0.0, 0.0, 0.0])
    start = Iterate(
        point=jnp.zeros_like(program.linear),
        row_slacks=jnp.maximum(program.row_offsets, 1.0),
        row_multipliers=jnp.ones_like(program.row_offsets),
        cone_slacks=jnp.maximum(program.cone_offsets[:, :1], 1.0) * apex,
        cone_multipliers=jnp.ones_like(program.cone_offsets) * apex,
        converged=jnp.asarray(False),
        iterations=jnp.asarray(0, dtype=jnp.int32),
    )

    def iteration(at: Iterate) -> Iterate:
        dual, row_residuals, cone_residuals = _residuals(program, at)
        scaling = _nesterov_todd(at.cone_slacks, at.cone_multipliers)
        products = at.row_slacks * at.row_multipliers
        squares = _jordan_product(scaling.scaled, scaling.scaled)
        mean = (jnp.sum(products) + jnp.sum(squares[:, 0])) / degree
        matrix = _newton_matrix(program, at.row_multipliers / at.row_slacks, scaling)
        inverse = eliminate(matrix, jnp.eye(matrix.shape[0]))

        def direction(row_targets: Array, cone_targets: Array) -> _Step:
            row_part = (at.row_multipliers * row_residuals + row_targets) / at.row_slacks
            quotient = _jordan_divide(scaling.scaled, cone_targets)
            cone_part = _unscale(scaling, _unscale(scaling, cone_residuals) + quotient)
            rhs = -dual + jnp.sum(program.rows * row_part[:, None], axis=0)
            rhs = rhs + jnp.sum(program.cones * cone_part[:, :, None], axis=(0, 1))
            point = jnp.sum(inverse * rhs, axis=-1)
            row_change = jnp.sum(program.rows * point, axis=-1)
            cone_change = jnp.sum(program.cones * point, axis=-1)
            return _Step(
                point,
                row_change - row_residuals,
                row_part - at.row_multipliers / at.row_slacks * row_change,
                cone_change - cone_residuals,
                cone_part - _unscale(scaling, _unscale(scaling, cone_change)),
            )

        def room(step: _Step) -> Array:
            """Inverse of the largest step to the boundary (zero or less if there is none)."""
            inverse = jnp.maximum(
                _cone_room(scaling.scaled, _unscale(scaling, step.cone_slacks)),
                _cone_room(scaling.scaled, _scale(scaling, step.cone_multipliers)),
            )
            if n_rows:
                inverse = jnp.maximum(inverse, jnp.max(-step.row_slacks / at.row_slacks))
                inverse = jnp.maximum(inverse, jnp.max(-step.row_multipliers / at.row_multipliers))
            return inverse

        affine = direction(-products, -squares)
        affine_length = 1.0 / jnp.maximum(room(affine), 1.0)
        centring = jnp.maximum((1.0 - affine_length) ** 3, _CENTRING_FLOOR)
        # Below the floor the scaling has lost its digits, and the polish is better at what remains.
        level = jnp.maximum(jnp.maximum(centring * mean, target), _LOWEST_LEVEL)
        second = _jordan_product(_unscale(scaling, affine.cone_slacks), _scale(scaling, affine.cone_multipliers))
        combined = direction(
            level - products - affine.row_slacks * affine.row_multipliers, level * apex - squares - second
        )
        fraction = jnp.maximum(0.9, 1.0 - 0.5 * (1.0 - affine_length))
        length = fraction / jnp.maximum(room(combined), fraction)
        moved = Iterate(
            at.point + length * combined.point,
            at.row_slacks + length * combined.row_slacks,
            at.row_multipliers + length * combined.row_multipliers,
            at.cone_slacks + length * combined.cone_slacks,
            at.cone_multipliers + length * combined.cone_multipliers,
            at.converged,
            at.iterations + 1,
        )
        flat = jnp.concatenate([jnp.ravel(x) for x in _residuals(program, moved)])
        gap = jnp.abs(
            jnp.sum(moved.row_slacks * moved.row_multipliers)
            + jnp.sum(moved.cone_slacks * moved.cone_multipliers)
            - degree * target
        )
        residual = jnp.max(jnp.abs(flat))
        # A step that lost its digits is refused and ends the iteration: the polish decides what the last good one is
        # worth.
        healthy = jnp.isfinite(residual + gap)
        kept = jax.tree.map(lambda new, old: jnp.where(healthy, new, old), moved, at)
        done = (residual <= _RESIDUAL) & (gap <= jnp.maximum(_GAP, 1e-3 * target))
        iterations = jnp.where(healthy, moved.iterations, MAXIMUM_ITERATIONS)
        return kept._replace(converged=done & healthy, iterations=iterations)

    def unfinished(at: Iterate) -> Bool[Array, ""]:
        return (~at.converged) & (at.iterations < MAXIMUM_ITERATIONS)

    return jax.lax.while_loop(unfinished, iteration, start)

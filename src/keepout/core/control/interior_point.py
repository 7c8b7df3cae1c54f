"""A primal-dual interior point for tiny cone programs, many at a time.

The program is  minimise ½ xᵀ P x + cᵀ x  over x, with P diagonal and the slacks s = h + G x in a cone K: half-lines
(rows; x ≤ bounds and −x ≤ bounds for the first unknowns), and second-order cones of four entries, head first. With
multipliers z, and ∘ the product of K (Jordan's in a second-order cone, entry by entry on half-lines), its optimum is
where

    P x + c − Gᵀ z = 0,   s − h − G x = 0,   s ∘ z = 0,   s, z ∈ K.

A step takes these as linear in (x, s, z), with the last one asked of λ = W z = W⁻¹ s, W the Nesterov-Todd scaling of
the iterate, and its right-hand side μ e > 0 sinking to 0 (e is 1 on half-lines, (1, 0, 0, 0) in a cone):

    P Δx − Gᵀ Δz = −r_d,   Δs − G Δx = −r_s,   λ ∘ (W⁻¹ Δs + W Δz) = target.

Mehrotra's predictor has the target −λ ∘ λ. The length of step α that it may take says how much μ can sink, and its
own change of the product is what the linear equations left out: the corrector's target is
σ μ e − λ ∘ λ − W⁻¹ Δs ∘ W Δz of the predictor, σ = (1 − α)³. See Vandenberghe, "The CVXOPT linear and quadratic cone
program solvers" (2010), sections 4 to 7.

At three or four unknowns a matrix call costs more than the arithmetic, so products are written out as elementwise
multiplications and sums, and **the axis of programs is the last one**: every operation then runs along consecutive
numbers. `jax.vmap` leads there by itself.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from keepout.core.compiled.in_batches import in_chunks, joined_rows

MAXIMUM_ITERATIONS = 18
CHUNK = 128
"""Programs solved together on a CPU: their iterates stay in cache."""
TINY = 1e-300
_RESIDUAL = 1e-6
_GAP = 1e-9
_LOWEST_LEVEL = 1e-11
_CENTRING_FLOOR = 1e-3
_MIRROR = np.array([1.0, -1.0, -1.0, -1.0])[:, None]
_APEX = np.array([1.0, 0.0, 0.0, 0.0])[:, None]

Cones = Float[Array, "k 4 b"]
PerCone = Float[Array, "k 1 b"]
Factors = tuple[list[list[Array]], list[Array]]
"""The rows of L below its diagonal, and D, of a matrix L D Lᵀ."""


class ConicProgram(NamedTuple):
    """The data of one program with n unknowns, l rows, m bounds and k second-order cones."""

    quadratic: Float[Array, " n"]
    linear: Float[Array, " n"]
    rows: Float[Array, "l n"]
    row_offsets: Float[Array, " l"]
    bounds: Float[Array, " m"]
    cones: Float[Array, "k 4 n"]
    cone_offsets: Float[Array, "k 4"]


class InCone(NamedTuple):
    """A vector of the space of K: its entries on the half-lines (rows, x ≤ bounds, −x ≤ bounds), and in the cones."""

    lines: Float[Array, "lines *b"]
    cones: Float[Array, "k 4 *b"]


class PrimalDual(NamedTuple):
    """x, s and z; or a change of them."""

    point: Float[Array, "n *b"]
    slacks: InCone
    multipliers: InCone


class Iterate(NamedTuple):
    """Where the method has come to."""

    at: PrimalDual
    converged: Bool[Array, "*b"]
    iterations: Int[Array, "*b"]


def interior_point(program: ConicProgram) -> Iterate:
    """Solve the program.

    Infeasible start, predictor-corrector steps, a floor under the centring parameter, and a fraction of the step to the
    boundary that tends to one with the affine step. Returns the last iterate; `converged` says whether residuals and
    gap came below tolerance within `MAXIMUM_ITERATIONS`.
    """
    answers = joined_rows(_solve_many, (), jax.tree.map(lambda x: x[None], program))
    return jax.tree.map(lambda x: x[0], answers)


def _solve_many(_: tuple[()], programs: ConicProgram) -> Iterate:
    """Solve programs along a first axis, on a CPU in chunks."""
    if jax.default_backend() != "cpu":
        return _solve_together(programs)
    return in_chunks(_solve_together, programs, CHUNK)


def _solve_together(programs: ConicProgram) -> Iterate:
    """Solve programs along a first axis until the last of them is done; finished ones are frozen."""
    program = _Program(jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), programs))
    end = jax.lax.while_loop(lambda at: jnp.any(_unfinished(at)), program.step, program.start())
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), end)


def _unfinished(iterate: Iterate) -> Bool[Array, " b"]:
    return (~iterate.converged) & (iterate.iterations < MAXIMUM_ITERATIONS)


class _Program:
    """Programs along the last axis, b: P, c, G and h, and how the method goes on from an iterate."""

    def __init__(self, program: ConicProgram):
        self.quadratic, self.linear = program.quadratic, program.linear
        self.rows, self.cones = program.rows, program.cones
        self.bounded, self.unknowns = len(program.bounds), len(program.linear)
        lines = jnp.concatenate([program.row_offsets, program.bounds, program.bounds])
        self.offsets = InCone(lines, program.cone_offsets)
        self.degree = len(lines) + len(program.cones)
        # Gᵀ J G of each cone, which no iteration changes.
        signs = _MIRROR[:, :, None, None]
        self.form = jnp.sum(signs * self.cones[:, :, :, None] * self.cones[:, :, None, :], axis=1)

    def start(self) -> Iterate:
        """Begin at x = 0, with slacks and multipliers along e."""
        lines, cones = self.offsets
        slacks = InCone(jnp.maximum(lines, 1.0), jnp.maximum(cones[:, :1], 1.0) * _APEX)
        multipliers = InCone(jnp.ones_like(lines), jnp.ones_like(cones) * _APEX)
        count = self.linear.shape[-1:]
        at = PrimalDual(jnp.zeros_like(self.linear), slacks, multipliers)
        return Iterate(at, jnp.zeros(count, dtype=bool), jnp.zeros(count, dtype=jnp.int32))

    def step(self, iterate: Iterate) -> Iterate:
        """Take one step of the programs that are not finished: `mean` is μ, `centring` σ, `affine_length` α."""
        at = iterate.at
        residuals = self.residuals(at)
        scaling = _Scaling.of(at)
        square = scaling.square()
        mean = (jnp.sum(square.lines, axis=0) + jnp.sum(square.cones[:, 0], axis=0)) / self.degree
        factors = factor(self.newton_matrix(scaling))

        # The predictor, and how far it may go.
        affine = self.direction(residuals, scaling, factors, jax.tree.map(jnp.negative, square))
        affine_length = 1.0 / jnp.maximum(scaling.shortness(affine), 1.0)
        centring = jnp.maximum((1.0 - affine_length) ** 3, _CENTRING_FLOOR)

        # The corrector. Below the floor the scaling has lost its digits, and the polish is better at what remains.
        level = jnp.maximum(centring * mean, _LOWEST_LEVEL)
        aim = InCone(level, level * _APEX)
        target = jax.tree.map(lambda aim, have, second: aim - have - second, aim, square, scaling.product(affine))
        combined = self.direction(residuals, scaling, factors, target)
        fraction = jnp.maximum(0.9, 1.0 - 0.5 * (1.0 - affine_length))
        length = fraction / jnp.maximum(scaling.shortness(combined), fraction)
        moved = jax.tree.map(lambda old, change: old + length * change, at, combined)

        # A step that lost its digits is refused and ends the iteration: the polish decides what the last good one is
        # worth.
        residual, gap = self.largest_residual(moved), _gap(moved)
        healthy = jnp.isfinite(residual + gap)
        going = _unfinished(iterate)
        done = healthy & (residual <= _RESIDUAL) & (gap <= _GAP)
        count = jnp.where(healthy, iterate.iterations + 1, MAXIMUM_ITERATIONS)
        return Iterate(
            jax.tree.map(lambda new, old: jnp.where(going & healthy, new, old), moved, at),
            converged=iterate.converged | (going & done),
            iterations=jnp.where(going, count, iterate.iterations),
        )

    def residuals(self, at: PrimalDual) -> tuple[Float[Array, "n b"], InCone]:
        """Give r_d = P x + c − Gᵀ z and r_s = s − h − G x."""
        dual = self.quadratic * at.point + self.linear - self.transposed(at.multipliers)
        return dual, jax.tree.map(lambda s, h, g: s - h - g, at.slacks, self.offsets, self.times(at.point))

    def largest_residual(self, at: PrimalDual) -> Float[Array, " b"]:
        """Give the largest entry of both residuals."""
        sizes = [jnp.abs(x).reshape(-1, x.shape[-1]) for x in jax.tree.leaves(self.residuals(at))]
        return jnp.max(jnp.concatenate(sizes), axis=0)

    def direction(
        self, residuals: tuple[Float[Array, "n b"], InCone], scaling: "_Scaling", factors: Factors, target: InCone
    ) -> PrimalDual:
        """Solve the linear equations for a target.

        With λ ∘ u = target and y = W⁻¹ (u + W⁻¹ r_s) they leave (P + Gᵀ W⁻² G) Δx = Gᵀ y − r_d, Δz = y − W⁻² G Δx.
        """
        dual, primal = residuals
        y = scaling.aimed(primal, target)
        point = back_substitute(factors, self.transposed(y) - dual)
        along = self.times(point)
        slacks = jax.tree.map(jnp.subtract, along, primal)
        return PrimalDual(point, slacks, jax.tree.map(jnp.subtract, y, scaling.unscaled_twice(along)))

    def times(self, x: Float[Array, "n b"]) -> InCone:
        """Give G x."""
        held = x[: self.bounded]
        lines = jnp.concatenate([jnp.sum(self.rows * x, axis=1), -held, held])
        return InCone(lines, jnp.sum(self.cones * x, axis=2))

    def transposed(self, y: InCone) -> Float[Array, "n b"]:
        """Give Gᵀ y."""
        rows, upper, lower = self._split(y.lines)
        result = jnp.sum(self.rows * rows[:, None], axis=0) + jnp.sum(self.cones * y.cones[:, :, None], axis=(0, 1))
        return result + self._spread(lower - upper)

    def newton_matrix(self, scaling: "_Scaling") -> Float[Array, "n n b"]:
        """Give P + Gᵀ W⁻² G; of a cone W⁻² = beta⁻² (2 (Jw)(Jw)ᵀ − J)."""
        rows, upper, lower = self._split(scaling.weights)
        diagonal = jnp.eye(self.unknowns)[:, :, None] * (self.quadratic + self._spread(upper + lower))
        matrix = diagonal + jnp.sum(rows[:, None, None] * self.rows[:, :, None] * self.rows[:, None, :], axis=0)
        y = jnp.sum(_reflect(scaling.w)[:, :, None] * self.cones, axis=1)
        cones = (2.0 * y[:, :, None] * y[:, None, :] - self.form) / scaling.beta[:, :, None] ** 2
        return matrix + jnp.sum(cones, axis=0)

    def _spread(self, upper: Float[Array, "m b"]) -> Float[Array, "n b"]:
        return jnp.pad(upper, ((0, self.unknowns - self.bounded), (0, 0)))

    def _split(self, values: Float[Array, "lines b"]) -> tuple[Array, Array, Array]:
        """Take the half-lines' entries apart: rows, x ≤ bounds, −x ≤ bounds."""
        first = self.rows.shape[0]
        second = first + self.bounded
        return values[:first], values[first:second], values[second:]


def _gap(at: PrimalDual) -> Float[Array, " b"]:
    """Give |sᵀ z|."""
    (lines, cones), (line_multipliers, cone_multipliers) = at.slacks, at.multipliers
    return jnp.abs(jnp.sum(lines * line_multipliers, axis=0) + jnp.sum(cones * cone_multipliers, axis=(0, 1)))


class _Scaling(NamedTuple):
    """The Nesterov-Todd scaling W of an iterate, with λ = W z = W⁻¹ s.

    Of a half-line W⁻² is z/s, its `weights`; W and λ are not formed. Of a cone W = beta (2 v vᵀ − J) and
    W² = beta² (2 w wᵀ − J), J the mirror that changes the tail's sign; `scaled` is λ.
    """

    slacks: Float[Array, "lines b"]
    multipliers: Float[Array, "lines b"]
    weights: Float[Array, "lines b"]
    beta: PerCone
    v: Cones
    w: Cones
    scaled: Cones

    @classmethod
    def of(cls, at: PrimalDual) -> "_Scaling":
        """Give the scaling at an iterate."""
        (slacks, slack), (multipliers, multiplier) = at.slacks, at.multipliers
        slack_size, multiplier_size = _size(slack), _size(multiplier)
        s, z = slack / slack_size, multiplier / multiplier_size
        w = (s + _reflect(z)) / (2.0 * jnp.sqrt((1.0 + _dot(s, z)) / 2.0))
        v = (w + _APEX) / jnp.sqrt(2.0 * (w[:, :1] + 1.0))
        beta = jnp.sqrt(slack_size / multiplier_size)
        scaled = beta * (2.0 * v * _dot(v, multiplier) - _reflect(multiplier))
        return cls(slacks, multipliers, multipliers / slacks, beta, v, w, scaled)

    def scale(self, x: Cones) -> Cones:
        """Give W x."""
        return self.beta * (2.0 * self.v * _dot(self.v, x) - _reflect(x))

    def unscale(self, x: Cones) -> Cones:
        """Give W⁻¹ x."""
        mirrored = _reflect(self.v)
        return (2.0 * mirrored * _dot(mirrored, x) - _reflect(x)) / self.beta

    def square(self) -> InCone:
        """Give λ ∘ λ."""
        return InCone(self.slacks * self.multipliers, _jordan_product(self.scaled, self.scaled))

    def product(self, step: PrimalDual) -> InCone:
        """Give W⁻¹ Δs ∘ W Δz."""
        (lines, cones), (line_change, cone_change) = step.slacks, step.multipliers
        return InCone(lines * line_change, _jordan_product(self.unscale(cones), self.scale(cone_change)))

    def aimed(self, residual: InCone, target: InCone) -> InCone:
        """Give W⁻¹ (u + W⁻¹ r) with λ ∘ u = target."""
        lines = (self.multipliers * residual.lines + target.lines) / self.slacks
        quotient = _jordan_divide(self.scaled, target.cones)
        return InCone(lines, self.unscale(self.unscale(residual.cones) + quotient))

    def unscaled_twice(self, x: InCone) -> InCone:
        """Give W⁻² x."""
        return InCone(self.weights * x.lines, self.unscale(self.unscale(x.cones)))

    def shortness(self, step: PrimalDual) -> Float[Array, " b"]:
        """Give the inverse of the largest share of a step that stays in K; zero or less if all of it does."""
        (lines, cones), (line_change, cone_change) = step.slacks, step.multipliers
        inverse = [
            -lines / self.slacks,
            -line_change / self.multipliers,
            _cone_shortness(self.scaled, self.unscale(cones)),
            _cone_shortness(self.scaled, self.scale(cone_change)),
        ]
        return jnp.max(jnp.concatenate(inverse), axis=0)


def _cone_shortness(point: Cones, direction: Cones) -> Float[Array, "k b"]:
    """Give the inverse of the largest step that keeps `point + step · direction` in the cones (scaled coordinates)."""
    size = _size(point)
    p = point / size
    head = _dot(_reflect(p), direction)
    tail = direction[:, 1:] - (head + direction[:, :1]) / (p[:, :1] + 1.0) * p[:, 1:]
    return ((jnp.sqrt(_dot(tail, tail)) - head) / size)[:, 0]


def _reflect(x: Cones) -> Cones:
    """J x: the tail's sign changed."""
    return x * _MIRROR


def _dot(a: Float[Array, "k i b"], b: Float[Array, "k i b"]) -> PerCone:
    return jnp.sum(a * b, axis=1, keepdims=True)


def _size(x: Cones) -> PerCone:
    """√(xᵀ J x), from the two factors head ± ‖tail‖ so that no digits cancel near the boundary."""
    tail = jnp.sqrt(_dot(x[:, 1:], x[:, 1:]))
    return jnp.sqrt(jnp.maximum((x[:, :1] - tail) * (x[:, :1] + tail), TINY))


def _jordan_product(a: Cones, b: Cones) -> Cones:
    return jnp.concatenate([_dot(a, b), a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:]], axis=1)


def _jordan_divide(a: Cones, b: Cones) -> Cones:
    """Return the u with a ∘ u = b."""
    head = _dot(_reflect(a), b) / _size(a) ** 2
    return jnp.concatenate([head, (b[:, 1:] - head * a[:, 1:]) / a[:, :1]], axis=1)


def factor(matrix: Float[Array, "n n *b"]) -> Factors:
    """Factor small symmetric positive definite matrices."""
    lower: list[list[Array]] = []
    pivots: list[Array] = []
    for i in range(matrix.shape[0]):
        row: list[Array] = []
        for j in range(i):
            row.append((matrix[i, j] - sum(row[k] * lower[j][k] * pivots[k] for k in range(j))) / pivots[j])
        pivot = matrix[i, i] - sum(row[k] * row[k] * pivots[k] for k in range(i))
        lower.append(row)
        pivots.append(jnp.where(jnp.abs(pivot) > TINY, pivot, TINY))
    return lower, pivots


def back_substitute(factors: Factors, rhs: Float[Array, "n *b"]) -> Float[Array, "n *b"]:
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

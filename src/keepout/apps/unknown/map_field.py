"""The field of a map: a C² cubic B-spline over the distances of a grid's nodes to all that is not known free.

Its bounds hold for any map, whatever was seen and in whatever order (docs/mapping.md):

- f ≤ √(d² + h²), with d the distance to the cubes that are not known free and h their edge;
- where free room grows, f falls nowhere, in floating point neither;
- ‖∇f‖ ≤ `SLOPE` everywhere.

There is one level of one spacing: a block that changed its spacing would lower the field.
"""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, Shaped, UInt16

from keepout.core.compiled.in_batches import joined_rows, rows_last
from keepout.core.errors import FieldError
from keepout.core.fields.field import Field, of_places

SLOPE = 1.14
"""L: no map's field has a gradient of a larger norm; proved by `benchmarks/map_slope.py`."""
EDGE = 3
"""Layers of nodes on each side of the box that must be at the cap, so that the field is one constant from there on."""


class MapField(Field):
    """Σ_i c_i B₃((p − x_i)/h), c_i = h √squares_i, over the nodes x_i of one grid; the constant `cap` beyond its box.

    Make it with `MapField.of`. A program compiled for one map takes every later one of the same shape.

    Attributes:
        squares: at each node, the squared distance in cells to the nearest cube that is not known free, cut off at one
            number that all nodes near the box's faces have.
        origin: (3,) the first node, metres.
        spacing: h, metres.

    """

    squares: UInt16[Array, "nx ny nz"]
    origin: Float[Array, "3"]
    spacing: Float[Array, ""]

    @classmethod
    def of(
        cls, squares: Shaped[np.ndarray, "nx ny nz"], origin: Sequence[float] | Float[np.ndarray, "3"], spacing: float
    ) -> "MapField":
        """Take a copy of a map's squared node distances, so that the map may grow on.

        Args:
            squares: uint16, squared distances in cells, cut off at the number that the nodes near the box's faces have.
            origin: of node (0, 0, 0), m.
            spacing: between nodes, m.

        Raises:
            FieldError: another type or shape, an origin or spacing that is no length, or a node in the outermost three
                layers that is not at the cap.

        """
        squares, first = np.asarray(squares), np.asarray(origin, np.float64)
        if squares.dtype != np.uint16 or squares.ndim != 3 or min(squares.shape) < 2 * EDGE:
            raise FieldError(
                f"map field: squares of type {squares.dtype} and shape {squares.shape}; uint16 in three axes of "
                f"{2 * EDGE} nodes or more are needed"
            )
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise FieldError(f"map field: spacing is {spacing} m; it must be finite and greater than 0")
        if first.shape != (3,) or not np.all(np.isfinite(first)):
            raise FieldError(f"map field: origin is {origin}; three finite numbers in metres are needed")
        cap, most = int(squares[0, 0, 0]), int(squares.max())
        for axis in range(3):
            for layers in (slice(0, EDGE), slice(-EDGE, None)):
                outer = np.moveaxis(squares, axis, 0)[layers]
                if int(outer.min()) != cap or most > cap:
                    raise FieldError(
                        f"map field: squares from {int(outer.min())} to {int(outer.max())} in the outermost {EDGE} "
                        f"layers along axis {axis}, and up to {most} elsewhere; all of these layers must be at the "
                        f"cap, {cap}"
                    )
        # A copy: JAX may otherwise go on reading the very memory in which the map grows.
        return cls(jnp.array(squares, copy=True), jax.device_put(first), jax.device_put(np.float64(spacing)))

    @property
    def cap(self) -> float:
        """The largest value, that of all points beyond the box, m."""
        return float(self.spacing) * math.sqrt(int(self.squares[0, 0, 0]))

    def error_bound(self, radius: float) -> float:
        """Give e_h, m: where what is not known free is `radius` m away, the field says at most e_h more."""
        return math.hypot(radius, float(self.spacing)) - radius + self.evaluation_error

    def require_no_less(self, before: "MapField") -> None:
        """Refuse to come after another map's field if it is of another grid, or lower anywhere.

        Raises:
            FieldError: the message says which.

        """
        for name in ("origin", "spacing"):
            now, then = np.asarray(getattr(self, name)), np.asarray(getattr(before, name))
            if not np.array_equal(now, then):
                raise FieldError(f"map field: {name} {now.tolist()} m comes after {then.tolist()} m; it must stay")
        now, then = np.asarray(self.squares), np.asarray(before.squares)
        if now.shape != then.shape:
            raise FieldError(f"map field: {now.shape} nodes come after {then.shape}; they must be the same")
        # Layer by layer: a whole map's comparison would take half the map's memory again.
        fallen = sum(int(np.count_nonzero(one < other)) for one, other in zip(now, then, strict=True))
        if fallen:
            raise FieldError(
                f"map field: {fallen} nodes are nearer to what is not known free than in the map before; free room "
                "may only grow"
            )

    @property
    def evaluation_error(self) -> float:
        """Bound, m, of what float64 and any order of sums make of the exact spline (docs/mapping.md)."""
        return 2.0**-53 * (256.0 * self.cap + 16.0 * float(self.spacing) * max(self.squares.shape))

    def _places(self, points: Float[Array, "n 3"]) -> tuple[Int32[Array, "n 3"], Float[Array, "n 3"]]:
        """Give the first node of each point's 4 × 4 × 4 coefficients, and its place in the middle cell."""
        last = jnp.asarray(self.squares.shape) - 2.0
        # Beyond these nodes all coefficients are at the cap, so the nearest point within says the same.
        held = jnp.clip((points - self.origin) / self.spacing, 1.0, last)
        cell = jnp.minimum(jax.lax.stop_gradient(jnp.floor(held)), last - 1.0)
        return cell.astype(jnp.int32) - 1, held - cell

    def value(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Distance to all that is not known free, in metres, at most the cap."""
        found = joined_rows(_value, self.squares, self._places(points.reshape(-1, 3)))
        return of_places(points, (self.spacing * found).reshape(points.shape[:-1]))

    def value_and_gradient(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"]]:
        """Distance in metres and its gradient."""
        value, gradient = joined_rows(_first, self.squares, self._places(points.reshape(-1, 3)))
        return of_places(points, (self.spacing * value).reshape(points.shape[:-1])), gradient.reshape(points.shape)

    def value_gradient_hessian(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Distance in metres, gradient, and Hessian in 1/m."""
        batch = points.shape[:-1]
        value, gradient, hessian = joined_rows(_second, self.squares, self._places(points.reshape(-1, 3)))
        return (
            of_places(points, (self.spacing * value).reshape(batch)),
            gradient.reshape(points.shape),
            (hessian / self.spacing).reshape(*batch, 3, 3),
        )


_Weights = tuple[Float[Array, "n"], ...]
"""Of the four coefficients along one axis."""
_At = tuple[Int32[Array, "n 3"], Float[Array, "n 3"]]


def _taken(squares: UInt16[Array, "nx ny nz"], at: _At) -> tuple[Float[Array, "4 4 4 n"], list]:
    """Look up the coefficients of each place, in cells, places last; and the weights along each axis, by derivative."""
    start, place = at
    blocks = jax.vmap(lambda node: jax.lax.dynamic_slice(squares, node, (4, 4, 4)))(start)
    return jnp.sqrt(rows_last(blocks).astype(jnp.float64)), [_cubic_weights(place[:, axis]) for axis in range(3)]


def _value(squares: UInt16[Array, "nx ny nz"], at: _At) -> Float[Array, "n"]:
    found, ((x, *_), (y, *_), (z, *_)) = _taken(squares, at)
    return _contracted(_contracted(_contracted(found, x), y), z)


def _first(squares: UInt16[Array, "nx ny nz"], at: _At) -> tuple[Float[Array, "n"], Float[Array, "n 3"]]:
    found, ((x, dx, _), (y, dy, _), (z, dz, _)) = _taken(squares, at)
    along, across = _contracted(found, x), _contracted(found, dx)
    both = _contracted(along, y)
    gradient = _contracted(_contracted(across, y), z), _contracted(_contracted(along, dy), z), _contracted(both, dz)
    return _contracted(both, z), jnp.stack(gradient, axis=-1)


def _second(
    squares: UInt16[Array, "nx ny nz"], at: _At
) -> tuple[Float[Array, "n"], Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    found, (x, y, z) = _taken(squares, at)
    planes = [_contracted(found, weights) for weights in x]

    def derivative(i: int, j: int, k: int) -> Float[Array, "n"]:
        return _contracted(_contracted(planes[i], y[j]), z[k])

    gradient = [derivative(1, 0, 0), derivative(0, 1, 0), derivative(0, 0, 1)]
    xy, xz, yz = derivative(1, 1, 0), derivative(1, 0, 1), derivative(0, 1, 1)
    rows = [[derivative(2, 0, 0), xy, xz], [xy, derivative(0, 2, 0), yz], [xz, yz, derivative(0, 0, 2)]]
    hessian = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return derivative(0, 0, 0), jnp.stack(gradient, axis=-1), hessian


def _cubic_weights(t: Float[Array, "n"]) -> tuple[_Weights, _Weights, _Weights]:
    """Give the four weights at places t in [0, 1] of the middle cell, and their first and second derivatives.

    No weight is below 0, in floating point neither: 4 − 6t² + 3t³ is at least 1.
    """
    s = 1.0 - t
    value = (
        s**3 / 6.0,
        (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0,
        (4.0 - 6.0 * s**2 + 3.0 * s**3) / 6.0,
        t**3 / 6.0,
    )
    slope = (-0.5 * s**2, 1.5 * t**2 - 2.0 * t, 2.0 * s - 1.5 * s**2, 0.5 * t**2)
    return value, slope, (s, 3.0 * t - 2.0, 3.0 * s - 2.0, t)


def _contracted(blocks: Float[Array, "4 *rest n"], weights: Sequence[Float[Array, "n"]]) -> Float[Array, "*rest n"]:
    """Sum over the first axis with one weight a cell, cells last.

    The barrier keeps XLA from writing the sums of several axes into one expression of 64 terms, which takes minutes to
    compile.
    """
    terms = [weight * block for weight, block in zip(weights, blocks, strict=True)]
    return jax.lax.optimization_barrier(functools.reduce(jnp.add, terms))

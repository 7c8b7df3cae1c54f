"""A field of your own: any JAX function of a point, with a bound of its gradient that you state or that was sampled.

And one in closed form, a ball: a truth for tests, and a baseline that needs no learning.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.compiled.tried import Asked
from keepout.core.errors import FieldError
from keepout.core.fields.field import Field, Hessians, Points, Values, of_places, values_and_gradients, within_numbers

Corner = Sequence[float] | Float[np.ndarray, "3"]
"""Of a box, m."""
_LOOSE = 1.0 + 1e-9
"""Relative: a stated bound is not broken by the rounding of a gradient."""


class FunctionField(Field):
    """A signed distance f̃(p) in metres, of a JAX function of one point (3,) m; derivatives are JAX's.

    Build it with `stated_field` or `sampled_field`, which look at it first.

    Attributes:
        function: from a point (3,) m, body frame, float64, to a number in metres; twice differentiable. A pytree, such
            as an equinox module, keeps its own arrays.
        lipschitz: bound of ‖∇f̃‖.
        kind: "stated" where whoever made it vouches for that bound; "sampled" where it is the largest that was found
            and an allowance, which proves nothing.

    """

    function: Callable[[Float[Array, "3"]], Float[Array, ""]]
    lipschitz: float = eqx.field(static=True)
    kind: Literal["stated", "sampled"] = eqx.field(static=True)

    def _at(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        return of_places(point, self.function(within_numbers(point)))

    def value(self, points: Points) -> Values:
        """Signed distance in metres."""
        return jax.vmap(self._at)(points.reshape(-1, 3)).reshape(points.shape[:-1])

    def value_and_gradient(self, points: Points) -> tuple[Values, Points]:
        """Signed distance in metres and its gradient."""
        value, gradient = jax.vmap(jax.value_and_grad(self._at))(points.reshape(-1, 3))
        return value.reshape(points.shape[:-1]), gradient.reshape(points.shape)

    def value_gradient_hessian(self, points: Points) -> tuple[Values, Points, Hessians]:
        """Signed distance in metres, gradient, and Hessian in 1/m."""
        value, gradient = self.value_and_gradient(points)
        hessian = jax.vmap(jax.hessian(self._at))(points.reshape(-1, 3))
        return value, gradient, hessian.reshape(*points.shape, 3)


def stated_field(
    function: Callable[[Float[Array, "3"]], Float[Array, ""]],
    lipschitz: float,
    *,
    lower: Corner,
    upper: Corner,
    samples: int = 20_000,
    seed: int = 0,
) -> FunctionField:
    """Make a field of a function whose gradient you bound; the bound is tried, not proved.

    Args:
        function: from a point (3,) m, body frame, to metres: see `FunctionField`.
        lipschitz: bound of ‖∇f̃‖ everywhere, which you vouch for: what is proved by it is as true as it is.
        lower: corner of the box, m, in which points are drawn to try it.
        upper: opposite corner, m.
        samples: how many.
        seed: of the points.

    Raises:
        FieldError: the bound is no positive number, or a gradient above it or a value that is no number is found.

    """
    number = isinstance(lipschitz, int | float | np.number) and not isinstance(lipschitz, bool)
    if not (number and math.isfinite(lipschitz) and lipschitz > 0.0):
        raise FieldError(f"field: a Lipschitz bound of {lipschitz!r}; it must be a number, positive and finite")
    field = FunctionField(function, float(lipschitz), "stated")
    steepest, where = _steepest(field, lower, upper, samples, seed)
    if steepest > lipschitz * _LOOSE:
        raise FieldError(
            f"field: a Lipschitz bound of {lipschitz:.6g} is stated, and the gradient at {where.round(3).tolist()} m "
            f"is {steepest:.6g}; state at least that"
        )
    return field


def sampled_field(
    function: Callable[[Float[Array, "3"]], Float[Array, ""]],
    *,
    lower: Corner,
    upper: Corner,
    allowance: float = 0.1,
    samples: int = 20_000,
    seed: int = 0,
) -> FunctionField:
    """Make a field of a function whose steepest gradient is looked for in a box, and which is named "sampled".

    Args:
        function: from a point (3,) m, body frame, to metres: see `FunctionField`.
        lower: corner of the box, m.
        upper: opposite corner, m.
        allowance: relative, on top of the largest gradient found.
        samples: points drawn.
        seed: of the points.

    Raises:
        FieldError: a value or gradient that is not a number is found.

    """
    steepest, _ = _steepest(FunctionField(function, math.inf, "sampled"), lower, upper, samples, seed)
    return FunctionField(function, (1.0 + allowance) * steepest, "sampled")


def _corner(name: str, corner: Any) -> Float[np.ndarray, "3"]:
    try:
        place = np.asarray(corner, np.float64)
    except (TypeError, ValueError):
        place = np.full(0, np.nan)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise FieldError(f"field: {name} {corner!r}; it must be three finite numbers, m")
    return place


def _steepest(
    field: FunctionField, lower: Corner, upper: Corner, samples: int, seed: int
) -> tuple[float, Float[np.ndarray, "3"]]:
    asked = Asked("field: the function", "one number of floats, an array (), for a point (3,)", FieldError)
    asked.require_numbers(asked.tried(lambda point: field.function(point), jnp.zeros(3)), ())
    low, high = (_corner(name, corner) for name, corner in (("lower", lower), ("upper", upper)))
    if not (low < high).all():
        raise FieldError(f"field: lower {low.tolist()} must be below upper {high.tolist()} along every axis")
    points = np.random.default_rng(seed).uniform(low, high, (samples, 3))
    found, gradients = values_and_gradients(field, points)
    wrong = ~(np.isfinite(found) & np.isfinite(gradients).all(axis=1))
    if wrong.any():
        raise FieldError(f"field: value or gradient at {points[wrong][0].round(3).tolist()} m is not a finite number")
    size = np.linalg.norm(gradients, axis=1)
    return float(size.max()), points[size.argmax()]


class SphereField(Field):
    """‖p - c‖ - ρ, exact and smooth everywhere but at the centre, where the gradient is taken as zero.

    Attributes:
        centre: (3,) metres.
        radius: ρ, metres.

    """

    centre: Float[Array, "3"]
    radius: Float[Array, ""]

    def value(self, points: Points) -> Values:
        """Signed distance in metres."""
        y = within_numbers(points) - self.centre
        return of_places(points, jnp.sqrt(jnp.sum(y**2, axis=-1)) - self.radius)

    def value_gradient_hessian(self, points: Points) -> tuple[Values, Points, Hessians]:
        """Signed distance in metres, u = y/‖y‖, and (I - u uᵀ)/‖y‖ in 1/m."""
        y = within_numbers(points) - self.centre
        r = jnp.sqrt(jnp.sum(y * y, axis=-1))
        inverse = jnp.where(r > 0.0, 1.0 / jnp.where(r > 0.0, r, 1.0), 0.0)
        u = y * inverse[..., None]
        across = jnp.eye(3) - u[..., :, None] * u[..., None, :]
        return of_places(points, r - self.radius), u, across * inverse[..., None, None]

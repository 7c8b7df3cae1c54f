"""What a sample's error is made of: noise within a ball, Gaussian noise, a bias that wanders, outliers.

An error is a sum of parts. It has a dimension n: 1 for a range (m), 3 for a position (m), a velocity (m/s) or a small
rotation (rad). A part draws from standard normal numbers that it is handed, as many as it says it takes, so that a
sensor asks the random generator once a sample.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree
from scipy import special, stats

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import as_float64

Scalar = Float[Array, ""]


class ErrorPart(eqx.Module):
    """One part of an error, with a memory."""

    @abc.abstractmethod
    def normals(self, dimension: int) -> int:
        """Count the standard normal numbers that a draw takes."""

    @abc.abstractmethod
    def draw(
        self, state: PyTree, normals: Float[Array, " k"], dimension: int
    ) -> tuple[PyTree, Float[Array, " dimension"]]:
        """Give the error of this control period; called once a period."""

    @abc.abstractmethod
    def variance(self, dimension: int) -> Scalar:
        """Give the variance of each component, at any one time."""

    @abc.abstractmethod
    def bound(self) -> Scalar:
        """Give the length that the part does not pass, but for the probability of `beyond`."""

    def initial_state(self, normals: Float[Array, " k"], dimension: int) -> PyTree:
        """Give the memory before the first draw; none."""
        return ()

    def beyond(self, dimension: int) -> float:
        """Give a bound on the probability that one draw passes `bound`; zero."""
        return 0.0


class BallNoise(ErrorPart):
    """Noise drawn evenly from the ball of a radius, anew in each period: nothing is ever beyond it.

    Attributes:
        radius: m, m/s or rad.

    Raises:
        ScenarioError: a radius that is negative or not finite.

    """

    radius: Scalar = eqx.field(converter=as_float64)

    def __check_init__(self):
        _check("noise radius", self.radius)

    def normals(self, dimension: int) -> int:
        """Count two more than the error has components."""
        return dimension + 2

    def draw(
        self, state: PyTree, normals: Float[Array, " k"], dimension: int
    ) -> tuple[PyTree, Float[Array, " dimension"]]:
        """Draw from the ball."""
        return state, self.radius * _in_unit_ball(normals, dimension)

    def variance(self, dimension: int) -> Scalar:
        """Give ρ²/(n + 2)."""
        return self.radius**2 / (dimension + 2)

    def bound(self) -> Scalar:
        """Give the radius."""
        return self.radius


class GaussianNoise(ErrorPart):
    """Gaussian noise, anew in each period. It has no bound: `sigmas` says how much of it is counted on.

    Attributes:
        std: standard deviation of each component, m, m/s or rad.
        sigmas: the length that is taken for a bound, in standard deviations of a component.

    Raises:
        ScenarioError: a number that is negative or not finite.

    """

    std: Scalar = eqx.field(converter=as_float64)
    sigmas: float = eqx.field(static=True, default=6.0)

    def __check_init__(self):
        _check("noise standard deviation", self.std)
        _check("sigmas", self.sigmas)

    def normals(self, dimension: int) -> int:
        """Count one a component."""
        return dimension

    def draw(
        self, state: PyTree, normals: Float[Array, " k"], dimension: int
    ) -> tuple[PyTree, Float[Array, " dimension"]]:
        """Draw each component."""
        return state, self.std * normals

    def variance(self, dimension: int) -> Scalar:
        """Give σ²."""
        return self.std**2

    def bound(self) -> Scalar:
        """Give `sigmas` standard deviations: passed with the probability of `beyond`."""
        return self.sigmas * self.std

    def beyond(self, dimension: int) -> float:
        """Give the tail of the χ distribution with as many degrees of freedom as there are components."""
        return float(stats.chi2.sf(self.sigmas**2, dimension))


class WanderingBias(ErrorPart):
    """A bias that wanders within a ball: a random walk, reflected at the ball's surface.

    It starts anywhere in the ball, drawn evenly. That is what it stays distributed like, for steps small against the
    ball; so the variance is that of the ball.

    Attributes:
        radius: of the ball, m, m/s or rad.
        step: the largest change in a control period, likewise; 0 for a constant bias.

    Raises:
        ScenarioError: a number that is negative or not finite, or a step beyond the radius.

    """

    radius: Scalar = eqx.field(converter=as_float64)
    step: Scalar = eqx.field(converter=as_float64, default=0.0)

    def __check_init__(self):
        _check("bias radius", self.radius)
        _check("bias step", self.step)
        if _beyond(self.step, self.radius):
            step, radius = np.asarray(self.step).tolist(), np.asarray(self.radius).tolist()
            raise ScenarioError(f"bias step: {step}; it must be at most the radius {radius}")

    def normals(self, dimension: int) -> int:
        """Count two more than the error has components."""
        return dimension + 2

    def initial_state(self, normals: Float[Array, " k"], dimension: int) -> PyTree:
        """Draw the bias from its ball."""
        return self.radius * _in_unit_ball(normals, dimension)

    def draw(
        self, state: PyTree, normals: Float[Array, " k"], dimension: int
    ) -> tuple[PyTree, Float[Array, " dimension"]]:
        """Give the bias, and take a step."""
        moved = state + self.step * _in_unit_ball(normals, dimension)
        length = jnp.linalg.norm(moved)
        outside = length > self.radius
        # At most one radius beyond the surface, so the reflected point is inside.
        shrink = jnp.where(outside, (2.0 * self.radius - length) / jnp.where(outside, length, 1.0), 1.0)
        return shrink * moved, state

    def variance(self, dimension: int) -> Scalar:
        """Give ρ²/(n + 2): it is even in the ball."""
        return self.radius**2 / (dimension + 2)

    def bound(self) -> Scalar:
        """Give the radius."""
        return self.radius


class Outliers(ErrorPart):
    """Now and then an error of a stated length in a random direction.

    Outliers are beyond every bound and no part of the covariance: a filter must gate them, and the set-membership
    estimate must find that they contradict what it knows. No estimate is certain with them: `beyond` is their
    probability.

    Attributes:
        probability: of each sample, above 0 and below 1.
        size: m, m/s or rad.

    Raises:
        ScenarioError: a probability outside (0, 1), or a size that is negative or not finite.

    """

    probability: float = eqx.field(static=True)
    size: Scalar = eqx.field(converter=as_float64)

    def __check_init__(self):
        _check("outlier size", self.size)
        if not 0.0 < self.probability < 1.0:
            raise ScenarioError(f"outlier probability: {self.probability:g}; it must be above 0 and below 1")

    def normals(self, dimension: int) -> int:
        """Count one more than the error has components."""
        return dimension + 1

    def draw(
        self, state: PyTree, normals: Float[Array, " k"], dimension: int
    ) -> tuple[PyTree, Float[Array, " dimension"]]:
        """Draw whether there is one, and its direction."""
        direction = normals[1:] / jnp.linalg.norm(normals[1:])
        return state, jnp.where(normals[0] < special.ndtri(self.probability), self.size, 0.0) * direction

    def variance(self, dimension: int) -> Scalar:
        """Give zero: a filter leaves outliers out."""
        return jnp.zeros(())

    def bound(self) -> Scalar:
        """Give zero: passed with the probability of `beyond`."""
        return jnp.zeros(())

    def beyond(self, dimension: int) -> float:
        """Give the probability of an outlier."""
        return self.probability


class ErrorModel(eqx.Module):
    """The sum of some parts.

    Attributes:
        parts: none for a sensor that tells the truth.
        dimension: of the error.

    """

    parts: tuple[ErrorPart, ...] = eqx.field(converter=tuple)
    dimension: int = eqx.field(static=True, default=3)

    def normals(self) -> int:
        """Count the standard normal numbers that a draw, or a start, takes."""
        return sum(part.normals(self.dimension) for part in self.parts)

    def initial_state(self, normals: Float[Array, " k"]) -> PyTree:
        """Start each part."""
        own = self._own(normals)
        return tuple(part.initial_state(some, self.dimension) for part, some in zip(self.parts, own, strict=True))

    def draw(self, state: PyTree, normals: Float[Array, " k"]) -> tuple[PyTree, Float[Array, " dimension"]]:
        """Add up the parts; called once a control period."""
        total, states = jnp.zeros(self.dimension), []
        for part, memory, some in zip(self.parts, state, self._own(normals), strict=True):
            memory, error = part.draw(memory, some, self.dimension)
            states.append(memory)
            total = total + error
        return tuple(states), total

    def variance(self) -> Scalar:
        """Give the variance of each component of the sum: the parts are independent."""
        return sum((part.variance(self.dimension) for part in self.parts), start=jnp.zeros(()))

    def bound(self) -> Scalar:
        """Give the length that the sum does not pass, but for the probability of `beyond`."""
        return sum((part.bound() for part in self.parts), start=jnp.zeros(()))

    def beyond(self) -> float:
        """Give a bound on the probability that one draw passes `bound`: the sum over the parts."""
        return min(1.0, sum(part.beyond(self.dimension) for part in self.parts))

    def _own(self, normals: Float[Array, " k"]) -> list[Float[Array, " _"]]:
        pieces, first = [], 0
        for part in self.parts:
            last = first + part.normals(self.dimension)
            pieces.append(normals[first:last])
            first = last
        return pieces


def _in_unit_ball(normals: Float[Array, " k"], dimension: int) -> Float[Array, " dimension"]:
    """Give a point that is even in the unit ball of n dimensions.

    It is the first n coordinates of a point that is even on the unit sphere of n + 2 dimensions.
    """
    return normals[:dimension] / jnp.linalg.norm(normals)


def _check(name: str, value: float | Scalar) -> None:
    if isinstance(value, Tracer):
        return  # values are not known yet inside a transformation
    if not (bool(jnp.all(jnp.isfinite(value))) and bool(jnp.all(jnp.asarray(value) >= 0.0))):
        raise ScenarioError(f"{name}: {np.asarray(value).tolist()}; it must be finite and at least 0")


def _beyond(value: Scalar, limit: Scalar) -> bool:
    if isinstance(value, Tracer) or isinstance(limit, Tracer):
        return False
    return bool(jnp.any(value > limit))

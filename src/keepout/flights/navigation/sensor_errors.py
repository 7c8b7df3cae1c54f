"""What a sample's error is made of, and when it arrives: noise, biases and outliers; rate, losses and latency.

An error is a sum of parts. It has a dimension n: 1 for a range (m), 3 for a position (m), a velocity (m/s) or a small
rotation (rad). A part draws from standard normal numbers that it is handed, as many as it says it takes, so that a
sensor asks the random generator once a sample.
"""

import abc
import itertools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree
from scipy import special, stats

from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Sample
from keepout.core.motion.arrays import as_float64

Scalar = Float[Array, ""]
Normals = Float[Array, " k"]
"""Standard normal numbers."""
Drawn = Float[Array, " dimension"]
"""An error."""


class ErrorPart(eqx.Module):
    """One part of an error, with a memory."""

    @abc.abstractmethod
    def normals(self, dimension: int) -> int:
        """Count the standard normal numbers that a draw takes."""

    @abc.abstractmethod
    def draw(self, state: PyTree, normals: Normals, dimension: int) -> tuple[PyTree, Drawn]:
        """Give the error of this control period; called once a period."""

    @abc.abstractmethod
    def variance(self, dimension: int) -> Scalar:
        """Give the variance of each component, at any one time."""

    @abc.abstractmethod
    def bound(self) -> Scalar:
        """Give the length that the part does not pass, but for the probability of `beyond`."""

    def initial_state(self, normals: Normals, dimension: int) -> PyTree:
        """Give the memory before the first draw; none."""
        return ()

    def beyond(self, dimension: int) -> float:
        """Give a bound on the probability that one draw passes `bound`; zero."""
        return 0.0


class _InBall(ErrorPart):
    """An error that is even in a ball of a radius: nothing is ever beyond it."""

    radius: Scalar = eqx.field(converter=as_float64)

    def normals(self, dimension: int) -> int:
        """Count two more than the error has components."""
        return dimension + 2

    def variance(self, dimension: int) -> Scalar:
        """Give ρ²/(n + 2)."""
        return self.radius**2 / (dimension + 2)

    def bound(self) -> Scalar:
        """Give the radius."""
        return self.radius


class BallNoise(_InBall):
    """Noise drawn evenly from the ball of a radius, anew in each period: nothing is ever beyond it.

    Attributes:
        radius: m, m/s or rad.

    Raises:
        ScenarioError: a radius that is negative or not finite.

    """

    def __check_init__(self):
        _check("noise radius", self.radius)

    def draw(self, state: PyTree, normals: Normals, dimension: int) -> tuple[PyTree, Drawn]:
        """Draw from the ball."""
        return state, self.radius * _in_unit_ball(normals, dimension)


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

    def draw(self, state: PyTree, normals: Normals, dimension: int) -> tuple[PyTree, Drawn]:
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


class WanderingBias(_InBall):
    """A bias that wanders within a ball: a random walk, reflected at the ball's surface.

    It starts anywhere in the ball, drawn evenly. That is what it stays distributed like, for steps small against the
    ball; so the variance is that of the ball.

    Attributes:
        radius: of the ball, m, m/s or rad.
        step: the largest change in a control period, likewise; 0 for a constant bias.

    Raises:
        ScenarioError: a number that is negative or not finite, or a step beyond the radius.

    """

    step: Scalar = eqx.field(converter=as_float64, default=0.0)

    def __check_init__(self):
        _check("bias radius", self.radius)
        _check("bias step", self.step)
        if _beyond(self.step, self.radius):
            step, radius = np.asarray(self.step).tolist(), np.asarray(self.radius).tolist()
            raise ScenarioError(f"bias step: {step}; it must be at most the radius {radius}")

    def initial_state(self, normals: Normals, dimension: int) -> PyTree:
        """Draw the bias from its ball."""
        return self.radius * _in_unit_ball(normals, dimension)

    def draw(self, state: PyTree, normals: Normals, dimension: int) -> tuple[PyTree, Drawn]:
        """Give the bias, and take a step."""
        moved = state + self.step * _in_unit_ball(normals, dimension)
        length = jnp.linalg.norm(moved)
        outside = length > self.radius
        # At most one radius beyond the surface, so the reflected point is inside.
        shrink = jnp.where(outside, (2.0 * self.radius - length) / jnp.where(outside, length, 1.0), 1.0)
        return shrink * moved, state


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

    def draw(self, state: PyTree, normals: Normals, dimension: int) -> tuple[PyTree, Drawn]:
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

    def initial_state(self, normals: Normals) -> PyTree:
        """Start each part."""
        own = self._own(normals)
        return tuple(part.initial_state(some, self.dimension) for part, some in zip(self.parts, own, strict=True))

    def draw(self, state: PyTree, normals: Normals) -> tuple[PyTree, Drawn]:
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

    def _own(self, normals: Normals) -> list[Float[Array, " _"]]:
        return pieces(normals, [part.normals(self.dimension) for part in self.parts])


def pieces(normals: Normals, counts: Sequence[int]) -> list[Float[Array, " _"]]:
    """Cut numbers into pieces of these lengths."""
    ends = list(itertools.accumulate(counts))
    return [normals[end - count : end] for end, count in zip(ends, counts)]


def _in_unit_ball(normals: Normals, dimension: int) -> Drawn:
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


class Arrival(eqx.Module):
    """A line of samples: taken every so many control periods from the first step on, lost now and then, and late.

    Nothing is under way when a flight starts: what arrives in its first `latency` steps has not come.

    Attributes:
        every: control periods between samples, at least 1.
        latency: whole control periods from a sample to its arrival.
        dropout: probability that a sample is lost, 0 to 1.
        most_missed: samples that can be lost in a row; after so many the next one comes.

    Raises:
        ScenarioError: a number outside its range, or a dropout without a number of samples that it may take.

    """

    every: int = eqx.field(static=True, default=1)
    latency: int = eqx.field(static=True, default=0)
    dropout: float = eqx.field(static=True, default=0.0)
    most_missed: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        for name, value, least in (("every", self.every, 1), ("latency", self.latency, 0)):
            if value != int(value) or value < least:
                raise ScenarioError(f"sensor: {name} is {value} control periods; it must be a whole number >= {least}")
        if self.most_missed != int(self.most_missed) or self.most_missed < 0:
            raise ScenarioError(f"sensor: most_missed is {self.most_missed}; it must be a whole number >= 0")
        if not 0.0 <= self.dropout <= 1.0:
            raise ScenarioError(f"sensor: dropout is {self.dropout:g}; it must be a probability, 0 to 1")
        if self.dropout > 0.0 and self.most_missed == 0:
            raise ScenarioError(f"sensor: dropout is {self.dropout:g} but most_missed is 0; it must be at least 1")

    @property
    def normals(self) -> int:
        """How many standard normal numbers a step takes."""
        return int(self.dropout > 0.0)

    @property
    def oldest(self) -> int:
        """Age in control periods that the newest sample known can reach, once one has come."""
        return self.latency + self.every * (self.most_missed + 1) - 1

    def initial_state(self, value: Float[Array, " n"]) -> PyTree:
        """Give an empty line for samples that look like `value`."""
        line = jnp.zeros((self.latency, *value.shape)), jnp.zeros(self.latency, bool)
        return jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32), line

    def step(self, state: PyTree, value: Float[Array, " n"], normals: Normals) -> tuple[PyTree, Sample]:
        """Put in what would be measured now, and give what arrives now; called once a control period."""
        count, missed, (values, came) = state
        taken = count % self.every == 0
        if self.dropout > 0.0:
            lost = taken & (normals[0] < special.ndtri(self.dropout)) & (missed < self.most_missed)
            missed = jnp.where(taken, jnp.where(lost, missed + 1, 0), missed)
            taken = taken & ~lost
        # Only the step's place in the rhythm is counted, so that no flight is too long for it.
        count = (count + 1) % self.every
        values, came = jnp.concatenate([values, value[None]]), jnp.concatenate([came, taken[None]])
        return (count, missed, (values[1:], came[1:])), Sample(values[0], came[0])

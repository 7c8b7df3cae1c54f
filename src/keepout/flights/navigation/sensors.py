"""The sensors: relative position and velocity, range and bearing, range rate, attitude of the target.

docs/motion.md proves each ball. What is measured in axes of the orbital frame (VVLH) is turned into the body's by
the attitude of the estimate, whose error is bounded by `attitude_error`.
"""

import abc
import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Ball, Sample, Sensor
from keepout.core.motion import rotation
from keepout.core.motion.arrays import Vector, as_float64, norm
from keepout.core.motion.relative import MotionState
from keepout.core.motion.rotation import Quaternion
from keepout.flights.navigation.sensor_errors import Arrival, ErrorModel, ErrorPart, pieces

Scalar = Float[Array, ""]

AXES = ("body", "vvlh")
"""Axes that a vector can be measured in."""
ROUNDING = 1e-13
"""Part of a ball's radius and of the measured length that is added to the radius, against rounding of both."""


def _errors_of(dimension: int) -> Callable[[ErrorModel | tuple[ErrorPart, ...]], ErrorModel]:
    """Give what takes error parts, or an error model, for an error of so many components."""
    return lambda parts: parts if isinstance(parts, ErrorModel) else ErrorModel(parts, dimension)


class SimulatedSensor(Sensor):
    """A sensor whose errors are drawn from error models, and whose samples arrive along a line.

    Attributes:
        every: control periods between samples, at least 1.
        latency: control periods from a sample to its arrival.
        dropout: probability that a sample is lost, 0 to 1.
        most_missed: samples that can be lost in a row; after so many the next one comes.

    Raises:
        ScenarioError: what `Arrival` refuses.

    """

    every: int = eqx.field(static=True, default=1, kw_only=True)
    latency: int = eqx.field(static=True, default=0, kw_only=True)
    dropout: float = eqx.field(static=True, default=0.0, kw_only=True)
    most_missed: int = eqx.field(static=True, default=0, kw_only=True)

    def __check_init__(self):
        _ = self.arrival

    @property
    def arrival(self) -> Arrival:
        """The line that its samples arrive along."""
        return Arrival(self.every, self.latency, self.dropout, self.most_missed)

    @property
    def error_models(self) -> tuple[ErrorModel, ...]:
        """The error models that `disturbed` wants a draw of each: the sensor's own, in the order of its fields."""
        mine = (getattr(self, field.name) for field in dataclasses.fields(self))
        return tuple(model for model in mine if isinstance(model, ErrorModel))

    @abc.abstractmethod
    def disturbed(self, truth: MotionState, errors: tuple[Float[Array, " _"], ...]) -> Float[Array, " n"]:
        """Give what it says of a state with these errors."""

    def beyond(self) -> float:
        """Give a bound on the probability that one sample's error passes what the sensor's ball allows for."""
        return min(1.0, sum(model.beyond() for model in self.error_models))

    def initial_state(self, key: PRNGKeyArray, truth: MotionState) -> PyTree:
        """Draw the biases; no sample is under way."""
        key, draw = jax.random.split(key)
        memories = tuple(model.initial_state(some) for model, some in zip(self.error_models, self._normals(draw)))
        return key, memories, self.arrival.initial_state(self.ideal(truth))

    def sample(self, state: PyTree, truth: MotionState) -> tuple[PyTree, Sample]:
        """Draw the errors, measure, and give what arrives."""
        key, memories, line = state
        key, draw = jax.random.split(key)
        *normals, last = self._normals(draw)
        drawn = [model.draw(memory, some) for model, memory, some in zip(self.error_models, memories, normals)]
        value = self.disturbed(truth, tuple(error for _, error in drawn))
        line, sample = self.arrival.step(line, value, last)
        return (key, tuple(memory for memory, _ in drawn), line), sample

    def _normals(self, key: PRNGKeyArray) -> list[Float[Array, " _"]]:
        """Draw standard normal numbers once: a piece for each error model, and one for the line."""
        counts = [*(model.normals() for model in self.error_models), self.arrival.normals]
        return pieces(jax.random.normal(key, (sum(counts),)), counts)


class _VectorSensor(SimulatedSensor):
    """A sensor of a vector, in axes of the body or of VVLH."""

    axes: str = eqx.field(static=True, default="body", kw_only=True)
    attitude_error: Scalar = eqx.field(converter=as_float64, default=0.0, kw_only=True)

    def __check_init__(self):
        if self.axes not in AXES:
            raise ScenarioError(f"sensor: axes are {self.axes!r}; valid are {', '.join(AXES)}")
        if isinstance(self.attitude_error, Tracer):
            return  # values are not known yet inside a transformation
        if not bool(jnp.all((self.attitude_error >= 0.0) & (self.attitude_error <= jnp.pi))):
            raise ScenarioError(f"sensor: attitude_error is {float(self.attitude_error):g} rad; it must lie in [0, pi]")

    def _measured(self, vector: Vector, attitude: Quaternion) -> Vector:
        return rotation.matrix(attitude).T @ vector if self.axes == "vvlh" else vector

    def _in_body(self, value: Vector, radius: Scalar, attitude: Quaternion) -> Ball:
        """Give the ball around a vector whose measurement in the sensor's axes is off by at most `radius`."""
        length = jnp.linalg.norm(value)
        rounding = ROUNDING * (length + radius)
        if self.axes == "body":
            return Ball(value, radius + rounding)
        turned = 2.0 * jnp.sin(0.5 * self.attitude_error) * (length + radius)
        return Ball(rotation.matrix(attitude) @ value, radius + turned + rounding)

    def _with_attitude_error(self, covariance: Float[Array, "3 3"], value: Vector) -> Float[Array, "3 3"]:
        """Add what an attitude that is off by a rotation vector, even in its ball, does to a vector."""
        if self.axes == "body":
            return covariance
        across = (value @ value) * jnp.eye(3) - jnp.outer(value, value)
        return covariance + self.attitude_error**2 / 5.0 * across


class _WholeVector(_VectorSensor):
    """A sensor of a vector whose components have one error."""

    errors: ErrorModel = eqx.field(converter=_errors_of(3))

    def disturbed(self, truth: MotionState, errors: tuple[Float[Array, " _"], ...]) -> Float[Array, "3"]:
        """Add the error."""
        return self.ideal(truth) + errors[0]

    def covariance(self, value: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Give the covariance of the error in the sensor's axes, in the vector's unit squared."""
        return self._with_attitude_error(self.errors.variance() * jnp.eye(3), value)


class RelativePosition(_WholeVector):
    """The relative position: a pose from camera or lidar in body axes, or differential GNSS in VVLH axes.

    Attributes:
        errors: of the position, m: error parts, or an error model of three components.
        axes: "body" or "vvlh".
        attitude_error: largest error (rad) of the attitude in the estimate, for "vvlh".
        every, latency, dropout, most_missed: as in `SimulatedSensor`.

    Raises:
        ScenarioError: other axes, or an attitude error outside [0, π].

    """

    def ideal(self, state: MotionState) -> Float[Array, "3"]:
        """Give the position in the sensor's axes, m."""
        return self._measured(state.position, state.attitude)

    def position_ball(self, value: Float[Array, "3"], estimate: MotionState) -> Ball:
        """Give the ball around the measured position."""
        return self._in_body(value, self.errors.bound(), estimate.attitude)


class RelativeVelocity(_WholeVector):
    """The relative velocity: Doppler of GNSS, or a pose that is tracked.

    It is the velocity that an observer in the body frame sees. In axes of VVLH it is that same vector; where the body
    turns against VVLH, whoever forms it on board has to know at which rate, and the error of that is part of `errors`.

    Attributes:
        errors: of the velocity, m/s: error parts, or an error model of three components.
        axes: "body" or "vvlh".
        attitude_error: largest error (rad) of the attitude in the estimate, for "vvlh".
        every, latency, dropout, most_missed: as in `SimulatedSensor`.

    Raises:
        ScenarioError: other axes, or an attitude error outside [0, π].

    """

    def ideal(self, state: MotionState) -> Float[Array, "3"]:
        """Give the velocity in the sensor's axes, m/s."""
        return self._measured(state.velocity, state.attitude)

    def velocity_ball(self, value: Float[Array, "3"], estimate: MotionState) -> Ball:
        """Give the ball around the measured velocity."""
        return self._in_body(value, self.errors.bound(), estimate.attitude)


class RangeBearing(_VectorSensor):
    """Range and two angles of the line of sight, told as one vector: the range times the measured direction, m.

    So told, the measurement is the position itself, with an error along the line of sight and another across it, and
    no direction is singular. The bearing's error is a small rotation of the line of sight, drawn as a rotation vector
    (rad) in the sensor's axes; a rotation about the line of sight itself does nothing.

    Attributes:
        range_errors: m: error parts, or an error model of one component.
        bearing_errors: rad: error parts, or an error model of three components.
        axes: "body" or "vvlh".
        attitude_error: largest error (rad) of the attitude in the estimate, for "vvlh".
        every, latency, dropout, most_missed: as in `SimulatedSensor`.

    Raises:
        ScenarioError: other axes, or an attitude error outside [0, π].

    """

    range_errors: ErrorModel = eqx.field(converter=_errors_of(1))
    bearing_errors: ErrorModel = eqx.field(converter=_errors_of(3))

    def ideal(self, state: MotionState) -> Float[Array, "3"]:
        """Give the position in the sensor's axes, m."""
        return self._measured(state.position, state.attitude)

    def disturbed(self, truth: MotionState, errors: tuple[Float[Array, " _"], ...]) -> Float[Array, "3"]:
        """Lengthen the line of sight, and turn it."""
        position = self.ideal(truth)
        direction = position / jnp.maximum(norm(position), 1e-12)
        return rotation.matrix(_small_rotation(errors[1])) @ (position + errors[0][0] * direction)

    def covariance(self, value: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Give the covariance of the error in the sensor's axes, m²."""
        along = jnp.outer(value, value) / jnp.maximum(value @ value, 1e-24)
        across = (value @ value) * self.bearing_errors.variance() * (jnp.eye(3) - along)
        return self._with_attitude_error(self.range_errors.variance() * along + across, value)

    def position_ball(self, value: Float[Array, "3"], estimate: MotionState) -> Ball:
        """Give the ball around the measured position: √(e² + 4 M (M + e) sin²(θ/2)) at a measured range M."""
        M, e = jnp.linalg.norm(value), self.range_errors.bound()
        theta = jnp.minimum(self.bearing_errors.bound(), jnp.pi)
        radius = jnp.sqrt(e**2 + 4.0 * M * (M + e) * jnp.sin(0.5 * theta) ** 2)
        return self._in_body(value, radius, estimate.attitude)


class RangeRate(SimulatedSensor):
    """The rate at which the range grows, m/s: Doppler along the line of sight.

    It proves nothing of the velocity across the line of sight, and so gives no ball; a filter takes it.

    Attributes:
        errors: m/s: error parts, or an error model of one component.
        every, latency, dropout, most_missed: as in `SimulatedSensor`.

    """

    errors: ErrorModel = eqx.field(converter=_errors_of(1))

    def ideal(self, state: MotionState) -> Float[Array, "1"]:
        """Give r·v/‖r‖, m/s; 0 at the origin."""
        return (state.position @ state.velocity / jnp.maximum(norm(state.position), 1e-12))[None]

    def disturbed(self, truth: MotionState, errors: tuple[Float[Array, " _"], ...]) -> Float[Array, "1"]:
        """Add the error."""
        return self.ideal(truth) + errors[0]

    def covariance(self, value: Float[Array, "1"]) -> Float[Array, "1 1"]:
        """Give the variance of the error, m²/s²."""
        return self.errors.variance()[None, None]


class TargetAttitude(SimulatedSensor):
    """The target's attitude as a unit quaternion body ← VVLH, off by a small rotation.

    It says nothing of position and velocity. Its bound is what `attitude_error` of the other sensors may be set to,
    where the attitude of the estimate is this measurement.

    Attributes:
        errors: rad: error parts, or an error model of three components (a rotation vector in body axes).
        every, latency, dropout, most_missed: as in `SimulatedSensor`.

    """

    errors: ErrorModel = eqx.field(converter=_errors_of(3))

    def ideal(self, state: MotionState) -> Float[Array, "4"]:
        """Give the attitude."""
        return state.attitude

    def disturbed(self, truth: MotionState, errors: tuple[Float[Array, " _"], ...]) -> Float[Array, "4"]:
        """Turn by the error after the true attitude."""
        return rotation.multiply(_small_rotation(errors[0]), truth.attitude)

    def covariance(self, value: Float[Array, "4"]) -> Float[Array, "4 4"]:
        """Give the covariance of the quaternion, to first order; it is singular along the quaternion itself."""
        return 0.25 * self.errors.variance() * (jnp.eye(4) - jnp.outer(value, value))


def _small_rotation(vector: Vector) -> Quaternion:
    """Give the unit quaternion of a rotation vector, rad: its length is the angle."""
    angle = norm(vector)
    return jnp.concatenate([jnp.cos(0.5 * angle)[None], 0.5 * jnp.sinc(0.5 * angle / jnp.pi) * vector])

"""Estimators without a model of the noise, for comparison: the last samples, taken for the truth."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from keepout.core.motion.arrays import as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.motion.rotation import Vector
from keepout.flights.navigation.estimator import Estimator
from keepout.flights.navigation.few_equations import factorised, solved, solved_back
from keepout.flights.navigation.measurement import attitude_sensors, linearised, turned
from keepout.flights.navigation.sensor import Sample, Sensor

_ROUNDING = 1e-12
"""Added to a square matrix that is 0 for a sample that says nothing of the motion: it then moves nothing."""


class CarriedSamples(Estimator):
    """The last samples, carried ahead by the motion's model until the next ones.

    A sample moves the estimate by the smallest change of position and velocity that explains it; one that gives the
    position takes its place. Samples count as of now, however late they are. No disturbance is estimated: an observer
    of the law's own does that, or nobody. Build with `CarriedSamples.build`.

    Attributes:
        motion: the model of the relative motion.
        sensors: in the order of the samples.
        mass: kg.
        period: between control steps, s.
        attitudes: which sensors give the attitude.

    """

    motion: RelativeMotion
    sensors: tuple[Sensor, ...]
    mass: Float[Array, ""]
    period: Float[Array, ""]
    attitudes: tuple[bool, ...] = eqx.field(static=True)

    @classmethod
    def build(
        cls, motion: RelativeMotion, sensors: Sequence[Sensor], *, mass: float, period: float
    ) -> "CarriedSamples":
        """Build the estimator for sensors in the order of their samples, a mass in kg and a period in s."""
        attitudes = attitude_sensors(motion, sensors)
        return cls(motion, tuple(sensors), as_float64(mass), as_float64(period), attitudes)

    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> MotionState:
        """Start from an estimate, taken for the truth."""
        return estimate

    def correct(
        self, state: MotionState, samples: tuple[Sample, ...]
    ) -> tuple[MotionState, MotionState, Int[Array, ""]]:
        """Take the samples that arrived; those that are not numbers are left out."""
        left_out = jnp.zeros((), jnp.int32)
        for sensor, sample, of_attitude in zip(self.sensors, samples, self.attitudes, strict=True):
            if of_attitude:
                attitude, out = turned(state.attitude, sample, 1.0)
                state = dataclasses.replace(state, attitude=attitude)
            else:
                finite = jnp.all(jnp.isfinite(sample.value))
                expected, H = linearised(sensor, state)
                lower = factorised(H @ H.T + _ROUNDING * jnp.eye(H.shape[0]))
                missing = jnp.where(sample.came & finite, sample.value - expected, 0.0)
                change = H.T @ solved_back(lower, solved(lower, missing))
                state = dataclasses.replace(
                    state, position=state.position + change[:3], velocity=state.velocity + change[3:]
                )
                out = sample.came & ~finite
            left_out = left_out + out
        return state, state, left_out

    def advance(self, state: MotionState, force: Vector) -> MotionState:
        """Move to the next control step under the force (N, body axes)."""
        return self.motion.step(state, force, NoDisturbance(), self.period, self.mass)


class RawSamples(CarriedSamples):
    """The last samples as they are, held until the next ones; only attitude and rates are carried by the model."""

    def advance(self, state: MotionState, force: Vector) -> MotionState:
        """Move time and attitude to the next control step."""
        moved = super().advance(state, force)
        return dataclasses.replace(moved, position=state.position, velocity=state.velocity)

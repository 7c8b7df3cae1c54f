"""What estimators are to the flight loop: one for the law, which may be wrong, and one for the guard, which may not.

Both are asked in the same order at every control step: `correct` with the samples that arrived, then, when law and
guard have decided, `advance` with the force that will act until the next step.
"""

import abc

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int, PyTree

from keepout.core.motion.relative import MotionState
from keepout.core.motion.rotation import Vector
from keepout.flights.navigation.sensor import Sample


class Estimator(eqx.Module):
    """The law's estimate of the motion, and of the disturbance where it models one."""

    @abc.abstractmethod
    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> PyTree:
        """Start from an estimate whose position (m) and velocity (m/s) are off by at most `errors`."""

    @abc.abstractmethod
    def correct(self, state: PyTree, samples: tuple[Sample, ...]) -> tuple[PyTree, MotionState, Int[Array, ""]]:
        """Take the samples that arrived, one a sensor.

        Returns:
            The memory; the estimate now, with `disturbance` (the mean force to come over the period that begins, N)
            where it is modelled and None where it is not; and how many samples were left out as outliers.

        """

    @abc.abstractmethod
    def advance(self, state: PyTree, force: Vector) -> PyTree:
        """Move to the next control step under the force (N, body axes) that acts until then."""


class KnownSet(eqx.Module):
    """A state that is certainly known within two radii.

    Attributes:
        state: its centre, with the attitude and rates of the law's estimate.
        errors: radii ε_r of the position (m) and ε_v of the velocity (m/s) about it.
        contradicted: whether the samples of this step cannot all be within their bounds.

    """

    state: MotionState
    errors: Float[Array, "2"]
    contradicted: Bool[Array, ""]


class BoundedEstimator(eqx.Module):
    """The guard's estimate: a set that holds the truth as long as noise and acceleration keep to their bounds."""

    @abc.abstractmethod
    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> PyTree:
        """Start from an estimate whose position (m) and velocity (m/s) are off by at most `errors`."""

    @abc.abstractmethod
    def correct(self, state: PyTree, samples: tuple[Sample, ...], estimate: MotionState) -> tuple[PyTree, KnownSet]:
        """Cut the set with the samples that arrived; `estimate` is the law's, for attitude and rates."""

    @abc.abstractmethod
    def advance(self, state: PyTree, force: Vector) -> PyTree:
        """Move to the next control step under the commanded force (N, body axes) that acts until then."""

"""A suite: the sensors of a chaser together."""

import equinox as eqx
import jax
from jaxtyping import PRNGKeyArray, PyTree

from keepout.core.errors import ScenarioError
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.sensor import Sample, Sensor
from keepout.flights.navigation.simulated import SimulatedSensor


class Suite(eqx.Module):
    """Some sensors, each with a random stream of its own.

    Attributes:
        sensors: at least one.

    Raises:
        ScenarioError: no sensor.

    """

    sensors: tuple[Sensor, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        if not self.sensors:
            raise ScenarioError("suite: it has 0 sensors; it must have at least 1, one of the position among them")

    def initial_state(self, key: PRNGKeyArray, truth: MotionState) -> tuple[PyTree, ...]:
        """Start every sensor with a key of its own."""
        return tuple(sensor.initial_state(jax.random.fold_in(key, i), truth) for i, sensor in enumerate(self.sensors))

    def sample(self, states: tuple[PyTree, ...], truth: MotionState) -> tuple[tuple[PyTree, ...], tuple[Sample, ...]]:
        """Give what arrives of every sensor at this control step; called once a period."""
        both = [sensor.sample(state, truth) for sensor, state in zip(self.sensors, states, strict=True)]
        return tuple(state for state, _ in both), tuple(sample for _, sample in both)

    def probability_beyond(self, steps: int) -> float:
        """Bound the probability per flight that some sample is beyond the ball that its sensor draws around it.

        Gaussian noise and outliers have no bound, so that the set-membership estimate holds the truth with a
        probability only: at least 1 minus this one. It adds up the samples' (a union bound), lost ones included, and
        assumes nothing of how they depend on each other. Zero where all noise is bounded.

        Args:
            steps: control periods of the flight; a sample is taken at its start too.

        """
        total = 0.0
        for sensor in self.sensors:
            if isinstance(sensor, SimulatedSensor):
                total += (steps // sensor.every + 1) * sensor.beyond()
        return min(1.0, total)

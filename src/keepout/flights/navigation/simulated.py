"""What all simulated sensors share: they add errors to what they would ideally say, and send it down a line."""

import abc

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.arrival import Arrival
from keepout.flights.navigation.error_parts import ErrorModel
from keepout.flights.navigation.sensor import Ball, Sample, Sensor


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
    @abc.abstractmethod
    def error_models(self) -> tuple[ErrorModel, ...]:
        """The error models that `disturbed` wants a draw of each."""

    @abc.abstractmethod
    def disturbed(self, truth: MotionState, errors: tuple[Float[Array, " _"], ...]) -> Float[Array, " n"]:
        """Give what it says of a state with these errors."""

    def beyond(self) -> float:
        """Give a bound on the probability that one sample's error passes what the sensor's ball allows for."""
        return min(1.0, sum(model.beyond() for model in self.error_models))

    def initial_state(self, key: PRNGKeyArray, truth: MotionState) -> PyTree:
        """Draw the biases; no sample is under way."""
        key, draw = jax.random.split(key)
        pieces = self._normals(draw)
        memories = tuple(model.initial_state(some) for model, some in zip(self.error_models, pieces, strict=False))
        return key, memories, self.arrival.initial_state(self.ideal(truth))

    def sample(self, state: PyTree, truth: MotionState) -> tuple[PyTree, Sample]:
        """Draw the errors, measure, and give what arrives."""
        key, memories, line = state
        key, draw = jax.random.split(key)
        pieces = self._normals(draw)
        drawn = [model.draw(memory, some) for model, memory, some in zip(self.error_models, memories, pieces)]
        value = self.disturbed(truth, tuple(error for _, error in drawn))
        line, sample = self.arrival.step(line, value, pieces[-1])
        return (key, tuple(memory for memory, _ in drawn), line), sample

    def position_ball(self, value: Float[Array, " n"], estimate: MotionState) -> Ball | None:
        """Prove nothing of the position."""
        return None

    def velocity_ball(self, value: Float[Array, " n"], estimate: MotionState) -> Ball | None:
        """Prove nothing of the velocity."""
        return None

    def _normals(self, key: PRNGKeyArray) -> list[Float[Array, " _"]]:
        """Draw standard normal numbers once: a piece for each error model, and one for the line."""
        counts = [*(model.normals() for model in self.error_models), self.arrival.normals]
        drawn, pieces, first = jax.random.normal(key, (sum(counts),)), [], 0
        for count in counts:
            pieces.append(drawn[first : first + count])
            first += count
        return pieces

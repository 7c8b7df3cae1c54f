"""When samples are taken, which are lost, and when the others arrive: rate, dropouts and latency."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree
from scipy import special

from keepout.core.errors import ScenarioError
from keepout.flights.navigation.sensor import Sample

Scalar = Float[Array, ""]


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

    def step(self, state: PyTree, value: Float[Array, " n"], normals: Float[Array, " k"]) -> tuple[PyTree, Sample]:
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

"""What a sensor is to the rest of Keepout: it samples the truth late, seldom and wrongly, within stated bounds."""

import abc

import equinox as eqx
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from keepout.core.motion.relative import MotionState
from keepout.core.motion.rotation import Vector

Scalar = Float[Array, ""]


class Sample(eqx.Module):
    """What one sensor says at a control step.

    Attributes:
        value: what was measured `latency` control periods ago; not looked at where nothing came.
        came: whether a sample arrived at this step.

    """

    value: Float[Array, " n"]
    came: Bool[Array, ""]


class Ball(eqx.Module):
    """A vector that is certainly within a distance of a centre.

    Attributes:
        centre: m or m/s, body axes.
        radius: likewise; infinite where nothing is known.

    """

    centre: Vector
    radius: Scalar


class Sensor(eqx.Module):
    """A sensor: samples at whole control periods, each arriving a fixed number of periods later, if at all.

    Attributes:
        every: control periods between samples, at least 1.
        latency: control periods from a sample to its arrival.
        most_missed: samples that can be lost in a row; after so many the next one comes.

    """

    every: eqx.AbstractVar[int]
    latency: eqx.AbstractVar[int]
    most_missed: eqx.AbstractVar[int]

    @abc.abstractmethod
    def initial_state(self, key: PRNGKeyArray, truth: MotionState) -> PyTree:
        """Draw the biases, and fill the line of samples under way."""

    @abc.abstractmethod
    def sample(self, state: PyTree, truth: MotionState) -> tuple[PyTree, Sample]:
        """Give the sample that arrives at this control step; called once a period, from the first step on."""

    @abc.abstractmethod
    def ideal(self, state: MotionState) -> Float[Array, " n"]:
        """Give what it would say of a state without error: the measurement function h, differentiable."""

    @abc.abstractmethod
    def covariance(self, value: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Give the covariance of a sample's error, bias included, for a filter."""

    @abc.abstractmethod
    def position_ball(self, value: Float[Array, " n"], estimate: MotionState) -> Ball | None:
        """Give what a sample proves of the position at its own time, m; None for a sensor that proves nothing of it.

        `estimate` gives the attitude with which a measurement in other axes is turned into the body's.
        """

    @abc.abstractmethod
    def velocity_ball(self, value: Float[Array, " n"], estimate: MotionState) -> Ball | None:
        """Give what a sample proves of the velocity at its own time, m/s; None where that is nothing."""

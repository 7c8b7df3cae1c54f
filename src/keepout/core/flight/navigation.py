"""Navigation, as the loop flies it: what stands between the true motion and those that steer by what is known of it.

Sensors sample the truth late, seldom and wrongly, within stated bounds. Two estimates are made of what they say: one
for the law, which may be wrong, and one for the guard, which may not. Both are asked in the same order at every control
step: `correct` with the samples that arrived, then, when law and guard have decided, `advance` with the force that will
act until the next step. `flights/navigation` has sensors, estimates and suites.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import Flag, Scalar, Vector, as_float64
from keepout.core.motion.relative import MotionState


class Sample(eqx.Module):
    """What one sensor says at a control step (leading axes: to many flights).

    Attributes:
        value: what was measured `latency` control periods ago; not looked at where nothing came.
        came: whether a sample arrived at this step.

    """

    value: Float[Array, "*flights n"]
    came: Bool[Array, "*flights"]


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

    def position_ball(self, value: Float[Array, " n"], estimate: MotionState) -> Ball | None:
        """Give what a sample proves of the position at its own time, m; None for a sensor that proves nothing of it.

        `estimate` gives the attitude with which a measurement in other axes is turned into the body's.
        """
        return None

    def velocity_ball(self, value: Float[Array, " n"], estimate: MotionState) -> Ball | None:
        """Give what a sample proves of the velocity at its own time, m/s; None where that is nothing."""
        return None

    def beyond(self) -> float:
        """Give a bound on the probability that one sample's error passes what the sensor's balls allow for; zero."""
        return 0.0


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
        return min(1.0, sum((steps // sensor.every + 1) * sensor.beyond() for sensor in self.sensors))


class Estimating(eqx.Module):
    """What the law's estimate and the guard's have in common."""

    @abc.abstractmethod
    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> PyTree:
        """Start from an estimate whose position (m) and velocity (m/s) are off by at most `errors`."""

    @abc.abstractmethod
    def advance(self, state: PyTree, force: Vector) -> PyTree:
        """Move to the next control step under the commanded force (N, body axes) that acts until then."""


class Estimator(Estimating):
    """The law's estimate of the motion, and of the disturbance where it models one."""

    @abc.abstractmethod
    def correct(self, state: PyTree, samples: tuple[Sample, ...]) -> tuple[PyTree, MotionState, Int[Array, ""]]:
        """Take the samples that arrived, one a sensor.

        Returns:
            The memory; the estimate now, with `disturbance` (the mean force to come over the period that begins, N)
            where it is modelled and None where it is not; and how many samples were left out as outliers.

        """


class KnownSet(eqx.Module):
    """A state that is certainly known within two radii.

    Attributes:
        state: its centre, with the attitude and rates of the law's estimate.
        errors: radii ε_r of the position (m) and ε_v of the velocity (m/s) about it.
        contradicted: whether the samples of this step cannot all be within their bounds.

    """

    state: MotionState
    errors: Float[Array, "2"]
    contradicted: Flag


class BoundedEstimator(Estimating):
    """The guard's estimate: a set that holds the truth as long as noise and acceleration keep to their bounds."""

    @abc.abstractmethod
    def correct(self, state: PyTree, samples: tuple[Sample, ...], estimate: MotionState) -> tuple[PyTree, KnownSet]:
        """Cut the set with the samples that arrived; `estimate` is the law's, for attitude and rates."""


class Knowledge(eqx.Module):
    """What is known of the motion at a control step.

    Attributes:
        estimate: the law's, with the disturbance where it is estimated too.
        known: the guard's: a set around the truth.
        outliers: samples left out of the estimate at this step.

    """

    estimate: MotionState
    known: KnownSet
    outliers: Int[Array, ""]


class OnBoardState(eqx.Module):
    """What the estimators remember, and the forces that were commanded and do not act yet (N, the oldest first)."""

    estimator: PyTree
    bounded: PyTree
    pending: Float[Array, "delay 3"]


class Navigation(eqx.Module):
    """Sensors, the law's estimate made of what they say, and the guard's set.

    A flight starts from an estimate drawn from the balls `initial_errors` around the true start: what an earlier phase
    of the flight handed over.

    Attributes:
        suite: the sensors.
        estimator: for the law.
        bounded: for the guard.
        initial_errors: radii of the position (m) and the velocity (m/s) within which the first estimate is.
        delay: control periods from a command to its effect.

    """

    suite: Suite
    estimator: Estimator
    bounded: BoundedEstimator
    initial_errors: Float[Array, "2"] = eqx.field(converter=as_float64)
    delay: int = eqx.field(static=True, default=0)

    def first_estimate(self, key: PRNGKeyArray, truth: MotionState) -> MotionState:
        """Draw the estimate that a flight starts with: position and velocity are each somewhere in their balls."""
        a, b, c, d = jax.random.split(key, 4)
        shares = jnp.cbrt(jnp.stack([jax.random.uniform(c), jax.random.uniform(d)]))
        away = [jax.random.normal(one, (3,)) for one in (a, b)]
        position, velocity = (
            share * radius * way / jnp.linalg.norm(way)
            for share, radius, way in zip(shares, self.initial_errors, away, strict=True)
        )
        return truth.moved(position, velocity)

    def begin(self, estimate: MotionState, under_way: Float[Array, "steps 3"] | None = None) -> OnBoardState:
        """Start both estimators from the first estimate; of the forces `under_way` (N) the last `delay` count."""
        nothing = jnp.zeros((self.delay, 3))
        return OnBoardState(
            self.estimator.initial_state(estimate, self.initial_errors),
            self.bounded.initial_state(estimate, self.initial_errors),
            nothing if under_way is None or not self.delay else under_way[-self.delay :],
        )

    def know(self, state: OnBoardState, samples: tuple[Sample, ...]) -> tuple[OnBoardState, Knowledge]:
        """Take the samples that arrived: the first on-board part of a step."""
        estimator, estimate, outliers = self.estimator.correct(state.estimator, samples)
        bounded, known = self.bounded.correct(state.bounded, samples, estimate)
        return OnBoardState(estimator, bounded, state.pending), Knowledge(estimate, known, outliers)

    def told(self, state: OnBoardState, force: Vector) -> OnBoardState:
        """Be told of the force (N, body axes) that was commanded: the last on-board part of a step."""
        pending = jnp.concatenate([state.pending, force[None]])
        acting = pending[0]
        return OnBoardState(
            self.estimator.advance(state.estimator, acting), self.bounded.advance(state.bounded, acting), pending[1:]
        )

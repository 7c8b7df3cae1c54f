"""Navigation: what stands between the true motion and those that steer by what is known of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.core.motion.rotation import Vector
from keepout.flights.navigation.estimator import BoundedEstimator, Estimator, KnownSet
from keepout.flights.navigation.sensor import Sample
from keepout.flights.navigation.suite import Suite


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
        """Draw the estimate that a flight starts with."""
        return first_estimate(key, truth, self.initial_errors)

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


def first_estimate(key: PRNGKeyArray, truth: MotionState, errors: Float[Array, "2"]) -> MotionState:
    """Draw an estimate whose position (m) and velocity (m/s) are each in a ball of radius `errors` around the truth."""
    a, b, c, d = jax.random.split(key, 4)
    shares = jnp.cbrt(jnp.stack([jax.random.uniform(c), jax.random.uniform(d)]))
    away = [jax.random.normal(one, (3,)) for one in (a, b)]
    position, velocity = (
        share * radius * way / jnp.linalg.norm(way) for share, radius, way in zip(shares, errors, away, strict=True)
    )
    moved = truth.position + position, truth.velocity + velocity
    return eqx.tree_at(lambda s: (s.position, s.velocity), truth, moved)

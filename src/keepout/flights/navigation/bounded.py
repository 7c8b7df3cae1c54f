"""A set that holds the truth: two balls, propagated under a bounded acceleration and cut with what each sample proves.

Between control steps r̈ = u + w with ‖w‖ ≤ D, u the commanded force over the mass, held: what the guard assumes
(docs/guard.md, section 1). docs/navigation.md proves each line below; `caps` bounds the radii ahead of a flight.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.core.motion.rotation import Vector
from keepout.flights.navigation.ball import ROUNDING, cut
from keepout.flights.navigation.estimator import BoundedEstimator, KnownSet
from keepout.flights.navigation.sensor import Ball, Sample, Sensor
from keepout.flights.navigation.suite import Suite

Scalar = Float[Array, ""]


class KnownMotion(eqx.Module):
    """The memory of the set-membership estimate.

    Attributes:
        position: where the chaser is, now.
        velocity: how fast it is, now.
        accelerations: of the commands of the last periods, m/s², the newest one last; zero before the flight.
        attitudes: of the last steps' estimates, the newest one last.
        centres: of the position's balls of the last `window` steps, m, the newest one last.
        radii: of those balls, m.
        elapsed: steps since the oldest of them, at most `window`.
        contradictions: steps in a row whose samples did not meet what was known: of the position, of the velocity.

    """

    position: Ball
    velocity: Ball
    accelerations: Float[Array, "commands 3"]
    attitudes: Float[Array, "steps 4"]
    centres: Float[Array, "window 3"]
    radii: Float[Array, " window"]
    elapsed: Int[Array, ""]
    contradictions: Int[Array, "2"]


class SetMembership(BoundedEstimator):
    """The balls of position and velocity that samples, commands and the bound on accelerations leave.

    Attributes:
        suite: the sensors, whose samples come in this order.
        disturbance: D, the bound on every acceleration beyond commanded force over mass, m/s².
        mass: that turns forces into accelerations, kg; the guard's.
        period: control period, s.
        window: steps between the two positions that bound the velocity; 0 where sensors of the velocity do it better.
        patience: steps in a row that samples of a quantity contradict what is known of it, until a sample is believed
            instead.

    Raises:
        ScenarioError: a number outside its range.

    """

    suite: Suite
    disturbance: Scalar = eqx.field(converter=as_float64)
    mass: Scalar = eqx.field(converter=as_float64)
    period: Scalar = eqx.field(converter=as_float64)
    window: int = eqx.field(static=True, default=0)
    patience: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        for name, unit, above in (("disturbance", "m/s2", False), ("mass", "kg", True), ("period", "s", True)):
            value = getattr(self, name)
            if isinstance(value, Tracer):
                continue  # values are not known yet inside a transformation
            if not bool(jnp.all(jnp.isfinite(value) & ((value > 0.0) if above else (value >= 0.0)))):
                least = "above 0" if above else "at least 0"
                raise ScenarioError(f"set membership: {name} is {value} {unit}; it must be finite and {least}")
        if self.window < 0:
            raise ScenarioError(f"set membership: window is {self.window} steps; it must be at least 0")
        if self.patience < 1:
            raise ScenarioError(f"set membership: patience is {self.patience} steps; it must be at least 1")

    @property
    def _latest(self) -> int:
        return max((sensor.latency for sensor in self.suite.sensors), default=0)

    def initial_state(self, estimate: MotionState, errors: Float[Array, "2"]) -> KnownMotion:
        """Start from an estimate whose position (m) and velocity (m/s) are off by at most `errors`."""
        return KnownMotion(
            position=_rounded(estimate.position, errors[0], estimate.position),
            velocity=_rounded(estimate.velocity, errors[1], estimate.velocity),
            accelerations=jnp.zeros((max(self.window, self._latest), 3)),
            attitudes=jnp.tile(estimate.attitude, (self._latest + 1, 1)),
            centres=jnp.tile(estimate.position, (self.window, 1)),
            radii=jnp.full(self.window, errors[0]),
            elapsed=jnp.zeros((), jnp.int32),
            contradictions=jnp.zeros(2, jnp.int32),
        )

    def advance(self, state: KnownMotion, force: Vector) -> KnownMotion:
        """Move both balls over a period: ε_v + D T, and ε_r + T ε_v + D T²/2."""
        T, D, u = self.period, self.disturbance, force / self.mass
        position, velocity = state.position, state.velocity
        drift, push, change = T * velocity.centre, 0.5 * T**2 * u, T * u
        further = position.radius + T * velocity.radius + 0.5 * T**2 * D
        return KnownMotion(
            position=_rounded(position.centre + drift + push, further, position.centre, drift, push),
            velocity=_rounded(velocity.centre + change, velocity.radius + T * D, velocity.centre, change),
            accelerations=_shifted(state.accelerations, u),
            attitudes=state.attitudes,
            centres=_shifted(state.centres, position.centre),
            radii=_shifted(state.radii, position.radius),
            elapsed=jnp.minimum(state.elapsed + 1, self.window),
            contradictions=state.contradictions,
        )

    def correct(
        self, state: KnownMotion, samples: tuple[Sample, ...], estimate: MotionState
    ) -> tuple[KnownMotion, KnownSet]:
        """Cut velocity, then position, then velocity again where two positions bound it."""
        attitudes = _shifted(state.attitudes, estimate.attitude)
        state = eqx.tree_at(lambda s: s.attitudes, state, attitudes)
        late = [
            (sensor, sample, eqx.tree_at(lambda s: s.attitude, estimate, attitudes[-1 - sensor.latency]))
            for sensor, sample in zip(self.suite.sensors, samples, strict=True)
        ]
        believe = state.contradictions + 1 >= self.patience

        velocity, position = _Cutting(state.velocity), _Cutting(state.position)
        for sensor, sample, then in late:
            told = sensor.velocity_ball(sample.value, then)
            if told is not None:
                velocity = velocity.told(self._velocity_now(state, told, sensor), sample.came, believe[1])
        for sensor, sample, then in late:
            told = sensor.position_ball(sample.value, then)
            if told is not None:
                told = self._position_now(state, velocity.known, told, sensor)
                position = position.told(told, sample.came, believe[0])

        centres, radii, elapsed = state.centres, state.radii, state.elapsed
        if self.window > 0:
            # What was believed of the past goes with what was believed of the present.
            elapsed = jnp.where(position.replaced, 0, elapsed)
            told = self._velocity_between(state, position.known, elapsed)
            velocity = velocity.told(told, elapsed > 0, believe[1])
            centres = jnp.where(position.replaced, position.known.centre, centres)
            radii = jnp.where(position.replaced, position.known.radius, radii)

        wrong = jnp.stack([position.wrong, velocity.wrong])
        heard = jnp.stack([position.heard, velocity.heard])
        counted = jnp.where(heard, jnp.where(wrong & ~believe, state.contradictions + 1, 0), state.contradictions)
        state = KnownMotion(
            position=position.known,
            velocity=velocity.known,
            accelerations=state.accelerations,
            attitudes=attitudes,
            centres=centres,
            radii=radii,
            elapsed=elapsed,
            contradictions=counted,
        )
        centre = eqx.tree_at(
            lambda s: (s.position, s.velocity), estimate, (position.known.centre, velocity.known.centre)
        )
        return state, KnownSet(centre, jnp.stack([position.known.radius, velocity.known.radius]), jnp.any(wrong))

    def _velocity_now(self, state: KnownMotion, told: Ball, sensor: Sensor) -> Ball:
        """Carry a velocity over the sensor's latency ℓ: the commands since, and ℓ T D."""
        late = sensor.latency
        if late == 0:
            return told
        pushes = self.period * state.accelerations[-late:]
        radius = told.radius + late * self.period * self.disturbance
        centre = told.centre + jnp.sum(pushes, axis=0)
        return _rounded(centre, radius, told.centre, jnp.sum(jnp.abs(pushes), axis=0))

    def _position_now(self, state: KnownMotion, velocity: Ball, told: Ball, sensor: Sensor) -> Ball:
        """Carry a position over the sensor's latency ℓ with the velocity now: ℓ T ε_v + D (ℓ T)²/2."""
        late = sensor.latency
        if late == 0:
            return told
        since = late * self.period
        # Where t is the time since the sample, v(t) = v − ∫ₜ (u + w), and so r = r(0) + ℓ T v − ∫ t (u + w) dt.
        weights = self.period**2 * (jnp.arange(late) + 0.5)
        drift, pushes = since * velocity.centre, weights[:, None] * state.accelerations[-late:]
        radius = told.radius + since * velocity.radius + 0.5 * since**2 * self.disturbance
        return _rounded(
            told.centre + drift - jnp.sum(pushes, axis=0), radius, told.centre, drift, jnp.sum(jnp.abs(pushes), axis=0)
        )

    def _velocity_between(self, state: KnownMotion, position: Ball, elapsed: Int[Array, ""]) -> Ball:
        """Bound the velocity by the positions now and `elapsed` = n steps ago: (ε_r + ε_r′)/(n T) + D n T/2."""
        since = jnp.maximum(elapsed, 1) * self.period
        before = Ball(state.centres[0], state.radii[0])
        # v is the mean velocity and the mean of t (u + w), t the time since: the older, the smaller the weight.
        age = jnp.arange(self.window) - (self.window - elapsed) + 0.5
        weights = self.period**2 * jnp.maximum(age, 0.0) / since
        pushes = weights[:, None] * state.accelerations[-self.window :]
        centre = (position.centre - before.centre) / since + jnp.sum(pushes, axis=0)
        radius = (position.radius + before.radius) / since + 0.5 * since * self.disturbance
        return _rounded(
            centre, radius, position.centre / since, before.centre / since, jnp.sum(jnp.abs(pushes), axis=0)
        )


class _Cutting(eqx.Module):
    """What is known of a quantity while samples are taken in one after the other.

    Attributes:
        known: where it is.
        heard: whether anything was told of it at this step.
        wrong: whether something told did not meet what was known.
        replaced: whether something told was believed instead.

    """

    known: Ball
    heard: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(False))
    wrong: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(False))
    replaced: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(False))

    def told(self, ball: Ball, came: Bool[Array, ""], believe: Bool[Array, ""]) -> "_Cutting":
        """Cut with a ball, if it came; where the two do not meet, keep what is known unless the ball is believed."""
        both, meet = cut(self.known, ball)
        wrong = came & ~meet
        anew = wrong & believe & jnp.all(jnp.isfinite(ball.centre)) & (ball.radius < jnp.inf)
        known = jax.tree.map(
            lambda told, shared, old: jnp.where(anew, told, jnp.where(came & meet, shared, old)), ball, both, self.known
        )
        return _Cutting(known, self.heard | came, self.wrong | wrong, self.replaced | anew)


def _rounded(centre: Vector, radius: Scalar, *terms: Vector) -> Ball:
    """Give a ball, wider by what rounding may have done to a centre that is the sum of these terms."""
    size = sum(jnp.linalg.norm(term) for term in terms)
    return Ball(centre, radius * (1.0 + ROUNDING) + ROUNDING * size)


def _shifted(line: Float[Array, "steps *n"], newest: Float[Array, "*n"]) -> Float[Array, "steps *n"]:
    """Put the newest entry at the end of a line of fixed length, and let the oldest go."""
    return jnp.concatenate([line, newest[None]])[1:]

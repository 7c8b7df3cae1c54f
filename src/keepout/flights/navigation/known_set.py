"""A set that holds the truth: two balls, propagated under a bounded acceleration and cut with what each sample proves.

Between control steps r̈ = u + w with ‖w‖ ≤ D, u the commanded force over the mass, held: what the guard assumes
(docs/guard.md, section 1). docs/motion.md proves each line below.

`design` gives the largest radii that the set can have in a flight, known before it: what a guard is built
for. The radii grow from step to step and are cut by what arrives. A cut leaves at most the smaller ball, and everything
else grows with what it is made from; so a flight in which no cut gains more than that, under the worst order of lost
samples, has radii that no other flight's pass. Every order is followed at once: for each number of samples that each
sensor may have lost in a row, the largest radii with which it can be reached.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Ball, BoundedEstimator, KnownSet, Sample, Sensor, Suite
from keepout.core.motion import rotation
from keepout.core.motion.arrays import Vector, as_float64
from keepout.core.motion.relative import MotionState

Scalar = Float[Array, ""]

ROUNDING = 1e-13
"""Relative allowance for rounding in sums of vectors, squares and roots: some hundred units in the last place."""
CAPS_ROUNDING = 1e-9
"""Relative allowance on the caps for what rounding adds to the radii in flight."""
_LONGEST = 600
"""Steps of the longest window between two positions that is looked at, beside twenty times the oldest sample's age."""
_MOST_STEPS = 20000
"""Steps within which the radii must settle."""
_ENDLESS = 1e6
"""Radii (m, m/s) beyond which they are taken to grow without end."""
_SETTLED = 1e-14
"""Part of the largest radius that a radius may still grow by in a rhythm and is taken for settled."""


def cut(first: Ball, second: Ball) -> tuple[Ball, Bool[Array, ""]]:
    """Give the smallest ball that holds every point within both balls, and whether there is one.

    For every λ in [0, 1] and every point p of both, (1 − λ)‖p − c₁‖² + λ‖p − c₂‖² = ‖p − c‖² + λ(1 − λ) d² with
    c = (1 − λ) c₁ + λ c₂ and d = ‖c₂ − c₁‖, so that p is within √((1 − λ) R₁² + λ R₂² − λ(1 − λ) d²) of c. This is
    least at λ = (d² + R₁² − R₂²)/(2 d²), cut to [0, 1]; there it is the radius of the circle in which the spheres
    meet, or that of the smaller ball. It is never wider than either ball: where the allowance for rounding would make
    it so, it is that ball.

    Args:
        first: what is kept where the balls do not meet, or the second one is not a number.
        second: another; its radius may be infinite.

    """
    between = second.centre - first.centre
    square = between @ between
    distance = jnp.sqrt(square)
    known = jnp.isfinite(distance) & (second.radius >= 0.0)
    size = jnp.linalg.norm(first.centre) + jnp.linalg.norm(second.centre)
    meets = known & (distance <= (first.radius + second.radius) * (1.0 + ROUNDING) + ROUNDING * size)
    smaller_is_first = first.radius <= second.radius
    R1, R2 = first.radius, second.radius
    share = jnp.clip(0.5 + 0.5 * (R1 - R2) * (R1 + R2) / jnp.where(square > 0.0, square, 1.0), 0.0, 1.0)
    left = (1.0 - share) * R1**2 + share * R2**2 - share * (1.0 - share) * square
    scale = jnp.maximum(R1, R2) + distance
    # The square is off by a small part of scale², and the centre by a small part of the coordinates.
    radius = jnp.sqrt(jnp.maximum(left, 0.0) + ROUNDING * scale**2) + ROUNDING * size
    lens = meets & (square > 0.0) & (share > 0.0) & (share < 1.0) & (radius < jnp.minimum(R1, R2))
    take_second = meets & ~smaller_is_first
    centre = jnp.where(lens, first.centre + share * between, jnp.where(take_second, second.centre, first.centre))
    return Ball(centre, jnp.where(lens, radius, jnp.where(take_second, R2, R1))), meets


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
        return replace(
            state,
            position=_rounded(position.centre + drift + push, further, position.centre, drift, push),
            velocity=_rounded(velocity.centre + change, velocity.radius + T * D, velocity.centre, change),
            accelerations=_shifted(state.accelerations, u),
            centres=_shifted(state.centres, position.centre),
            radii=_shifted(state.radii, position.radius),
            elapsed=jnp.minimum(state.elapsed + 1, self.window),
        )

    def correct(
        self, state: KnownMotion, samples: tuple[Sample, ...], estimate: MotionState
    ) -> tuple[KnownMotion, KnownSet]:
        """Cut velocity, then position, then velocity again where two positions bound it."""
        attitudes = _shifted(state.attitudes, estimate.attitude)
        state = replace(state, attitudes=attitudes)
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
        balls = {"position": position.known, "velocity": velocity.known}
        state = replace(state, **balls, centres=centres, radii=radii, elapsed=elapsed, contradictions=counted)
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


@dataclass(frozen=True)
class _Told:
    """What a sensor tells, as numbers: the largest radii of its balls, and when they arrive."""

    position: float
    velocity: float
    every: int
    latency: int
    most_missed: int

    def arrives(self, step: int) -> bool:
        return step >= self.latency and (step - self.latency) % self.every == 0

    @property
    def oldest(self) -> int:
        return self.latency + self.every * (self.most_missed + 1) - 1


def design(
    suite: Suite,
    *,
    disturbance: float,
    mass: float,
    period: float,
    range_limit: float,
    speed_limit: float,
    initial_errors: tuple[float, float],
) -> tuple[SetMembership, tuple[float, float]]:
    """Build the set-membership estimate with the window that bounds the velocity best, and give the caps of its radii.

    Args:
        suite: the sensors.
        disturbance: D, the bound on every acceleration beyond commanded force over mass, m/s².
        mass: kg.
        period: control period, s.
        range_limit: distance within which the chaser stays, m: a range-bearing sensor errs more the further away.
        speed_limit: likewise, m/s.
        initial_errors: of the first estimate's position (m) and velocity (m/s).

    Returns:
        The estimate, and the largest radii ε̄_r (m) and ε̄_v (m/s) of a flight whose samples keep to their bounds.

    Raises:
        ScenarioError: no sensor bounds the position, or the radii grow without end.

    """
    told = told_by(suite, (range_limit, speed_limit))
    if not any(math.isfinite(one.position) for one in told):
        raise ScenarioError(
            "suite: 0 of its sensors bound the position, so that nothing certain can be known; add a RelativePosition "
            "or a RangeBearing"
        )
    found = []
    for window in _windows(told, disturbance, period):
        radii = largest_radii(told, window, disturbance, period, initial_errors)
        if radii is not None:
            found.append((radii[1], radii[0], window))
    if not found:
        slowest = max(one.oldest + 1 for one in told if math.isfinite(one.position))
        raise ScenarioError(
            f"suite: with samples up to {slowest} control periods old and accelerations up to {disturbance:g} m/s² the "
            "known set grows without end; sample more often, or add a RelativeVelocity"
        )
    velocity, position, window = min(found)
    estimate = SetMembership(suite, disturbance=disturbance, mass=mass, period=period, window=window)
    return estimate, (position * (1.0 + CAPS_ROUNDING), velocity * (1.0 + CAPS_ROUNDING))


def told_by(suite: Suite, limits: tuple[float, float]) -> list[_Told]:
    """Say what each sensor that bounds anything tells, at limits of range (m) and speed (m/s)."""
    every = [
        _Told(*_largest_balls(sensor, *limits), sensor.every, sensor.latency, sensor.most_missed)
        for sensor in suite.sensors
    ]
    return [one for one in every if min(one.position, one.velocity) < math.inf]


def _largest_balls(sensor: Sensor, range_limit: float, speed_limit: float) -> tuple[float, float]:
    """Give the radii of a sensor's balls at the limits: a ball's radius grows with the length of what is measured.

    What is measured may itself be longer than the limit by the error, so the radii are taken at the limit and that.
    """

    @jax.jit  # operation by operation, it would compile dozens of programs
    def radii(distance: Float[Array, ""], speed: Float[Array, ""]) -> Float[Array, "2"]:
        away = jnp.array([1.0, 0.0, 0.0])
        state = MotionState(jnp.zeros(()), distance * away, speed * away, rotation.identity(), jnp.zeros(3))
        value = sensor.ideal(state)
        balls = sensor.position_ball(value, state), sensor.velocity_ball(value, state)
        return jnp.stack([jnp.asarray(jnp.inf) if ball is None else ball.radius for ball in balls])

    first = np.asarray(radii(as_float64(range_limit), as_float64(speed_limit)))
    further, faster = np.where(np.isfinite(first), first, 0.0)
    position, velocity = np.asarray(radii(as_float64(range_limit + further), as_float64(speed_limit + faster)))
    return float(position), float(velocity)


def _windows(told: list[_Told], disturbance: float, period: float) -> Iterator[int]:
    """Give the windows worth looking at: none, and some around the one that balances noise and drift."""
    yield 0
    positions = [one for one in told if math.isfinite(one.position)]
    oldest = min(one.oldest for one in positions)
    radius = min(one.position for one in positions)
    # 2ρ/τ + D τ/2 is at least 2 √(ρ D).
    if 2.0 * math.sqrt(radius * disturbance) > min(one.velocity + one.oldest * period * disturbance for one in told):
        return
    longest = _LONGEST + 20 * oldest
    best = 2.0 * math.sqrt(radius / disturbance) / period if disturbance > 0.0 else longest
    # A late position is carried by the velocity that it is to bound: in a window of twice its age that settles.
    best = max(best, 2.0 * (oldest + 1))
    seen = set()
    for factor in (0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0, 4.0):
        window = round(min(max(best * factor, oldest + 1), longest))
        if window not in seen:
            seen.add(window)
            yield window


def largest_radii(
    told: list[_Told], window: int, disturbance: float, period: float, initial_errors: tuple[float, float]
) -> tuple[float, float] | None:
    """Follow the largest radii until they repeat, and give their largest (m, m/s); None if they do not settle."""
    D, T = disturbance, period
    rhythm = math.lcm(*(one.every for one in told))
    begun = max(one.latency for one in told) + window
    shape = tuple(one.most_missed + 1 for one in told)
    position, velocity = np.full(shape, -math.inf), np.full(shape, -math.inf)
    start = (0,) * len(told)
    position[start], velocity[start] = initial_errors
    history = [float(initial_errors[0])] * window  # the start stands in for all steps before it
    most, before = np.zeros(2), None
    for step in range(_MOST_STEPS):
        position, velocity = _arrived(told, step, position, velocity, D, T)
        largest = float(position.max())
        if window and step:
            since = min(step, window) * T
            velocity = np.minimum(velocity, (position + history[0]) / since + 0.5 * since * D)
        most = np.maximum(most, (largest, velocity.max()))
        if most.max() > _ENDLESS:
            return None
        if step >= begun and step % rhythm == 0:
            now = np.concatenate([position.ravel(), velocity.ravel(), history])
            # Radii that are no larger after a rhythm than before it never are again: each grows with all the others.
            if before is not None and np.all(now <= before + _SETTLED * np.abs(most).max()):
                return float(most[0]), float(most[1])
            before = now
        history = [*history[1:], largest] if window else history
        position = position + T * velocity + 0.5 * D * T**2
        velocity = velocity + D * T
    return None


def _arrived(
    told: list[_Told], step: int, position: np.ndarray, velocity: np.ndarray, D: float, T: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cut the largest radii with what may arrive, and move them to the numbers of samples lost that this leads to."""
    arriving = [i for i, one in enumerate(told) if one.arrives(step)]
    new_position, new_velocity = np.full_like(position, -math.inf), np.full_like(velocity, -math.inf)
    for missed in np.ndindex(position.shape):
        if position[missed] == -math.inf:
            continue
        choices = [(True, False) if i in arriving and missed[i] < told[i].most_missed else (True,) for i in arriving]
        for came in itertools.product(*choices):
            after = list(missed)
            r, v = position[missed], velocity[missed]
            for i, here in zip(arriving, came, strict=True):
                after[i] = 0 if here else missed[i] + 1
                if here:
                    v = min(v, told[i].velocity + told[i].latency * T * D)
            for i, here in zip(arriving, came, strict=True):
                if here:
                    since = told[i].latency * T
                    r = min(r, told[i].position + since * v + 0.5 * D * since**2)
            place = tuple(after)
            new_position[place] = max(new_position[place], r)
            new_velocity[place] = max(new_velocity[place], v)
    return new_position, new_velocity

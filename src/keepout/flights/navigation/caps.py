"""The largest radii that the set-membership estimate can have in a flight, known before it: what a guard is built for.

The radii grow from step to step and are cut by what arrives. A cut leaves at most the smaller ball, and everything else
grows with what it is made from; so a flight in which no cut gains more than that, under the worst order of lost
samples, has radii that no other flight's pass. Every order is followed at once: for each number of samples that each
sensor may have lost in a row, the largest radii with which it can be reached.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.errors import ScenarioError
from keepout.core.motion import rotation
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.bounded import SetMembership
from keepout.flights.navigation.sensor import Sensor
from keepout.flights.navigation.suite import Suite

ROUNDING = 1e-9
"""Relative allowance on the caps for what rounding adds to the radii in flight."""
_LONGEST = 600
"""Steps of the longest window between two positions that is looked at, beside twenty times the oldest sample's age."""
_MOST_STEPS = 20000
"""Steps within which the radii must settle."""
_ENDLESS = 1e6
"""Radii (m, m/s) beyond which they are taken to grow without end."""
_SETTLED = 1e-14
"""Part of the largest radius that a radius may still grow by in a rhythm and is taken for settled."""


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
    limits = range_limit, speed_limit
    told = _told(suite, limits)
    _check_position(told)
    found = []
    for window in _windows(told, disturbance, period):
        radii = _largest(told, window, disturbance, period, initial_errors)
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
    return estimate, (position * (1.0 + ROUNDING), velocity * (1.0 + ROUNDING))


def caps(
    estimate: SetMembership,
    *,
    range_limit: float,
    speed_limit: float,
    initial_errors: tuple[float, float],
) -> tuple[float, float]:
    """Give the largest radii ε̄_r (m) and ε̄_v (m/s) that an estimate can have while samples keep to their bounds.

    The arguments are those of `design`.

    Raises:
        ScenarioError: the radii grow without end.

    """
    told = _told(estimate.suite, (range_limit, speed_limit))
    _check_position(told)
    numbers = float(estimate.disturbance), float(estimate.period)
    radii = _largest(told, estimate.window, *numbers, initial_errors)
    if radii is None:
        raise ScenarioError(
            f"set membership: with a window of {estimate.window} steps the known set grows without end; `design` finds "
            "the window that bounds the velocity best"
        )
    return radii[0] * (1.0 + ROUNDING), radii[1] * (1.0 + ROUNDING)


def _check_position(told: list[_Told]) -> None:
    if not any(math.isfinite(one.position) for one in told):
        raise ScenarioError(
            "suite: 0 of its sensors bound the position, so that nothing certain can be known; add a RelativePosition "
            "or a RangeBearing"
        )


def _told(suite: Suite, limits: tuple[float, float]) -> list[_Told]:
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


def _largest(
    told: list[_Told], window: int, disturbance: float, period: float, initial_errors: tuple[float, float]
) -> tuple[float, float] | None:
    """Follow the largest radii until they repeat, and give their largest; None if they do not settle."""
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

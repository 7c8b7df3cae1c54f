"""Suites of sensors: three worked ones, which suites are refused, and the navigation that a scenario makes of one.

The worked suites, far, near and close, have typical values: orders of magnitude of what was published, not a data sheet
of any instrument. Each is a function of what its losses are, so that a flight without lost samples and one with them
have the same sensors. The sources are

- of `far`, relative GPS (https://ntrs.nasa.gov/citations/19930013112) and PRISMA (https://doi.org/10.2514/1.23015);
- of `near`, lidars (https://engineering.usu.edu/ece/cail/software); its range rate has none;
- of `close`, a flash lidar (https://www.sintef.no/en/publications/publication/2214824), whose values are a fifth.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.control.observer import PAPER_FREQUENCIES
from keepout.core.errors import ScenarioError
from keepout.core.flight.navigation import Navigation, Sensor, Suite
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.mission.entries import NavigationEntry
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.flights.navigation.estimators import RawSamples, kalman_filter
from keepout.flights.navigation.known_set import SetMembership, design
from keepout.flights.navigation.sensor_errors import BallNoise, GaussianNoise, WanderingBias
from keepout.flights.navigation.sensors import (
    RangeBearing,
    RangeRate,
    RelativePosition,
    RelativeVelocity,
    TargetAttitude,
)


def far(dropout: float = 0.02, most_missed: int = 5) -> Suite:
    """Differential GNSS by code and Doppler, at some hundred metres: Gaussian noise, a bias, a period late.

    Position 0.3 m a component and a bias within 0.5 m; velocity 5 mm/s and a bias within 5 mm/s; in axes of VVLH,
    turned by an attitude that is known to 0.5°. Noise without a bound: what is certain is so with a probability.
    """
    known_to = math.radians(0.5)
    fix = {"latency": 1, "dropout": dropout, "most_missed": most_missed if dropout else 0}
    position = (GaussianNoise(0.3), WanderingBias(0.5, 0.005))
    velocity = (GaussianNoise(0.005), WanderingBias(0.005, 0.0001))
    return Suite(
        (
            RelativePosition(position, axes="vvlh", attitude_error=known_to, **fix),
            RelativeVelocity(velocity, axes="vvlh", attitude_error=known_to, **fix),
        )
    )


def near(dropout: float = 0.01, most_missed: int = 2) -> Suite:
    """Range and bearing by laser, with the range's rate, at some ten metres: bounded noise and biases, a period late.

    Range ± 0.03 m and a bias within 0.02 m, bearing ± 1 mrad and a bias within 1 mrad, range rate 2 mm/s of Gaussian
    noise, attitude of the target ± 10 mrad every second period.
    """
    line = {"latency": 1, "dropout": dropout, "most_missed": most_missed if dropout else 0}
    distance = (BallNoise(0.03), WanderingBias(0.02, 0.0005))
    bearing = (BallNoise(0.001), WanderingBias(0.001, 0.00002))
    return Suite(
        (
            RangeBearing(distance, bearing, **line),
            RangeRate((GaussianNoise(0.002),), **line),
            TargetAttitude((BallNoise(0.01),), every=2, **line),
        )
    )


def close(position: float = 0.05, velocity: float = 0.002, dropout: float = 0.0, most_missed: int = 0) -> Suite:
    """Pose from lidar or camera, tracked, within some ten metres: bounded noise, once a period, at once.

    Args:
        position: radius of the ball that the position's error is drawn from, m.
        velocity: likewise of the velocity, m/s.
        dropout: probability that a sample is lost.
        most_missed: samples that can be lost in a row.

    """
    pose = {"dropout": dropout, "most_missed": most_missed}
    return Suite(
        (
            RelativePosition((BallNoise(position),), **pose),
            RelativeVelocity((BallNoise(velocity),), **pose),
        )
    )


SUITES = {"far": far, "near": near, "close": close}
"""The worked suites by name."""


WINDOW = 60.0
"""Within which a suite's samples must determine the motion, s."""
LEAST = 1e-6
"""Smallest singular value, as a part of the largest, of a suite that observes position and velocity."""
_REMEDY = {
    "position": "add a RelativePosition or a RangeBearing",
    "velocity": "sample the position at least twice in the window, lost samples counted, or add a RelativeVelocity",
}


def check_observability(suite: Suite, state: MotionState, period: float) -> float:
    """Refuse a suite whose samples do not determine position and velocity within `WINDOW`.

    The motion is r̈ = known acceleration, so that a change of the start's position and velocity by (δr, δv) moves the
    position at time t by δr + t δv and the velocity by δv. Each sample adds the rows H Φ(t) of the linearised
    measurement along the straight path from `state`; of every `most_missed` + 1 samples one is counted, and of late
    ones those that arrive within the window. The columns are scaled to 1 m and to 1 m per window, and each sensor's
    rows to a longest one of length 1: what is asked is whether the samples determine the motion, not how well.

    Args:
        suite: the sensors.
        state: about which they are linearised; a flight's start.
        period: control period, s.

    Returns:
        The smallest singular value over the largest.

    Raises:
        ScenarioError: the least is below `LEAST` of the largest; it names the direction that is not observed.

    """
    steps = int(WINDOW / period)
    blocks = [np.zeros((0, 6))]
    for sensor in suite.sensors:
        times = period * np.arange(0, steps - sensor.latency + 1, sensor.every * (sensor.most_missed + 1))
        slopes = np.asarray(_slopes(sensor, state, jnp.asarray(times))).reshape(-1, 6)
        longest = max(np.linalg.norm(slopes, axis=-1), default=0.0)
        blocks += [slopes / longest] if longest > 0.0 else []
    rows = np.concatenate(blocks)
    _, singular, directions = np.linalg.svd(np.concatenate([rows, np.zeros((6, 6))]))
    share = float(singular[5] / singular[0]) if singular[0] > 0.0 else 0.0
    if not share >= LEAST:
        worst = directions[5]
        part = "position" if np.linalg.norm(worst[:3]) >= np.linalg.norm(worst[3:]) else "velocity"
        along = worst[:3] if part == "position" else worst[3:]
        along = along / np.linalg.norm(along)
        raise ScenarioError(
            f"suite: its samples of {WINDOW:g} s do not determine the {part} along "
            f"({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}): singular value {singular[5]:.1e} of {singular[0]:.1e}, "
            f"it must be at least {LEAST:g} of it; {_REMEDY[part]}"
        )
    return share


def _slopes(sensor: Sensor, state: MotionState, times: Float[Array, " samples"]) -> Float[Array, "samples n 6"]:
    """Give the derivatives of a sensor's samples by the start's position (m) and velocity (m per window)."""

    def measured(change: Float[Array, "6"], time: Float[Array, ""]) -> Float[Array, " n"]:
        velocity = state.velocity + change[3:] / WINDOW
        position = state.position + change[:3] + time * velocity
        moved = eqx.tree_at(lambda s: (s.position, s.velocity), state, (position, velocity))
        return sensor.ideal(moved)

    return jax.vmap(lambda time: jax.jacfwd(measured)(jnp.zeros(6), time))(times)


@dataclass(frozen=True)
class Certain:
    """The guard's estimate, and what it is sure to keep.

    Attributes:
        estimate: the set-membership estimate.
        errors: caps of its radii, m and m/s.
        initial: largest errors of the first estimate, m and m/s.

    """

    estimate: SetMembership
    errors: tuple[float, float]
    initial: tuple[float, float]


def suite_of(entry: NavigationEntry) -> Suite:
    """Build the sensors."""
    chosen = {
        "position": entry.position_noise,
        "velocity": entry.velocity_noise,
        "dropout": entry.dropout,
        "most_missed": entry.most_missed,
    }
    if entry.dropout and entry.most_missed == 0:
        raise ScenarioError(
            f"navigation.most_missed: 0, and dropout is {entry.dropout:g}; a sample that can be lost needs at least 1"
        )
    if entry.dropout and entry.most_missed is None and entry.suite == "close":
        raise ScenarioError(
            f"navigation.dropout: {entry.dropout:g} needs most_missed, how many samples can be lost in a row"
        )
    return SUITES[entry.suite](**{name: value for name, value in chosen.items() if value is not None})


def certain(scenario: Scenario, assumed: GuardAssumptions) -> Certain:
    """Design the guard's estimate for what the guard assumes of the motion, and bound its radii over the flight.

    A thruster that sticks pushes until it is known: its force is part of what the set must allow for.

    Args:
        scenario: with a suite.
        assumed: the guard's assumptions, whose errors of the estimate do not matter.

    Raises:
        ScenarioError: a suite that does not determine the motion, or whose set grows without end.

    """
    numbers = {
        "disturbance": float(assumed.disturbance + assumed.fault_push),
        "mass": scenario.chaser.mass,
        "period": scenario.control.period,
        "range_limit": float(assumed.range_limit),
        "speed_limit": float(assumed.speed_limit),
    }
    return _certain(scenario.navigation, tuple(numbers.items()))  # pyright: ignore[reportArgumentType]: a frozen model has a hash


@lru_cache(maxsize=64)
def _certain(entry: NavigationEntry, given_numbers: tuple[tuple[str, float], ...]) -> Certain:
    numbers = dict(given_numbers)
    given = entry.initial_position_error, entry.initial_velocity_error
    whole = suite_of(entry.model_copy(update={"dropout": 0.0, "most_missed": 0}))
    _, usual = design(whole, **numbers, initial_errors=(0.0, 0.0))
    initial = (usual[0] if given[0] is None else given[0], usual[1] if given[1] is None else given[1])
    estimate, errors = design(suite_of(entry), **numbers, initial_errors=initial)
    return Certain(estimate, errors, initial)


def navigation(scenario: Scenario, motion: RelativeMotion, assumed: GuardAssumptions) -> Navigation | None:
    """Build the navigation of a scenario; None of one that names no suite.

    Args:
        scenario: its entries `navigation`, `chaser`, `control`, `disturbance` and `guard.delay`.
        motion: the model of the relative motion.
        assumed: what the guard assumes.

    Raises:
        ScenarioError: a suite that does not determine the motion, or whose set grows without end.

    """
    if scenario.navigation.suite == "none":
        return None
    sure = certain(scenario, assumed)
    suite, period = sure.estimate.suite, scenario.control.period
    start = motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
    check_observability(suite, start, period)
    numbers = {"mass": scenario.chaser.mass, "period": period}
    if scenario.navigation.estimate == "filter":
        numbers["disturbance_bound"] = max(float(assumed.disturbance_force), 1e-6)
        frequencies = PAPER_FREQUENCIES if scenario.control.observer in (None, "harmonic") else ()
        estimator = kalman_filter(motion, suite.sensors, **numbers, frequencies=frequencies)
    else:
        estimator = RawSamples.build(motion, suite.sensors, **numbers)
    return Navigation(suite, estimator, sure.estimate, sure.initial, scenario.guard.delay)

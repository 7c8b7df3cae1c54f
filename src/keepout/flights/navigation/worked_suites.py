"""Three worked suites, far, near and close, with typical values; docs/navigation.md has their sources.

The values are orders of magnitude of what was published, not a data sheet of any instrument. Each suite is a function
of what its losses are, so that a flight without lost samples and one with them have the same sensors.
"""

import math

from keepout.flights.navigation.error_parts import BallNoise, GaussianNoise, WanderingBias
from keepout.flights.navigation.sensors import (
    RangeBearing,
    RangeRate,
    RelativePosition,
    RelativeVelocity,
    TargetAttitude,
)
from keepout.flights.navigation.suite import Suite


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

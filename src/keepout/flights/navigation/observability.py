"""Whether a suite can observe position and velocity: what is refused before a flight, with numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.errors import ScenarioError
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.sensor import Sensor
from keepout.flights.navigation.suite import Suite

LEAST = 1e-6
"""Smallest singular value, as a part of the largest, of a suite that observes position and velocity."""
_REMEDY = {
    "position": "add a RelativePosition or a RangeBearing",
    "velocity": "sample the position at least twice in the window, lost samples counted, or add a RelativeVelocity",
}


def check_observability(suite: Suite, state: MotionState, period: float, window: float = 60.0) -> float:
    """Refuse a suite whose samples do not determine position and velocity within a window.

    The motion is r̈ = known acceleration, so that a change of the start's position and velocity by (δr, δv) moves the
    position at time t by δr + t δv and the velocity by δv. Each sample adds the rows H Φ(t) of the linearised
    measurement along the straight path from `state`; of every `most_missed` + 1 samples one is counted, and of late
    ones those that arrive within the window. The columns are scaled to 1 m and to 1 m per window, and each sensor's
    rows to a longest one of length 1: what is asked is whether the samples determine the motion, not how well.

    Args:
        suite: the sensors.
        state: about which they are linearised; a flight's start.
        period: control period, s.
        window: s.

    Returns:
        The smallest singular value over the largest.

    Raises:
        ScenarioError: the least is below `LEAST` of the largest; it names the direction that is not observed.

    """
    steps = int(window / period)
    blocks = [np.zeros((0, 6))]
    for sensor in suite.sensors:
        times = period * np.arange(0, steps - sensor.latency + 1, sensor.every * (sensor.most_missed + 1))
        slopes = np.asarray(_slopes(sensor, state, jnp.asarray(times), window)).reshape(-1, 6)
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
            f"suite: its samples of {window:g} s do not determine the {part} along "
            f"({along[0]:.2f}, {along[1]:.2f}, {along[2]:.2f}): singular value {singular[5]:.1e} of {singular[0]:.1e}, "
            f"it must be at least {LEAST:g} of it; {_REMEDY[part]}"
        )
    return share


def _slopes(
    sensor: Sensor, state: MotionState, times: Float[Array, " samples"], window: float
) -> Float[Array, "samples n 6"]:
    """Give the derivatives of a sensor's samples by the start's position (m) and velocity (m per window)."""

    def measured(change: Float[Array, "6"], time: Float[Array, ""]) -> Float[Array, " n"]:
        velocity = state.velocity + change[3:] / window
        position = state.position + change[:3] + time * velocity
        moved = eqx.tree_at(lambda s: (s.position, s.velocity), state, (position, velocity))
        return sensor.ideal(moved)

    return jax.vmap(lambda time: jax.jacfwd(measured)(jnp.zeros(6), time))(times)

"""Bounds on how fast a tumbling target turns, with and without the torque of gravity."""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER
from keepout.core.motion.relative import MotionState, RelativeMotion

_OUTWARD = 1.0 + 1e-6
"""Covers what a Runge–Kutta step a control period loses: tests/core/mission/test_orbit_bounds.py."""


def free(angular_velocity: np.ndarray, inertia: np.ndarray) -> tuple[float, float]:
    """Bound ‖ω‖ (rad/s) and ‖ω̇‖ (rad/s²) of a body without torque.

    Energy and momentum are kept, so ‖ω‖² ≤ 2E/I_min and ‖ω̇‖ ≤ ‖L‖‖ω‖/I_min.
    """
    least = float(np.linalg.eigvalsh(inertia)[0])
    rate = math.sqrt(max(angular_velocity @ inertia @ angular_velocity, 0.0) / least)
    return rate, float(np.linalg.norm(inertia @ angular_velocity)) * rate / least


def pulled(motion: RelativeMotion, *, period: float, steps: int, lowest_radius: float) -> tuple[float, float]:
    """Bound ‖ω‖ (rad/s) and ‖ω̇‖ (rad/s²) of a body that gravity turns, over a flight.

    The target's motion is known: it is integrated once, with the flight's own steps. Between two of them ω changes by
    at most half a period of the largest ω̇, and ‖ω̇‖ ≤ (τ + I_max ‖ω‖²)/I_min with τ = 3 μ (I_max − I_min)/(2 R³), the
    largest gravity-gradient torque.

    Args:
        motion: whose `attitude_motion` is a `Tumbling` with `gravity_gradient`.
        period: between steps, s.
        steps: of the flight.
        lowest_radius: of the target's orbit, m.

    """
    leaves, structure = jax.tree.flatten(motion)
    numbers = tuple((np.shape(leaf), *np.ravel(leaf).tolist()) for leaf in leaves)
    return _pulled(structure, numbers, period, steps, lowest_radius)


def valid_until(period: float, steps: int) -> float:
    """Give the time, s, until which `pulled` bounds: half a period after the last of the flight's states."""
    return (steps + 0.5) * period


@functools.lru_cache(maxsize=64)
def _pulled(
    structure: Any, numbers: tuple[tuple, ...], period: float, steps: int, lowest_radius: float
) -> tuple[float, float]:
    """Bound how a motion turns that is given by what can be looked up: its structure, each leaf's shape and numbers.

    One flight asks several times, and an integration takes some 10 µs a step.
    """
    leaves = [jnp.reshape(jnp.asarray(values), shape) for shape, *values in numbers]
    motion: RelativeMotion = jax.tree.unflatten(structure, leaves)
    inertia = np.asarray(motion.attitude_motion.inertia)  # pyright: ignore[reportAttributeAccessIssue]
    least, _, most = np.linalg.eigvalsh(inertia)
    torque = 1.5 * EARTH_GRAVITATIONAL_PARAMETER / lowest_radius**3 * (most - least)
    beside = motion.initial_state(np.zeros(3), np.zeros(3))
    sampled = float(np.max(np.asarray(_rates(motion, beside, jnp.asarray(period), steps)))) * _OUTWARD

    def change(rate: float) -> float:
        return (torque + most * rate**2) / least

    # The largest rate x between two samples obeys x ≤ sampled + ½ T ω̇(x); the least x that allows no more is the bound.
    rate = sampled
    for _ in range(100):
        rate = sampled + 0.5 * period * change(rate) * _OUTWARD
        if not math.isfinite(rate):
            break
    if not sampled + 0.5 * period * change(rate) <= rate * _OUTWARD:
        return math.inf, math.inf
    return rate * _OUTWARD, change(rate * _OUTWARD)


@eqx.filter_jit
def _rates(motion: RelativeMotion, start: MotionState, period: jax.Array, steps: int) -> jax.Array:
    def advance(state: MotionState, _: None) -> tuple[MotionState, jax.Array]:
        # The chaser is put back beside the target: its own way is nobody's concern here.
        after = motion.step(state, jnp.zeros(3), NoDisturbance(), period, 1.0)
        after = eqx.tree_at(lambda s: (s.position, s.velocity), after, (start.position, start.velocity))
        return after, jnp.linalg.norm(state.angular_velocity)

    return jax.lax.scan(advance, start, length=steps + 1)[1]

"""Hill's equations in closed form: coasting near a target on a circular orbit, in VVLH axes.

Linear in the distance, so a plan's first draft only: what is flown or proved uses the exact relative motion
(`motion/relative.py`), from which it departs by about 1.5 n² r²/a (a: the orbit's radius) in acceleration. Also called
the equations of Clohessy and Wiltshire. With R outwards, T along the velocity, N along the orbit normal, VVLH has
x = T, y = −N, z = −R.
"""

import numpy as np
from jaxtyping import Float

VVLH_FROM_RTN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Rotation that takes radial, along-track and normal components to VVLH."""


def coast_matrix(mean_motion: float, seconds: float | Float[np.ndarray, "*times"]) -> Float[np.ndarray, "*times 6 6"]:
    """Give the matrix from a state (position m, velocity m/s; VVLH) to the state `seconds` later, without force.

    Args:
        mean_motion: n of the circular orbit, rad/s.
        seconds: any shape.

    """
    n, t = mean_motion, np.asarray(seconds, float)
    s, c = np.sin(n * t), np.cos(n * t)
    rtn = np.zeros((*t.shape, 6, 6))
    rtn[..., 0, 0], rtn[..., 0, 3], rtn[..., 0, 4] = 4.0 - 3.0 * c, s / n, 2.0 * (1.0 - c) / n
    rtn[..., 1, 0], rtn[..., 1, 1] = 6.0 * (s - n * t), 1.0
    rtn[..., 1, 3], rtn[..., 1, 4] = -2.0 * (1.0 - c) / n, (4.0 * s - 3.0 * n * t) / n
    rtn[..., 2, 2], rtn[..., 2, 5] = c, s / n
    rtn[..., 3, 0], rtn[..., 3, 3], rtn[..., 3, 4] = 3.0 * n * s, c, 2.0 * s
    rtn[..., 4, 0], rtn[..., 4, 3], rtn[..., 4, 4] = 6.0 * n * (c - 1.0), -2.0 * s, 4.0 * c - 3.0
    rtn[..., 5, 2], rtn[..., 5, 5] = -n * s, c
    turn = np.kron(np.eye(2), VVLH_FROM_RTN)
    return turn @ rtn @ turn.T


def push_matrix(mean_motion: float, seconds: float | Float[np.ndarray, "*times"]) -> Float[np.ndarray, "*times 6 3"]:
    """Give the matrix from an acceleration held for `seconds` (m/s², VVLH) to what it adds to the state at their end.

    Args:
        mean_motion: n of the circular orbit, rad/s.
        seconds: any shape.

    """
    n, t = mean_motion, np.asarray(seconds, float)
    s, c = np.sin(n * t), np.cos(n * t)
    rtn = np.zeros((*t.shape, 3, 3))
    rtn[..., 0, 0] = rtn[..., 2, 2] = (1.0 - c) / n**2
    rtn[..., 0, 1] = 2.0 * (t - s / n) / n
    rtn[..., 1, 0] = -rtn[..., 0, 1]
    rtn[..., 1, 1] = 4.0 * (1.0 - c) / n**2 - 1.5 * t**2
    position = VVLH_FROM_RTN @ rtn @ VVLH_FROM_RTN.T
    return np.concatenate([position, coast_matrix(n, t)[..., :3, 3:]], axis=-2)


def closing_velocity(mean_motion: float, position: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Give the in-plane velocity (VVLH, m/s) with which a place (m) lies on an ellipse about the target.

    The ellipse lies about the target, is twice as long along the orbit as it is high, and is closed: no drift along
    the orbit. The velocity out of the plane, which changes neither, is left at 0.
    """
    n = mean_motion
    velocity = np.zeros(np.shape(position))
    velocity[..., 0] = 2.0 * n * position[..., 2]
    velocity[..., 2] = -0.5 * n * position[..., 0]
    return velocity

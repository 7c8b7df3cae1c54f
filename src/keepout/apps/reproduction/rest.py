"""What became of a flight that may not have arrived: whether it came to rest where it should not be."""

import numpy as np
from jaxtyping import Float

REST_WINDOW = 300.0
"""For so long (s), at its end, a flight at rest has stayed where it is."""
REST_SHARE = 0.05
"""Within this share of the distance that is left to the goal it has then stayed."""


def trapped(
    time: Float[np.ndarray, "samples"],
    position: Float[np.ndarray, "samples 3"],
    goal: Float[np.ndarray, "3"],
    tolerance: float,
) -> bool:
    """Whether a flight came to rest outside its goal's tolerance.

    It did if it ends further than `tolerance` from the goal, and over its last 300 s was never further from where it
    ends than a twentieth of the distance that is left. Nothing less shows that something holds it: unhindered, the
    paper's guidance covers 63 % of the way that is left in 300 s at k_p = 30 m and 0.1 m/s, and more at smaller k_p.
    The share, not a length, because close to the goal the guidance is as slow as a trapped chaser that chatters.

    Args:
        time: of the samples, s, rising.
        position: m, in the goal's frame.
        goal: m.
        tolerance: of the goal, m.

    Returns:
        False too for a flight shorter than 300 s, or one that holds a position that is not a number.

    """
    left = float(np.linalg.norm(position[-1] - goal))
    last = time >= time[-1] - REST_WINDOW
    if time[-1] - time[0] < REST_WINDOW or not left > tolerance:
        return False
    strayed = np.linalg.norm(position[last] - position[-1], axis=1)
    return bool(np.all(strayed <= REST_SHARE * left))


def first_within(
    time: Float[np.ndarray, "samples"],
    position: Float[np.ndarray, "samples 3"],
    goal: Float[np.ndarray, "3"],
    tolerance: float,
) -> float | None:
    """Give the time (s after the start) when a flight first was within its goal's tolerance; None if it never was."""
    near = np.linalg.norm(position - goal, axis=1) < tolerance
    return float(time[np.argmax(near)] - time[0]) if near.any() else None

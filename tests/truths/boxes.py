"""The built-in box in closed form: its distance, and points where a ball touches it."""

from pathlib import Path

import numpy as np

HALF = np.array([2.0, 1.5, 1.0])
"""Half its sides, m."""


def box_distance(points: np.ndarray) -> np.ndarray:
    """Distance from points outside the box to it, m."""
    return np.linalg.norm(np.maximum(np.abs(points) - HALF, 0.0), axis=1)


def contact_with_box(count: int, radius: float, *, seed: int = 17) -> np.ndarray:
    """Points whose distance from the box is exactly the radius: beside faces, edges and corners."""
    rng = np.random.default_rng(seed)
    foot = rng.uniform(-1.0, 1.0, (count, 3)) * HALF
    axis, rows = rng.integers(0, 3, count), np.arange(count)
    foot[rows, axis] = np.copysign(HALF[axis], foot[rows, axis])
    foot = np.where(rng.random((count, 3)) < 0.3, np.copysign(HALF, foot), foot)
    # A normal of the face, edge or corner that the foot lies on.
    normal = np.where(np.abs(foot) == HALF, np.sign(foot) * rng.exponential(size=(count, 3)), 0.0)
    return foot + radius * normal / np.linalg.norm(normal, axis=1, keepdims=True)


LEARNED = Path(__file__).with_name("box.keepout")
"""A rough field of the box, certified for 0.5 m: `keepout fit box`, as tests/test_commands.py fits it."""

"""Where to look: the direction about which patches lie closest together."""

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]

_STEPS = 60
"""Of the search for the middle, whose error falls with the number of steps."""


def middle_of(directions: Float[np.ndarray, "k 3"]) -> tuple[Vector, float]:
    """Give a unit vector whose greatest angle to unit vectors is nearly the least, and that angle, rad.

    Each step turns towards the farthest direction by a share that shrinks (Bădoiu and Clarkson's, on the sphere).
    Directions on all sides have no middle; then the angle says so.
    """
    middle = directions.mean(axis=0)
    size = float(np.linalg.norm(middle))
    middle = middle / size if size > 1e-9 else directions[0]
    best, least = middle, -2.0
    for step in range(_STEPS):
        cosines = directions @ middle
        farthest = int(np.argmin(cosines))
        if cosines[farthest] > least:
            best, least = middle, float(cosines[farthest])
        turned = middle + (directions[farthest] - middle) / (step + 2.0)
        size = float(np.linalg.norm(turned))
        if not size > 1e-9:
            break
        middle = turned / size
    return best, float(np.arccos(np.clip(least, -1.0, 1.0)))


def aim(place: Vector, points: Float[np.ndarray, "k 3"], planned: Vector, half_angle: float) -> Vector:
    """Give the direction to look in from a place so that points are in the cone; the planned one if they are not.

    Args:
        place: (3,) of the camera, m.
        points: (k, 3) what is to be seen, m.
        planned: (3,) unit vector.
        half_angle: of the cone, rad.

    """
    if len(points) == 0:
        return planned
    to = points - place
    lengths = np.linalg.norm(to, axis=1)
    if not lengths.min() > 1e-9:
        return planned
    to = to / lengths[:, None]
    if float((to @ planned).min()) >= np.cos(half_angle):
        return planned
    middle, spread = middle_of(to)
    return middle if spread < half_angle else planned

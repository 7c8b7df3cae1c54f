"""The clearance of a flight, and a proved lower bound of it over each step, by the audit's tube around the path."""

import numpy as np
from jaxtyping import Float

from keepout.core.audit.tube import FlightBounds, Tube
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.distance import Distance

_PIECES = 4
"""Pieces of a step that are bounded apart: each is nearer to its middle than the whole step is."""
_ROUNDING = 1e-9
"""Metres taken off every bound, as the audit does."""
_CONSISTENCY = 1e-6
"""What the flight's own integrator may err by in a step, m, as the audit allows."""


def proved_clearance(
    record: FlightRecord, distance: Distance, *, chaser_radius: float, bounds: FlightBounds
) -> Float[np.ndarray, "steps"]:
    """Bound the clearance from below over each step of a flight.

    The distance to the mesh at the middle of a quarter of a step, less how far the path can be from there within it
    (`audit.tube`) and the chaser's radius, is a bound for that quarter; the least of four is the step's. It is weaker
    than the audit's, which splits the steps that matter until the bound is tight.

    Args:
        record: the flight.
        distance: exact, to the target's mesh.
        chaser_radius: m.
        bounds: on what the record does not hold.

    Returns:
        Metres, one a step. Not a number where nothing is proved: a step that holds a number which is not finite, that
        no motion within the bounds can have flown, or that may have gone beyond where gravity is bounded.

    """
    states = np.isfinite(np.concatenate([record.position, record.velocity], axis=1))
    finite = np.all(states, axis=1, keepdims=True)[:, 0]
    readable = finite[:-1] & finite[1:] & np.isfinite(record.force[:-1]).all(axis=1)
    position, velocity, force = (
        np.where(np.isfinite(array), array, 0.0)[None] for array in (record.position, record.velocity, record.force)
    )
    tube = Tube.of(record.time, position, velocity, force, bounds)
    proved = readable & ~tube.beyond[0] & (tube.inconsistency()[0] <= _CONSISTENCY)
    step = np.arange(record.steps)
    flight = np.zeros(record.steps, int)
    least = np.full(record.steps, np.inf)
    for piece in range(_PIECES):
        start, end = (np.full(record.steps, edge / _PIECES) for edge in (piece, piece + 1))
        point, _, radius = tube.piece(flight, step, start, end)
        least = np.minimum(least, distance.distance(point) - radius)
    return np.where(proved, least - chaser_radius - _ROUNDING, np.nan)

"""Flights whose clearance is known in closed form, and what an audit must say of them."""

from types import SimpleNamespace

import numpy as np

from keepout.core.audit.audit import audit
from keepout.core.audit.tube import FlightBounds

MASS = 20.0
BOUNDS = FlightBounds(
    mass=MASS, disturbance_force=0.015, angular_rate=1.2e-3, angular_acceleration=0.0, gravity_gradient=3e-6
)


class Mesh:
    """Boxes of zero thickness of these half sides, as distances in closed form, which are counted."""

    def __init__(self, *halves: float):
        self.halves, self.queries = halves, 0
        self.vertices = max(halves) * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        self.distance = SimpleNamespace(distance=self._counted)

    def _counted(self, points):
        self.queries += len(points)
        return self.distance_to(points)

    def distance_to(self, points):
        beyond = [np.abs(points) - half for half in self.halves]
        out = [np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0) for q in beyond]
        return np.abs(out).min(axis=0)


def judged(record, mesh, radius=0.0, **options):
    limits = {"bounds": BOUNDS, "force_limit": 0.1, "speed_limit": 0.2}
    return audit(record, mesh, chaser_radius=radius, **limits | options)


def straight(speed, steps, start=(-4.0, 0.0, 1.5)):
    time = np.arange(steps + 1.0)
    position = np.array(start) + np.outer(time, [speed, 0.0, 0.0])
    velocity = np.tile([speed, 0.0, 0.0], (steps + 1, 1))
    return SimpleNamespace(time=time, position=position, velocity=velocity, force=np.zeros((steps + 1, 3)))

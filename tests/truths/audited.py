"""Flights whose clearance is known in closed form, and what an audit must say of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from keepout.audit.audit import Contact, audit
from keepout.audit.tube import FlightBounds

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


def dipping():
    """Clear by 0.82 m and 0.42 m of a box at its two samples, and by 0.1 m between them, 1.2 s after the first."""
    return SimpleNamespace(
        time=np.array([0.0, 2.0]),
        position=np.array([[0.0, 0.0, 1.82], [0.0, 0.0, 1.42]]),
        velocity=np.array([[0.0, 0.0, -1.2], [0.0, 0.0, 0.8]]),
        force=np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 20.0]]),
    )


def check_a_dip_between_samples_is_found():
    """The least clearance lies between two samples; a chaser a centimetre larger touches there."""
    bounds = FlightBounds(MASS, 1e-6, 0.0, 0.0, 0.0)
    found = judged(dipping(), Mesh(1.0), radius=0.05, bounds=bounds)
    assert found.contact is Contact.NO
    assert found.minimum_clearance == pytest.approx(0.05, abs=1.1e-3)
    assert found.minimum_time == pytest.approx(1.2, abs=0.05)
    assert judged(dipping(), Mesh(1.0), radius=0.11, bounds=bounds).contact is Contact.YES


def check_a_push_not_recorded_leaves_room():
    """A force that the record does not hold could carry the chaser the last millimetres: not a "no" with it."""

    def verdict(push):
        bounds = FlightBounds(MASS, push, 0.0, 0.0, 0.0)
        return judged(dipping(), Mesh(1.0), radius=0.0985, bounds=bounds, tolerance=1e-5)

    assert verdict(1e-6).contact is Contact.NO
    # 0.1 N on 20 kg: 1.6 mm in the 0.8 s from the nearest point to the second sample.
    assert verdict(0.1).contact is Contact.UNDECIDED
    assert "too close" in verdict(0.1).remarks[0]


def check_an_edited_position_is_caught():
    record = straight(0.1, 80)
    record.position[40] = [0.0, 0.0, 0.2]
    found = judged(record, Mesh(1.0), radius=0.3)
    assert found.contact is not Contact.NO
    assert {39, 40} <= set(found.inconsistent_steps)
    # Deep inside a closed body the unsigned distance is large again: the edit is still caught, by the dynamics.
    big = Mesh(5.0)
    far = straight(0.1, 80, start=(-4.0, 0.0, 6.0))
    assert judged(far, big, radius=0.3).contact is Contact.NO
    far.position[40] = [0.0, 0.0, 0.0]
    assert judged(far, big, radius=0.3).contact is not Contact.NO


def check_a_cavity_is_not_called_safe():
    record = straight(0.02, 80, start=(-1.0, 0.0, 0.0))
    inside = judged(record, Mesh(5.0), radius=0.1)
    assert inside.minimum_clearance > 0.0
    assert inside.contact is Contact.UNDECIDED
    assert not inside.start_outside

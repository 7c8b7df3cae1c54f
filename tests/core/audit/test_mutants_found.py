"""What an audit must not overlook between two samples that are alike, and between ends that only one way joins."""

from types import SimpleNamespace

import numpy as np
from truths.audited import MASS, Mesh, judged

from keepout.core.audit.audit import Contact
from keepout.core.audit.tube import FlightBounds

QUIET = {"mass": MASS, "disturbance_force": 1e-6, "angular_rate": 0.0, "angular_acceleration": 0.0}
SPEED = 0.05
"""Of a chaser that turns round within each step, m/s: it goes 12.5 mm forth and back."""


def swinging(height, steps):
    """A flight that is at one place at each sample, and in turn 12.5 mm below and above it between two."""
    turn = np.where(np.arange(steps + 1) % 2 == 0, 1.0, -1.0)[:, None] * [0.0, 0.0, 1.0]
    return SimpleNamespace(
        time=np.arange(steps + 1.0),
        position=np.tile([0.0, 0.0, height], (steps + 1, 1)),
        velocity=-SPEED * turn,
        force=2.0 * SPEED * MASS * turn,
    )


def test_a_swing_between_samples_at_one_place_is_no_clear_flight():
    bounds = FlightBounds(**QUIET, gravity_gradient=0.0)
    assert judged(swinging(1.1, 100), Mesh(1.0), radius=0.086, bounds=bounds).contact is Contact.NO
    assert judged(swinging(1.1, 100), Mesh(1.0), radius=0.088, bounds=bounds).contact is not Contact.NO


def test_a_swing_out_of_the_range_of_the_gravity_bound_is_not_called_safe():
    for beyond, contact in ((0.2, Contact.NO), (0.005, Contact.UNDECIDED)):
        bounds = FlightBounds(**QUIET, gravity_gradient=1e-9, range_limit=4.0 + beyond)
        assert judged(swinging(4.0, 2), Mesh(1.0), radius=0.1, bounds=bounds).contact is contact


def test_the_ends_of_a_step_are_joined_by_one_motion_and_not_by_one_for_each():
    """A push of b moves a chaser at rest by b T²/2 in a step, not by the b T² that its last speed alone allows."""
    push = 1e-3
    for moved, consistent in ((0.5 * push, True), (push, False)):
        record = SimpleNamespace(
            time=np.arange(2.0),
            position=np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0 + moved]]),
            velocity=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, push]]),
            force=np.zeros((2, 3)),
        )
        bounds = FlightBounds(**(QUIET | {"disturbance_force": MASS * push}), gravity_gradient=0.0)
        assert judged(record, Mesh(1.0), radius=0.1, bounds=bounds).consistent is consistent

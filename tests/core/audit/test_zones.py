"""Zones entered or not between the samples of a flight, against paths that are known at every instant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.core.audit.tube import Contact, FlightBounds, Tube
from keepout.core.audit.zones import Region, beside, box, entered, sphere

NOTHING_ELSE = FlightBounds(
    mass=1.0, disturbance_force=0.0, angular_rate=0.0, angular_acceleration=0.0, gravity_gradient=0.0
)


def _tube(time, velocity, start, bounds=NOTHING_ELSE):
    """Give the tube of one flight on a straight line."""
    position = np.asarray(start) + time[:, None] * np.asarray(velocity)
    held = np.broadcast_to(np.asarray(velocity, dtype=float), position.shape)
    return Tube.of(time, position[None], held[None], np.zeros((1, *position.shape)), bounds)


@given(st.floats(-2.0, 2.0), st.floats(0.1, 1.9), st.floats(0.0, 1.0))
def test_what_happens_between_samples_is_seen(beyond, radius, phase):
    # Ten metres a second, a sample a second: the ball is passed between two of them.
    tube = _tube(np.arange(12.0), [10.0, 0.0, 0.0], [-50.0 + 10.0 * phase, 0.0, 0.0])
    ball = Region("ball", sphere(np.array([3.0, radius + beyond, 0.0]), radius), 0.0, np.eye(3)[None])
    [found] = entered(tube, ball)
    true = abs(radius + beyond) - radius
    assert found.minimum_clearance <= true + 1e-9
    assert found.measured_clearance >= true - 1e-9
    if true > 1e-2:
        assert found.entered is Contact.NO
        assert found.minimum_clearance >= true - 1e-2
    elif true < 0.0:
        assert found.entered is not Contact.NO


@pytest.mark.parametrize(("start", "until", "said"), [(0.0, 3.0, "no"), (3.0, 7.0, "yes"), (8.0, np.inf, "no")])
def test_a_zone_counts_while_it_stands(start, until, said):
    tube = _tube(np.arange(11.0), [1.0, 0.0, 0.0], [-5.0, 0.0, 0.0])
    ball = Region("ball", sphere(np.zeros(3), 0.5), 0.25, np.eye(3)[None], start=start, until=until)
    [found] = entered(tube, ball)
    assert str(found.entered) == said


def test_a_zone_that_never_stood_was_not_entered():
    [found] = entered(
        _tube(np.arange(3.0), [1.0, 0.0, 0.0], np.zeros(3)),
        Region("ball", sphere(np.zeros(3), 9.0), 0.0, np.eye(3)[None], start=50.0),
    )
    assert found.entered is Contact.NO
    assert np.isinf(found.minimum_clearance)


@given(st.floats(0.0, 6.2), st.floats(0.5, 3.0), st.floats(0.0, 0.05))
def test_a_turning_zone_is_bounded_at_every_instant(phase, size, speed):
    rate, time = 0.02, np.arange(81.0)

    def turned(at):
        c, s = np.cos(phase + rate * at), np.sin(phase + rate * at)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    bar = box(np.array([-size, -0.5, -0.5]), np.array([4.0, 0.5, 0.5]))
    tube = _tube(time, [speed, -speed, 0.0], [3.0, 3.5, 0.3])
    region = Region("bar", bar, 0.2, np.stack([turned(at) for at in time]), rate=rate)
    [found] = entered(tube, region)
    moments = np.linspace(0.0, 80.0, 801)
    path = np.array([3.0, 3.5, 0.3]) + moments[:, None] * [speed, -speed, 0.0]
    true = float(bar(np.stack([turned(at) @ place for at, place in zip(moments, path, strict=True)])).min()) - 0.2
    assert found.minimum_clearance <= true + 1e-6
    assert found.measured_clearance >= true - 1e-6
    if true > 0.1:
        assert found.entered is Contact.NO


def test_a_push_that_may_lead_beyond_a_wall_leaves_it_undecided():
    wall = Region("wall", beside(np.zeros(3), np.array([1.0, 0.0, 0.0]), 20.0, radius=1.0), 0.0, np.eye(3)[None])
    time = np.arange(0.0, 12.0, 2.0)
    kept = [
        entered(_tube(time, [1.0, 0.0, 0.0], [3.0, 0.9, 0.0], bounds), wall)[0]
        for push in (0.0, 0.5)
        for bounds in [
            FlightBounds(
                mass=1.0, disturbance_force=push, angular_rate=0.0, angular_acceleration=0.0, gravity_gradient=0.0
            )
        ]
    ]
    assert [found.entered for found in kept] == [Contact.NO, Contact.UNDECIDED]

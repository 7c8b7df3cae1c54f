"""Transfers onto an ellipse: nothing to pay from the ellipse itself, a straight way where gravity is weak."""

import numpy as np
import pytest

from keepout.geometry.target import Target
from keepout.inspecting.circumnavigation import circumnavigations
from keepout.inspecting.transfer import transfer
from keepout.mission.scenario import Scenario

ENTRIES = {
    "target": {"source": "box"},
    "orbit": {"semi_major_axis": 7.0e6},
    "duration": 3000.0,
    "disturbance": {"kind": "none"},
    "inspect": {"stand_off": 2.0},
}


@pytest.fixture(scope="module")
def distance():
    return Target.load("box").distance.distance


def onto(distance, position, velocity=(0.0, 0.0, 0.0), **changes):
    """Give the transfer from a start onto the nearest ellipse, and that ellipse."""
    case = Scenario.parse({**ENTRIES, **changes, "start": {"position": list(position), "velocity": list(velocity)}})
    ellipse = circumnavigations(case, distance)[0]
    return transfer(case, distance, ellipse), ellipse


def test_a_start_on_the_ellipse_pays_little_and_one_at_rest_there_pays_for_its_speed(distance):
    _, ellipse = onto(distance, (0.0, -6.0, 0.0))
    place, velocity = ellipse.position[500], ellipse.velocity[500]
    speed = float(np.linalg.norm(velocity))
    moving, _ = onto(distance, place.tolist(), velocity.tolist())
    assert moving.delta_v < 0.1 * speed
    assert moving.keeps_stand_off
    still, _ = onto(distance, place.tolist())
    assert still.delta_v >= 0.5 * speed


def test_where_gravity_is_weak_a_coast_is_a_straight_way_and_begins_and_ends_with_its_speed(distance):
    """At 42,164 km and in 300 s: the way to the nearest place of the ellipse, over the longest coast, twice."""
    start = np.array([0.0, -30.0, -5.0])
    found, ellipse = onto(distance, start, orbit={"semi_major_axis": 4.2164e7})
    assert found.seconds == pytest.approx(300.0)
    phase = np.linspace(0.0, 2.0 * np.pi, 200)
    rtn = [np.cos(phase), -2.0 * np.sin(phase), ellipse.across / ellipse.height * np.cos(phase + ellipse.tilt)]
    places = ellipse.height * np.stack([rtn[1], -rtn[2], -rtn[0]], axis=1)
    nearest = float(np.linalg.norm(places - start, axis=1).min())
    assert found.delta_v == pytest.approx(2.0 * nearest / 300.0, rel=0.05)
    assert found.keeps_stand_off


def test_a_coast_through_the_target_is_told_as_one(distance):
    """From a start nearer than the stand-off no coast keeps it."""
    found, _ = onto(distance, (0.0, -3.0, 0.0))
    assert not found.keeps_stand_off
    assert found.summary()["transfer_keeps_stand_off"] is False

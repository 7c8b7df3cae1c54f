"""The law led to many places around one mesh: by one program, never nearer than the stand-off."""

import jax
import numpy as np
import pytest

from keepout.errors import InspectionError, KeepoutError
from keepout.flight import segment
from keepout.geometry.target import Target
from keepout.inspecting.leading import Leading
from keepout.mission.scenario import Scenario

HALF = np.array([2.0, 1.5, 1.0])
"""Of the built-in box, m."""


def distance_to_the_box(points):
    """Distance to the box in closed form, m; 0 inside."""
    return np.linalg.norm(np.maximum(np.abs(points) - HALF, 0.0), axis=-1)


def scenario(**changes):
    tree = {
        "target": {"source": "box"},
        "field": {"source": "grid"},
        "start": {"position": [5.0, 0.0, 0.0]},
        "camera": {"greatest_range": 6.0},
    }
    return Scenario.parse(tree | changes)


@pytest.fixture(scope="module")
def box():
    return Target.load("box")


@pytest.fixture(scope="module")
def leading(box):
    return Leading.of(scenario(), box)


def test_places_are_moved_by_little_and_to_where_the_law_leads(leading):
    generator = np.random.default_rng(0)
    for _ in range(8):
        away = generator.standard_normal(3)
        place = np.clip(4.0 * away, -HALF, HALF) + 1.5 * away / np.linalg.norm(away)
        moved = leading.reachable(place)
        assert moved is not None
        assert distance_to_the_box(moved) >= 1.5
        assert np.linalg.norm(moved - place) <= max(1.75 - distance_to_the_box(place), 0.0) * 1.5
        leading.law(moved, np.array([5.0, 0.0, 0.0]))
    far = np.array([4.5, 3.0, 0.0])
    assert np.array_equal(leading.reachable(far), far)
    assert leading.reachable(np.zeros(3)) is None  # in the middle of the box no slope leads out


def test_all_laws_have_arrays_of_one_shape_and_nothing_else_differs(leading):
    here = np.array([5.0, 0.0, 0.0])
    first = leading.law(np.array([0.0, 4.5, 0.0]), here)
    second = leading.law(np.array([0.0, 0.0, -4.0]), np.array([0.0, 4.5, 0.0]), speed=0.03, through=True)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(law)] for law in (first, second)]
    assert shapes[0] == shapes[1]


def test_the_chaser_flies_from_place_to_place_and_keeps_the_stand_off(leading):
    places = [np.array([0.0, 3.3, 0.0]), np.array([-3.8, 0.0, 0.0]), np.array([0.0, 0.0, 2.8])]
    position, rows = np.array([5.0, 0.0, 0.0]), []
    setup = state = None
    for place in places:
        law = leading.law(place, position)
        setup = leading.setup(law) if setup is None else leading.led_on(setup, law)
        state = segment.begin(setup, leading.initial, jax.random.key(0)) if state is None else state
        for _ in range(60):
            state, log = segment.fly_segment(setup, state, 5)
            rows.append(np.asarray(log.position))
            position = rows[-1][-1]
            if np.linalg.norm(position - place) < 0.15:
                break
        assert np.linalg.norm(position - place) < 0.15
    assert distance_to_the_box(np.concatenate(rows)).min() >= 1.5


def test_the_speed_asked_for_is_the_speed_flown_at_within_its_limits(leading):
    here, there = np.array([5.0, 0.0, 0.0]), np.array([-5.0, 0.0, 0.0])
    for asked, flown in ((None, 0.1), (0.05, 0.05), (0.001, 0.02), (7.0, 0.1)):
        assert float(leading.law(there, here, speed=asked).velocity.guidance.speed) == pytest.approx(flown)


def test_a_start_nearer_than_the_law_keeps_and_another_profile_are_refused(box):
    with pytest.raises(InspectionError, match=r"control\.profile"):
        Leading.of(scenario(control={"profile": "paper"}), box)
    with pytest.raises(InspectionError, match=r"inspect\.stand_off: 0\.6 m"):
        Leading.of(scenario(inspect={"stand_off": 0.6}), box)
    with pytest.raises(KeepoutError, match=r"start\.position"):
        Leading.of(scenario(start={"position": [2.3, 0.0, 0.0]}), box)


@pytest.mark.parametrize(
    ("tables", "named"),
    [
        ({"camera": {"greatest_range": 1e5}}, r"^camera\.greatest_range, beyond the target: 100003 m"),
        (
            {"inspect": {"stand_off": 1.5, "hold_points": [{"position": [0, 4, 0]}, {"position": [0, 6e4, 0]}]}},
            r"^inspect\.hold_points\.1\.position: 60000 m",
        ),
    ],
)
def test_what_is_too_far_away_is_named_as_it_was_given(box, tables, named):
    with pytest.raises(KeepoutError, match=named):
        Leading.of(scenario(**tables), box)


def test_the_law_is_made_to_reach_the_hold_points(box, leading):
    far = Leading.of(scenario(inspect={"stand_off": 1.5, "hold_points": [{"position": [0.0, 40.0, 0.0]}]}), box)
    assert far.reach == pytest.approx(40.0)
    assert leading.reach < 40.0

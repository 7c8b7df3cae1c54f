"""The law led to many places around one mesh: by one program, never nearer than the stand-off."""

import numpy as np
import pytest
from truths.boxes import HALF, box_distance

from keepout.apps.inspection.leading import AroundMesh
from keepout.core.errors import KeepoutError
from keepout.core.mission.scenario import Scenario

pytestmark = pytest.mark.long


def scenario(**changes):
    tree = {"target": {"source": "box"}, "field": {"source": "grid"}, "camera": {"greatest_range": 6.0}}
    return Scenario.parse(tree | {"start": {"position": [5.0, 0.0, 0.0]}} | changes)


@pytest.fixture(scope="module")
def leading(box):
    return AroundMesh.of(scenario(), box)


@pytest.mark.slow  # inspections are refused where the law does not lead
def test_places_are_moved_by_little_and_to_where_the_law_leads(leading):
    generator = np.random.default_rng(0)
    for _ in range(8):
        away = generator.standard_normal(3)
        place = np.clip(4.0 * away, -HALF, HALF) + 1.5 * away / np.linalg.norm(away)
        moved = leading.reachable(place)
        assert moved is not None
        assert box_distance(moved[None])[0] >= 1.5
        assert np.linalg.norm(moved - place) <= max(1.75 - box_distance(place[None])[0], 0.0) * 1.5
        leading.law(moved, np.array([5.0, 0.0, 0.0]))
    far = np.array([4.5, 3.0, 0.0])
    assert np.array_equal(leading.reachable(far), far)
    assert leading.reachable(np.zeros(3)) is None  # in the middle of the box no slope leads out


def test_the_speed_asked_for_is_the_speed_flown_at_within_its_limits(leading):
    here, there = np.array([5.0, 0.0, 0.0]), np.array([-5.0, 0.0, 0.0])
    for asked, flown in ((None, 0.1), (0.05, 0.05), (0.001, 0.02), (7.0, 0.1)):
        assert float(leading.law(there, here, speed=asked).velocity.guidance.speed) == pytest.approx(flown)


@pytest.mark.parametrize(
    ("tables", "named"),
    [
        ({"control": {"profile": "paper"}}, r"control\.profile"),
        ({"inspect": {"stand_off": 0.6}}, r"inspect\.stand_off: 0\.6 m"),
        ({"start": {"position": [2.3, 0.0, 0.0]}}, r"start\.position"),
        ({"camera": {"greatest_range": 1e5}}, r"^camera\.greatest_range, beyond the target: 100003 m"),
        ({"inspect": {"hold_points": [{"position": [0, 6e4, 0]}]}}, r"^inspect\.hold_points\.0\.position: 60000 m"),
    ],
)
def test_what_cannot_be_led_is_named_as_it_was_given(box, tables, named):
    with pytest.raises(KeepoutError, match=named):
        AroundMesh.of(scenario(**tables), box)


def test_the_law_is_made_to_reach_the_hold_points(box, leading):
    far = AroundMesh.of(scenario(inspect={"stand_off": 1.5, "hold_points": [{"position": [0.0, 40.0, 0.0]}]}), box)
    assert far.reach == pytest.approx(40.0)
    assert leading.reach < 40.0

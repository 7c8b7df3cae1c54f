"""Inspections beside zones: nothing is seen, flown or planned from in them, and what they hide is not called hidden."""

from itertools import pairwise

import numpy as np
import pytest
from truths.box_problems import BOX
from truths.boxes import HALF, box_distance

from keepout.apps.inspection.circumnavigation import circumnavigations
from keepout.apps.inspection.inspect import inspect
from keepout.apps.inspection.inspection import shares
from keepout.apps.inspection.planning import plan
from keepout.apps.inspection.problem import Problem, require_inspectable, require_something_to_see
from keepout.apps.inspection.seeing.seeable import Verdict
from keepout.apps.inspection.zones import mesh_and_zones
from keepout.core.audit.audit import Contact
from keepout.core.errors import InspectionError, ScenarioError
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import zones_judged
from keepout.flights.requirements import judged

pytestmark = pytest.mark.long

RADIUS, STAND_OFF = 0.5, 1.2
START = (5.0, 0.5, 0.3)
WALL = {"name": "wall", "shape": "box", "lower": (-40.0, -40.0, -40.0), "upper": (40.0, -2.0, 40.0)}
"""Beside the side y = -1.5 m of the box: every place that sees this side is less than the stand-off from it."""
APEX, AXIS, HALF_ANGLE = np.array([1.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8]), 0.35
BEAM = {"shape": "cone", "centre": tuple(APEX), "axis": tuple(AXIS), "half_angle": HALF_ANGLE, "length": 60.0}
SCENARIO = {
    "name": "look",
    "duration": 2000.0,
    "target": {"source": "box"},
    "field": {"source": "grid"},
    "chaser": {"radius": RADIUS},
    "camera": {"greatest_range": 6.0},
    "start": {"position": START},
    "disturbance": {"kind": "none"},
    "control": {"spacing": 0.4},
    "inspect": {"stand_off": STAND_OFF, "patch_size": 0.5, "candidates": 100},
    "require": {"zones": "proved"},
}


def scenario(*zones, **changes):
    return Scenario.parse(SCENARIO).replace(zone=zones, **changes)


def from_wall(places):
    return np.asarray(places)[:, 1] + 2.0


def from_beam(places):
    """Give the distance to the beam's side, or to its apex behind it."""
    away = np.asarray(places) - APEX
    size = np.linalg.norm(away, axis=1)
    angle = np.arccos(np.clip(away @ AXIS / size, -1.0, 1.0)) - HALF_ANGLE
    return np.where(angle < 0.5 * np.pi, size * np.sin(angle), size)


def planned(problem):
    return plan(problem, position=np.array(START), time=0.0, wanted=problem.seeable.possible)


@pytest.fixture(scope="module")
def walled():
    return Problem.of(scenario(WALL), BOX)


@pytest.fixture(scope="module")
def first(walled):
    return planned(walled)


def beside_wall(patches):
    return patches.counted & (patches.unit_normals()[:, 1] < -0.5)


def test_what_a_zone_hides_is_undecided_and_the_rest_has_witnesses_outside(walled):
    seeable, patches = walled.seeable, walled.patches
    behind = beside_wall(patches)
    assert (seeable.verdict[behind] == Verdict.UNDECIDED).all()  # the proof knows the mesh alone
    assert (seeable.verdict[patches.counted & ~behind] == Verdict.SEEABLE).all()
    assert from_wall(seeable.witness[seeable.verdict == Verdict.SEEABLE]).min() >= STAND_OFF
    assert seeable.upper == 1.0
    assert seeable.lower == pytest.approx(1.0 - patches.coverage(behind))


def test_views_and_ways_keep_the_stand_off_from_a_zone(walled, first):
    places = np.array([START, *(view.position for view in first.views)])
    assert from_wall(places).min() >= STAND_OFF
    assert first.covered.sum() == walled.seeable.possible.sum() - beside_wall(walled.patches).sum()
    for begin, end in pairwise(places):
        corners = walled.ways.path(begin, end)
        share = np.linspace(0.0, 1.0, 50)[:, None]
        for a, b in pairwise(corners):
            on_way = a + share * (b - a)
            assert from_wall(on_way).min() >= STAND_OFF - 1e-9
            assert box_distance(on_way).min() >= STAND_OFF - 1e-9


@pytest.mark.slow  # the command of tests/test_commands.py flies beside one
def test_an_inspection_enters_no_zone(walled, first):
    mission = scenario(WALL, inspect={"coverage": 0.5}, guard={"enabled": False})
    found = inspect(mission, problem=walled, first=first)
    assert found.outcome == "50 % asked, seen", found.why
    assert from_wall(found.record.position).min() >= STAND_OFF
    summary = found.summary()
    assert (summary["contact_verdict"], summary["zones_entered"]) == ("no", "no")
    assert summary["zones"][0]["name"] == 'zone "wall"'
    least = from_wall(found.record.position).min() - RADIUS
    assert least - 5e-3 <= summary["zones"][0]["minimum_clearance_m"] <= least + 1e-9
    assert [row["met"] for row in judged(mission, summary)] == [True]
    assert shares(found)["undecided"] == pytest.approx(found.patches.coverage(beside_wall(found.patches)))


@pytest.mark.slow
def test_a_guarded_inspection_beside_two_zones_sees_all_that_is_left_and_ends():
    mission = scenario(WALL, BEAM)
    problem = Problem.of(mission, BOX)
    found = inspect(mission, problem=problem)
    assert found.outcome == "nothing more to see", found.why
    assert found.coverage_seeable == 1.0
    assert found.coverage == pytest.approx(1.0 - found.patches.coverage(beside_wall(found.patches)))
    assert found.audit.contact is found.audit.zones_entered is Contact.NO
    assert found.start_certified
    for away in (from_wall, from_beam, box_distance):
        assert away(found.record.position).min() >= STAND_OFF
        assert away(np.array([view.position for view in found.plan.views])).min() >= STAND_OFF


@pytest.mark.slow
def test_a_start_far_behind_a_zone_is_led_round_it():
    plate = {"shape": "box", "lower": (-6.0, -5.0, 12.0), "upper": (6.0, 5.0, 13.0)}
    found = inspect(scenario(plate, start={"position": (0.0, 0.0, 22.0)}, inspect={"coverage": 0.2}))
    assert found.outcome == "20 % asked, seen", found.why
    assert found.audit.zones_entered is Contact.NO
    beyond = np.maximum(np.abs(found.record.position - (0.0, 0.0, 12.5)) - (6.0, 5.0, 0.5), 0.0)
    assert np.linalg.norm(beyond, axis=1).min() >= STAND_OFF


@pytest.mark.slow
def test_a_circumnavigation_keeps_the_stand_off_from_a_zone():
    ball, about = {"shape": "sphere", "centre": (0.0, 5.0, 0.0), "radius": 1.5}, {"tour": "circumnavigation"}
    start = {"position": (-30.0, 0.0, 0.0)}

    def least(*zones):
        ellipses = circumnavigations(scenario(*zones, start=start, inspect=about), BOX.distance.distance)
        return min(np.linalg.norm(one.position - ball["centre"], axis=1).min() - 1.5 for one in ellipses)

    assert least() < STAND_OFF <= least(ball)
    found = inspect(scenario(ball, start=start, inspect=about))
    assert found.audit.zones_entered is Contact.NO
    assert (np.linalg.norm(found.record.position - ball["centre"], axis=1) - 1.5).min() >= STAND_OFF


@pytest.mark.slow
def test_a_start_from_which_zones_leave_no_way_is_refused():
    between = {"shape": "box", "lower": (-200.0, 10.0, -200.0), "upper": (200.0, 11.0, 200.0)}
    with pytest.raises(InspectionError, match=r"^zone: 1, and no way that keeps inspect\.stand_off, 1\.2 m"):
        inspect(scenario(between, start={"position": (0.0, 14.0, 0.0)}))


@pytest.mark.parametrize(
    ("zone", "said"),
    [
        (
            {"centre": (5.0, 1.0, 0.3), "radius": 0.2},
            r"^start\.position: .* 0\.3 m from zone 0 and the chaser",
        ),
        ({"centre": START, "radius": 1.0}, r"^start\.position: .* 1 m inside zone 0 and the chaser"),
        ({"centre": (5.0, 2.5, 0.3), "radius": 1.0}, r"^start\.position: .* 1\.000 m from the target or a zone"),
    ],
)
def test_a_start_in_or_beside_a_zone_is_refused(zone, said):
    with pytest.raises((InspectionError, ScenarioError), match=said):
        require_inspectable(scenario(zone | {"shape": "sphere"}), BOX)


def test_hold_points_in_a_zone_and_legs_and_corridors_are_refused():
    held = {"hold_points": [{"position": (5.0, -3.0, 0.0)}]}
    with pytest.raises(ScenarioError, match=r'^inspect\.hold_points\.0\.position: .* 1 m inside zone "wall"'):
        require_inspectable(scenario(WALL, inspect=held), BOX)
    corridor = {"port": (HALF[0], 0.0, 0.0), "axis": (1.0, 0.0, 0.0), "length": 5.0, "radius": 1.0}
    mission = Scenario.parse(SCENARIO | {"zone": [WALL], "leg": [{"position": START}], "corridor": [corridor]})
    with pytest.raises(ScenarioError, match=r"^leg, corridor: "):
        require_inspectable(mission, BOX)


def test_zones_that_leave_nothing_to_see_and_other_zones_than_the_problems_are_refused(walled):
    ball = {"shape": "sphere", "centre": (0.0, 0.0, 0.0), "radius": 12.0}
    mission = scenario(ball, start={"position": (20.0, 0.0, 0.0)})
    problem = Problem.of(mission, BOX)
    with pytest.raises(InspectionError, match=r"^zone: 1, and inspect\.stand_off, 1\.2 m, or more"):
        require_something_to_see(mission, problem.seeable, problem.patches.counted)
    with pytest.raises(InspectionError, match="worked out for another zone than"):
        inspect(scenario(WALL | {"upper": (40.0, -2.5, 40.0)}), problem=walled)


def test_a_zone_counts_wherever_it_will_be():
    turning = [BEAM | {"axes": "inertial"}, BEAM | {"axes": "inertial", "centre": (0.0, 0.0, 0.0)}]
    mission = scenario(*turning, duration=1500.0)
    around = Surroundings(mission, BOX)
    points = np.random.default_rng(0).uniform(-12.0, 12.0, (300, 3))
    taken = mesh_and_zones(BOX.distance, around).distance(points)
    for region in zones_judged(around):
        assert len(region.rotations) > 1
        for rotation in region.rotations[::50]:
            assert (taken <= region.distance(points @ rotation.T) + 1e-9).all()
    assert mesh_and_zones(BOX.distance, Surroundings(scenario())) is BOX.distance

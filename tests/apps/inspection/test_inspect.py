"""The whole loop round a box: flown through views, judged by closed forms of what a box shows and how far it is."""

import dataclasses
import math

import numpy as np
import pytest
from truths.box_problems import patches_and_sight, problem_of
from truths.boxes import HALF, box_distance

from keepout.apps.inspection.inspect import inspect
from keepout.apps.inspection.light import Light
from keepout.apps.inspection.plan import InspectionPlan, PlannedView
from keepout.core.audit.audit import Contact
from keepout.core.errors import InspectionError
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

pytestmark = pytest.mark.long

RADIUS, STAND_OFF = 0.5, 1.2
"""Of the chaser, and what it keeps from the built-in box, m."""
SCENARIO = {
    "name": "look",
    "duration": 2000.0,
    "target": {"source": "box"},
    "field": {"source": "grid"},
    "chaser": {"radius": RADIUS},
    "camera": {"greatest_range": 6.0},
    "start": {"position": [5.0, 0.5, 0.3]},
    "disturbance": {"kind": "none"},
    "control": {"spacing": 0.4},
    "inspect": {"stand_off": STAND_OFF, "patch_size": 0.5, "candidates": 100},
}


def scenario(**changes):
    return Scenario.parse(SCENARIO).replace(**changes)


def tour(**windows):
    """A view of the middle of each side from straight above it, with all the units of that side."""
    patches, _ = patches_and_sight()
    views, covered = [], np.zeros(patches.units, dtype=bool)
    normals = patches.unit_normals()
    for name, outwards in zip(("x", "y", "z", "-x", "-y", "-z"), np.vstack([np.eye(3), -np.eye(3)])):
        units = np.flatnonzero(patches.counted & (normals @ outwards > 0.5))
        covered[units] = True
        views.append(PlannedView((HALF + 4.6) * outwards, -outwards, units, windows.get(name, (0.0, math.inf))))
    return InspectionPlan(tuple(views), covered, 40.0, 500.0, 6, 6, 6)


@pytest.fixture(scope="module")
def flown():
    mission = scenario()
    return inspect(mission, problem=problem_of(mission), first=tour())


@pytest.mark.slow  # flies all of the test before
def test_the_end_of_time_ends_the_same_flight_and_what_is_undecided_counts_in_the_figure(flown):
    """The end x = 2 m is undecided, though it can be seen: it is flown to, bit for bit, as if that were known."""
    patches, _ = patches_and_sight()
    end = patches.counted & (patches.unit_normals()[:, 0] > 0.5)
    mission = scenario(duration=100.0)
    less = inspect(mission, problem=problem_of(mission, undecided=end), first=tour())
    assert less.outcome == "out of time"
    assert less.record.time[-1] == 100.0
    assert np.array_equal(less.record.position, flown.record.position[: len(less.record.time)])
    areas = patches.unit_areas()
    assert 0.0 < areas[less.seen & end].sum() < areas.sum()
    assert less.summary()["coverage_possible"] == pytest.approx(areas[less.seen].sum() / areas.sum())
    assert less.coverage_seeable == pytest.approx(areas[less.seen & ~end].sum() / areas[~end].sum())


@pytest.mark.slow  # test_light.py has what counts in shadow
def test_in_the_earths_shadow_nothing_counts_and_what_it_cost_is_seen_in_later_light():
    mission = scenario(
        light={"kind": "sun"},
        orbit={"semi_major_axis": 6878000.0},
        sun={"direction": (-1, 0, 0)},
        duration=4000.0,
        inspect={"coverage": 0.5},
    )
    found = inspect(mission, problem=problem_of(mission), first=tour())
    dark = [frame for frame in found.frames if frame.sun is None]
    assert len(dark) > 50
    assert all(len(frame.units) == 0 for frame in dark)
    assert found.plans >= 2
    assert found.outcome == "50 % asked, seen", found.why
    assert found.coverage_seeable >= 0.49
    assert found.coverage < found.patches.coverage(found.patches.counted)
    assert found.audit.contact is Contact.NO
    least = math.cos(found.rules.greatest_sun_incidence) - 1e-9
    for frame in found.frames:
        if frame.sun is not None:
            assert (found.patches.unit_normals()[frame.units] @ frame.sun >= least).all()


@pytest.mark.slow  # hold points of approaches are in core/mission/test_approach
def test_a_hold_point_is_held_before_any_view_and_a_view_whose_window_is_then_over_is_planned_anew():
    hold = {"position": [4.0, 3.0, 0.0], "seconds": 60.0}
    mission = scenario(inspect={"hold_points": [hold], "coverage": 0.7})
    found = inspect(mission, problem=problem_of(mission), first=tour(**{"-x": (0.0, 10.0)}))
    near = np.linalg.norm(found.record.position - hold["position"], axis=1) < 0.15
    edges = np.flatnonzero(np.diff(near.astype(int)))
    assert edges[1] - edges[0] >= 60
    assert found.plans >= 2
    assert found.outcome == "70 % asked, seen", found.why
    assert 0.7 <= found.coverage < 1.0
    assert found.audit.contact is Contact.NO


@pytest.mark.slow  # another law's program; tests/core/mission/test_navigation.py flies by these sensors
def test_by_sensors_the_estimate_strikes_off_on_board_and_the_truth_is_what_counts():
    mission = scenario(
        navigation={"suite": "close", "estimate": "filter"},
        disturbance={"kind": "paper"},
        inspect={"stand_off": 1.8, "coverage": 0.5},
    )
    patches, problem = patches_and_sight()[0], problem_of(mission)
    found = inspect(mission, problem=problem, first=tour())
    assert found.outcome == "50 % asked, seen", found.why
    assert found.audit.contact is Contact.NO
    assert found.assumptions_broken == ()
    assert found.start_certified
    assert box_distance(found.record.position).min() >= 1.8
    off = np.linalg.norm(found.record.position - found.record.estimated_position, axis=1)
    assert np.median(off) > 1e-3
    assert off.max() < 0.1
    camera = problem.camera
    taken, reached, differing = np.zeros(patches.units, dtype=bool), [], 0
    for frame in found.frames:
        row = int(np.searchsorted(found.record.time, frame.time))
        assert np.array_equal(frame.units, camera.units(frame.time, found.record.position[row], frame.boresight))
        on_board = camera.units(frame.time, found.record.estimated_position[row], frame.boresight)
        differing += set(on_board.tolist()) != set(frame.units.tolist())
        taken[on_board] = True
        reached.append(patches.coverage(taken & found.lit) / patches.coverage(found.lit))
    # It ends with the first frame in which what was taken by the estimates is enough, whatever the truth shows.
    assert reached[-2] < 0.5 <= reached[-1] + 1e-12
    assert f"{reached[-1]:.2%} of what is not proved hidden was taken" in found.why
    assert differing > 0
    assert found.coverage_seeable >= 0.48


def test_a_problem_of_another_target_camera_or_light_is_refused():
    mission = scenario()
    made = problem_of(mission)
    other = dataclasses.replace(made, light=Light(scenario(light={"kind": "sun"})))
    for changed, options in (
        (mission, {"target": Target.load("pocket"), "problem": made}),
        (scenario(camera={"greatest_range": 5.0}), {"problem": made}),
        (mission, {"problem": other}),
    ):
        with pytest.raises(InspectionError, match="problem"):
            inspect(changed, **options)

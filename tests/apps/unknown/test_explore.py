"""The whole loop: seen, mapped, approached, and audited on the true mesh."""

import numpy as np
import pytest
import trimesh
from truths.made_meshes import joined, target_of

from keepout.apps.unknown import map_file
from keepout.apps.unknown.explore import explore
from keepout.core.audit.audit import Contact
from keepout.core.errors import KeepoutError
from keepout.core.guard.safety_layer import GuardFlag, GuardStatus
from keepout.core.mission.scenario import Scenario

SCENARIO = {
    "name": "crate",
    "duration": 900.0,
    "start": {"position": [7.5, 0.5, 0.3]},
    "goal": {"position": [-3.2, 0.2, 0.4], "tolerance": 0.15},
    "chaser": {"radius": 0.4},
    "map": {"radius": 5.0, "spacing": 0.2},
    "depth_sensor": {"width": 80, "height": 60, "surely_returned_width": 0.1},
}
"""Round a crate of 3 x 2 x 2 m: the goal lies behind it."""


def crate(size=(3.0, 2.0, 2.0), at=(0.0, 0.0, 0.0)):
    made = trimesh.creation.box(extents=size)
    return target_of(made.vertices + at, made.faces, "crate")


def scenario(**changes):
    return Scenario.parse(SCENARIO).replace(**changes)


HARD = {"depth_sensor": {"errors": "adversarial", "latency": 3.0}, "seed": 3}
"""Errors at their bounds, and late images."""


@pytest.fixture(scope="module")
def to_goal():
    return explore(scenario(**HARD), target=crate())


@pytest.mark.slow  # flies all of the test before
def test_a_seed_gives_the_same_flight_and_views_and_a_target_that_is_not_where_it_was_expected_is_reported(to_goal):
    again = explore(scenario(**HARD, duration=150.0), target=crate(), expected=crate(at=(0.0, 0.0, 1.5)))
    assert np.array_equal(again.record.position, to_goal.record.position[:151])
    again_seen, seen = ([(view.time, view.opened) for view in run.views] for run in (again, to_goal))
    assert len(again_seen) > 5
    assert again_seen == seen[: len(again_seen)]
    assert again.summary()["departures_largest_m"] > 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "outcome"),
    [
        ({"explore": {"towards": "all round"}, "duration": 4000.0}, "everything reachable seen"),
        ({"goal": {"position": [0.5, 0.2, 0.1]}, "duration": 4000.0}, "no way known"),  # within the body
        ({"start": {"position": [30.0, 0.5, 0.3]}, "duration": 1500.0}, "reached goal"),
        ({"depth_sensor": {"surely_returned_width": 0.008}}, "no way known"),  # it sees too short to open one
    ],
)
def test_every_end_is_said_and_nothing_is_touched(changes, outcome):
    found = explore(scenario(**changes), target=crate())
    assert found.outcome == outcome, found.why
    assert found.audit.contact is Contact.NO
    assert len(found.record.time) > 2
    assert outcome != "everything reachable seen" or found.summary()["seen_share"] > 0.97


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "at", "said"),
    [
        ({"duration": 60.0}, (4.0, 0.0, 0.0), ("map.radius 5", "outside the declared ball")),
        ({"duration": 60.0, "depth_sensor": {"broken": "late"}}, (0.0, 0.0, 0.0), ("late",)),
    ],
)
def test_a_target_beyond_its_ball_and_broken_promises_are_named(changes, at, said):
    found = explore(scenario(**changes), target=crate(at=at))
    for part in said:
        assert any(part in line for line in found.assumptions_broken)
    assert not found.start_certified
    assert found.outcome == "contradicted"
    assert found.views[-1].contradicting > 0
    assert set(found.assumptions_broken) >= set(found.map.broken)


def wired():
    """The crate with a wire of a millimetre, 3 m long, along x."""
    body, wire = crate(), crate(size=(3.0, 0.001, 0.001), at=(3.0, 0.0, 0.0))
    return target_of(*joined((body.vertices, body.faces), (wire.vertices, wire.faces)), "wired")


@pytest.fixture(scope="module")
def along_a_wire():
    return explore(scenario(start={"position": [7.5, 0.0, 0.0]}), target=wired())


@pytest.mark.slow  # the map that is contradicted: test_promises; the guard that holds then: core/guard/test_guard
def test_a_wire_that_no_ray_meets_is_named_and_what_is_seen_of_it_ends_the_flight(along_a_wire):
    found = along_a_wire
    assert any("assumption A1 (width 0.1 m) is broken" in line for line in found.assumptions_broken)
    assert not found.start_certified
    assert found.outcome == "contradicted", found.why
    assert found.views[-1].status == "contradicted"
    assert found.views[-1].opened == 0
    assert found.summary()["contradicting_returns"] == found.map.contradicting > 0
    assert found.audit.contact is Contact.NO
    # It held, by the guard's flag, came to rest, and went back to where it began.
    record, status = found.record, found.record.guard_status
    flagged = np.flatnonzero(status & GuardFlag.CONTRADICTED)
    assert record.time[flagged[0]] == found.views[-1].time
    assert np.array_equal(flagged, np.arange(flagged[0], flagged[-1] + 1))
    assert status[flagged[-1]] & 3 == GuardStatus.HOLDING
    assert np.linalg.norm(record.velocity[flagged[-1]]) < 0.01
    assert np.linalg.norm(record.position[-1] - record.position[0]) < 0.6


@pytest.mark.slow  # needs the flight of the test before
def test_a_flight_by_a_map_that_was_contradicted_says_so(along_a_wire, tmp_path):
    path = map_file.save(along_a_wire.map, tmp_path / "wired.keepmap")
    again = explore(scenario(map={"file": str(path)}, duration=20.0), target=wired())
    assert set(along_a_wire.map.assumptions_broken) <= set(again.assumptions_broken)
    assert any("map.file: " in line and "a part of the target" in line for line in again.assumptions_broken)
    assert not again.start_certified


@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"start": {"position": [5.2, 0.0, 0.0]}}, "start.position"),
        ({"depth_sensor": {"surely_returned_width": 0.001}}, "surely_returned_width"),
        ({"map": {"cap": 0.6}}, "map.cap"),
        ({"control": {"profile": "paper"}}, "control.profile"),
    ],
)
def test_what_cannot_be_explored_is_refused_in_a_line(changes, said):
    with pytest.raises(KeepoutError) as refusal:
        explore(scenario(**changes), target=crate())
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)

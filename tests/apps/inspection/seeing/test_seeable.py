"""What can be seen at all: against closed forms, and against every place of a dense set."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truths.made_meshes import patch_of, target_of

from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict, covers, seeable, shadow, shadows_of
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules, visible
from keepout.core.geometry.target import Target

pytestmark = pytest.mark.long

RULES = SeeingRules()


def rectangles(*parts) -> Target:
    """Make a target of rectangles, each an origin and two edges."""
    vertices, faces = [], []
    for origin, one, other in parts:
        o, a, b = (np.array(v, float) for v in (origin, one, other))
        k = len(vertices)
        vertices += [o, o + a, o + a + b, o + b]
        faces += [(k, k + 1, k + 2), (k, k + 2, k + 3)]
    return target_of(np.array(vertices, float), np.array(faces))


def judged(target: Target, size: float, stand_off: float, *, both: bool = True) -> Seeable:
    patches = cut(target, size)
    if both:
        patches = dataclasses.replace(patches, counted=np.ones(patches.units, bool))
    return seeable(Sightlines(target.vertices, target.faces, patches), RULES, Room(target.distance, stand_off))


def check_by_places(target: Target, found: Seeable, stand_off: float, places: np.ndarray) -> None:
    """Check that no unit called hidden is seen from places of the room, and that every witness sees its unit."""
    sight = Sightlines(target.vertices, target.faces, found.patches)
    for place in places:
        assert not (found.verdict[visible(sight, RULES, place).units] == Verdict.HIDDEN).any()
    shown = np.flatnonzero(found.verdict == Verdict.SEEABLE)
    assert Room(target.distance, stand_off).allowed(found.witness[shown]).all()
    for unit in shown:
        assert unit in visible(sight, RULES, found.witness[unit]).units
    assert np.isnan(found.witness[found.verdict != Verdict.SEEABLE]).all()
    assert ((found.why != Hidden.NOT) == (found.verdict == Verdict.HIDDEN)).all()


def test_all_of_a_box_can_be_seen_from_outside_and_nothing_of_its_inner_sides():
    target = Target.load("box")
    found = judged(target, 0.5, 1.5)
    outward = cut(target, 0.5).counted
    assert (found.verdict[outward] == Verdict.SEEABLE).all()
    assert (found.verdict[~outward] == Verdict.HIDDEN).all()
    assert (found.why[~outward] == Hidden.ENCLOSED).all()
    assert found.lower == found.upper == pytest.approx(0.5)


def test_between_two_plates_only_what_the_incidence_reaches_from_the_edge():
    # Plates of 4 m, 1 m apart, stand-off 1.5 m: the camera stays outside. A line at 60 degrees that leaves the gap
    # at its upper edge begins tan 60 = 1.73 m from the edge, so a patch is seen just if all of it is nearer than that.
    found = judged(rectangles(((-2, -2, 0), (4, 0, 0), (0, 4, 0)), ((-2, -2, 1), (4, 0, 0), (0, 4, 0))), 0.25, 1.5)
    patches = found.patches
    inner = np.where(np.repeat(patches.centres[:, 2], 2) < 0.5, 1.0, -1.0) * patches.unit_normals()[:, 2] > 0.0
    depth = np.repeat((2.0 - np.abs(patches.corners[..., :2]).max(axis=2)).max(axis=1), 2)
    assert (found.verdict[~inner] == Verdict.SEEABLE).all()
    reached = depth < np.sqrt(3.0)
    assert (found.verdict[inner & ~reached] == Verdict.HIDDEN).all()
    assert (found.verdict[inner & reached] == Verdict.SEEABLE).all()
    assert 0 < (inner & ~reached).sum() < (inner & reached).sum()


@pytest.mark.parametrize(("depth", "verdict"), [(8.0, Verdict.SEEABLE), (9.0, Verdict.HIDDEN)])
def test_the_floor_of_a_well_is_seen_while_the_range_reaches_it(depth, verdict):
    # A shaft of 1 m: the camera must stay 1.5 m from its rim, so a little more than 1.4 m above it, and sees 10 m far.
    walls = [((-0.5, y, 0), (1, 0, 0), (0, 0, depth)) for y in (-0.5, 0.5)]
    walls += [((x, -0.5, 0), (0, 1, 0), (0, 0, depth)) for x in (-0.5, 0.5)]
    found = judged(rectangles(((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0)), *walls), 0.5, 1.5)
    floor = np.repeat(np.abs(found.patches.centres[:, 2]) < 1e-9, 2) & (found.patches.unit_normals()[:, 2] > 0.5)
    assert floor.sum() >= 4
    assert (found.verdict[floor] == verdict).all()
    assert (found.why[floor] == (Hidden.NARROW if verdict == Verdict.HIDDEN else Hidden.NOT)).all()


def test_no_place_around_the_pocket_sees_what_is_called_hidden():
    target = Target.load("pocket")
    found = judged(target, 0.5, 1.0, both=False)
    places = np.random.default_rng(0).uniform(target.distance.lower - 4.0, target.distance.upper + 4.0, (1500, 3))
    places = places[Room(target.distance, 1.0).allowed(places)]
    check_by_places(target, found, 1.0, places)
    assert found.upper - found.lower <= 0.002


@settings(max_examples=settings().max_examples // 6)
@given(seed=st.integers(0, 10**6))
def test_no_place_around_loose_triangles_sees_what_is_called_hidden(seed):
    generator = np.random.default_rng(seed)
    number = int(generator.integers(4, 24))
    middles = generator.uniform(-0.6, 0.6, (number, 1, 3))
    vertices = (middles + generator.uniform(-1.0, 1.0, (number, 3, 3))).reshape(-1, 3)
    target = target_of(vertices, np.arange(3 * number).reshape(-1, 3))
    found = judged(target, 0.5, 0.5)
    places = generator.normal(size=(600, 3))
    places *= (generator.uniform(0.7, 6.0, 600) / np.linalg.norm(places, axis=1))[:, None]
    check_by_places(target, found, 0.5, places[Room(target.distance, 0.5).allowed(places)])


@given(seed=st.integers(0, 10**6))
def test_a_shadow_is_where_the_sight_lines_are_blocked(seed):
    generator = np.random.default_rng(seed)
    size = float(10.0 ** generator.uniform(-2.0, 0.0))
    plate = size * np.array([[-0.5, -0.4], [0.5, -0.5], [0.4, 0.5], [-0.3, 0.3]])
    plate -= plate.mean(axis=0)
    corners = np.concatenate([plate, np.zeros((4, 1))], axis=1)
    height = float(generator.uniform(1.0, 5.0))
    blocker = generator.uniform(-1.0, 1.0, (3, 3)) * [1.0, 1.0, 0.5 * height] + [0.0, 0.0, 0.5 * height]
    vertices = np.concatenate([corners, blocker])
    sight = Sightlines(vertices, np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6)]), patch_of(corners, size))
    frame, shadows = np.concatenate([np.zeros((1, 3)), np.eye(3)]), shadows_of(1)
    number, edges = shadow(blocker.reshape(9), frame, plate, height, 2.5, 10.0, shadows, 0), shadows.edges[0]
    directions = generator.uniform(-1.7, 1.7, (400, 2))
    inside = np.array([number > 0 and covers(edges, number, x, y, 0.0) for x, y in directions])
    for higher in (1.0, 1.3, 4.0):
        places = np.concatenate([directions, np.ones((400, 1))], axis=1) * height * higher
        clear = sight.clear(places, np.zeros(400, dtype=np.int64))
        assert not (inside & clear).any()
        if higher == 1.0:
            # Nothing else is blocked, but for what lies within a few lifts of the two planes.
            assert (~inside & ~clear).sum() <= 4


def test_a_proof_that_a_clock_ends_says_so_and_what_is_counted_ends_where_it_did():
    target = Target.load("box")
    patches = cut(target, 0.5)
    sight, room = Sightlines(target.vertices, target.faces, patches), Room(target.distance, 1.5)
    found = seeable(sight, RULES, room, seconds=-1.0)
    assert (found.verdict == Verdict.UNDECIDED).all()
    assert (found.lower, found.upper, found.by_clock) == (0.0, 1.0, True)
    whole, again = (seeable(sight, RULES, room, squares=count) for count in (10**9, 1))
    assert not whole.by_clock
    assert 0 < again.squares <= whole.squares

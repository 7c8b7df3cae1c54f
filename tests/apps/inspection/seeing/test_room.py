"""The room allowed to a chaser: against boxes whose room is known in closed form, and against its own two bounds."""

import numpy as np
import pytest

from keepout.apps.inspection.seeing.room import Room, beam_workspace, meets_room
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.target import Target

# Its kernels take ten seconds and more to compile.
pytestmark = pytest.mark.long

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
SIDES = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])


def shell(half: float, *, open_top: float = 0.0) -> ExactDistance:
    """Make a hollow cube; its top has a square hole of half width `open_top` where that is positive."""
    vertices = CORNERS * half
    faces = [triangle for a, b, c, d in SIDES[:-1] for triangle in ((a, b, c), (a, c, d))]
    top = [1, 5, 7, 3]
    if open_top <= 0.0:
        faces += [(top[0], top[1], top[2]), (top[0], top[2], top[3])]
    else:
        ring = vertices[top] * [open_top / half, open_top / half, 1.0]
        vertices = np.concatenate([vertices, ring])
        for i in range(4):
            j = (i + 1) % 4
            faces += [(top[i], top[j], 8 + j), (top[i], 8 + j, 8 + i)]
    return ExactDistance(vertices, np.array(faces))


def surely_not(room, centres, half_widths):
    """Whether boxes lie wholly too near the mesh, or in no cell of possible room."""
    half = np.broadcast_to(half_widths.reshape(len(centres), -1), centres.shape)
    near = room.distance.distance(centres) + np.linalg.norm(half, axis=1) + 1e-9 < room.stand_off
    limits, work = room.limits(SeeingRules()), beam_workspace()
    for n in np.flatnonzero(~near):
        work.box[:] = *(centres[n] - half[n] - 1e-9), *(centres[n] + half[n] + 1e-9)
        near[n] = not meets_room(limits, work)
    return near


def outside_distance(points: np.ndarray, half: float) -> np.ndarray:
    """Distance to a cube's surface from outside; 0 within."""
    return np.linalg.norm(np.maximum(np.abs(points) - half, 0.0), axis=1)


def test_outside_of_a_closed_cube_is_the_room_and_its_hollow_is_not():
    room = Room(shell(3.0), 1.0)
    points = np.random.default_rng(0).uniform(-6.0, 6.0, (20000, 3))
    true = outside_distance(points, 3.0) >= 1.0
    allowed = room.allowed(points)
    assert not (allowed & ~true).any()
    # What is missing lies at the border: a millionth above the stand-off is enough.
    assert allowed[outside_distance(points, 3.0) >= 1.0 + 1e-6].all()
    not_allowed = surely_not(room, points, np.full(len(points), 1e-3))
    assert not (not_allowed & true).any()
    assert not_allowed[outside_distance(points, 3.0) < 0.99].all()
    # Points in the middle are 2 m from any wall, farther than the stand-off.
    assert (room.distance.distance(points[np.abs(points).max(axis=1) < 1.9]) >= 1.0).all()


@pytest.mark.parametrize(("hole", "open_"), [(0.9, False), (1.3, True)])
def test_an_opening_counts_where_the_stand_off_passes(hole, open_):
    # A ball of the stand-off, 1 m, goes through a square hole just if that is 2 m wide.
    room = Room(shell(3.0, open_top=hole), 1.0, leaf=0.1)
    inside = np.random.default_rng(2).uniform(-1.9, 1.9, (200, 3))
    assert (room.allowed(inside) == open_).all()
    assert (surely_not(room, inside, np.full(len(inside), 0.01)) != open_).all()


@pytest.mark.parametrize("name", ["box", "pocket"])
def test_the_two_bounds_never_contradict(name):
    target = Target.load(name)
    room = Room(target.distance, 0.6)
    generator = np.random.default_rng(3)
    points = generator.uniform(target.distance.lower - 1.5, target.distance.upper + 1.5, (20000, 3))
    allowed = room.allowed(points)
    assert allowed.any()
    offset = generator.uniform(-0.1, 0.1, points.shape)
    assert not (allowed & surely_not(room, points + offset, np.abs(offset) + 1e-12)).any()
    assert (target.distance.distance(points[allowed]) >= 0.6).all()


def test_a_stand_off_must_be_positive():
    with pytest.raises(InspectionError, match="stand_off is 0 m"):
        Room(Target.load("box").distance, 0.0)

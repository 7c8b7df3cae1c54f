"""The least height of a beam: below it no place of a dense set is allowed, and not far above it some place is."""

import math

import numpy as np
import pytest

from keepout.apps.inspection.seeing.room import Room, beam_workspace, first_place, least_height
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.core.geometry.target import Target

# Its kernels take ten seconds and more to compile.
pytestmark = pytest.mark.long

OUTLINE = np.array([[-0.6, -0.4], [0.5, -0.5], [0.4, 0.6], [-0.5, 0.3]])
RULES = SeeingRules(greatest_range=4.0, least_range=1.2, greatest_sample_distance=0.006)


@pytest.mark.parametrize("name", ["box", "pocket"])
def test_no_place_below_the_least_height_is_allowed(name):
    target = Target.load(name)
    room = Room(target.distance, 1.0)
    limits = room.limits(RULES)
    generator = np.random.default_rng(0)
    used = target.vertices[target.faces]
    checked = 0
    for _ in range(120):
        face = used[generator.integers(len(used))]
        normal = np.cross(face[1] - face[0], face[2] - face[0]) * generator.choice([-1.0, 1.0])
        first = (face[1] - face[0]) / np.linalg.norm(face[1] - face[0])
        normal /= np.linalg.norm(normal)
        frame = np.stack([face.mean(axis=0), first, np.cross(normal, first), normal])
        middle, half = generator.uniform(-1.6, 1.6, 2), float(10.0 ** generator.uniform(-4.0, -0.5))
        height = least_height(limits, frame, OUTLINE, middle[0], middle[1], half, 0.3, beam_workspace())
        top = min(height, 4.5)
        heights = np.concatenate([generator.uniform(0.3, top, 150), generator.uniform(0.97 * top, top, 50)])
        directions = middle + generator.uniform(-half, half, (200, 2))
        directions[::2] = middle + half * generator.choice([-1.0, 1.0], (100, 2))
        places = np.concatenate([directions, np.ones((200, 1))], axis=1) * heights[:, None]
        ranges = np.linalg.norm(np.pad(OUTLINE, ((0, 0), (0, 1))) - places[:, None], axis=2)
        near, far = ranges.min(axis=1), ranges.max(axis=1)
        kept = (near > RULES.least_range) & (far < RULES.greatest_range)
        kept &= heights >= math.cos(RULES.greatest_incidence) * far
        kept &= far**2 * RULES.pixel_angle <= RULES.greatest_sample_distance * heights
        allowed = room.allowed(frame[0] + places @ frame[1:])
        below = heights < height
        assert not (kept & allowed & below).any()
        checked += int(below.sum())
    assert checked > 12000


def test_over_a_plate_the_least_height_is_the_stand_off():
    # Over the middle of the box's top the nearest place allowed is the stand-off above it.
    target = Target.load("box")
    limits = Room(target.distance, 1.0).limits(SeeingRules())
    frame = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    height = least_height(limits, frame, 0.1 * OUTLINE, 0.0, 0.0, 1e-6, 0.3, beam_workspace())
    assert 1.0 - 1e-3 <= height <= 1.0


def test_a_beam_begins_no_higher_than_any_place_that_is_allowed_in_it():
    """Over the top of a box, with the stand-off at 1 m and the greatest range 5 cm farther."""
    limits = Room(Target.load("box").distance, 1.0).limits(SeeingRules(least_range=0.5, greatest_range=1.05))
    frame = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    work = beam_workspace()
    generator, reached = np.random.default_rng(0), 0
    for _ in range(200):
        middle, half = generator.uniform(-0.6, 0.6, 2), generator.uniform(0.05, 0.4)
        height = least_height(limits, frame, 0.01 * OUTLINE, *middle, half, 0.3, work)
        for direction in middle + half * generator.uniform(-1.0, 1.0, (20, 2)):
            place = first_place(limits, frame, 0.01 * OUTLINE, *direction, 0.3, work)
            assert height <= place
            reached += place < np.inf
    assert reached > 400

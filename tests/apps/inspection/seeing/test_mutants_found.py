"""A beam's least height against the places that are allowed in it, where the range leaves little room."""

import numpy as np

from keepout.apps.inspection.seeing.beam import first_place, least_height
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.core.geometry.target import Target


def test_a_beam_begins_no_higher_than_any_place_that_is_allowed_in_it():
    """Over the top of a box, with the stand-off at 1 m and the greatest range 5 cm farther."""
    limits = Room(Target.load("box").distance, 1.0).limits(SeeingRules(least_range=0.5, greatest_range=1.05))
    frame = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    outline = 0.01 * np.array([[-0.6, -0.4], [0.5, -0.5], [0.4, 0.6], [-0.5, 0.3]])
    work = np.empty(192, dtype=np.int64), np.empty(192), np.empty((192, 4)), np.empty(6)
    generator, reached = np.random.default_rng(0), 0
    for _ in range(200):
        middle, half = generator.uniform(-0.6, 0.6, 2), generator.uniform(0.05, 0.4)
        height = least_height(limits, frame, outline, 4, *middle, half, 0.3, *work)
        for direction in middle + half * generator.uniform(-1.0, 1.0, (20, 2)):
            place = first_place(limits, frame, outline, 4, *direction, 0.3, *work)
            assert height <= place
            reached += place < np.inf
    assert reached > 400

"""Candidate views: what they are said to see is seen by the rules, and few directions show all of a place."""

import math

import numpy as np
import pytest

from keepout.apps.inspection.candidates import aim, boresights_of, candidates
from keepout.apps.inspection.light import Light
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.seeable import Seeable, Verdict
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules, Visible, in_view, visible
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

RULES = SeeingRules(greatest_range=6.0)
STAND_OFF = 1.0


class Nowhere(Room):
    """A room in which no place is allowed."""

    def allowed(self, points):
        return np.zeros(len(points), dtype=bool)


def views_of(target, places, room=Room, witness=None):
    """Give sight lines and views among so many places, and from the witness of the first unit."""
    patches = cut(target, 0.5)
    sight = Sightlines(target.vertices, target.faces, patches)
    verdict = np.where(patches.counted, Verdict.SEEABLE, Verdict.HIDDEN).astype(np.int8)
    witnesses = np.full((patches.units, 3), np.nan)
    if witness is not None:
        witnesses[0] = patches.centres[0] + witness * patches.unit_normals()[0]
    mission = Scenario().replace(inspect={"candidates": places, "stand_off": STAND_OFF})
    seeable = Seeable(patches, verdict, np.zeros_like(verdict), witnesses)
    where = room(target.distance, STAND_OFF)
    problem = Problem(mission, target, patches, RULES, sight, where, seeable, Light(mission))
    return target, sight, candidates(problem, patches.counted, 0.0, within=RULES)[0]


@pytest.fixture(scope="module")
def found():
    return views_of(Target.load("pocket"), 60)


def test_views_see_what_they_say_and_keep_the_stand_off(found):
    target, sight, views = found
    assert len(views.positions) == len(views.boresights) == views.sees.shape[0] > 60
    assert target.distance.distance(views.positions).min() >= STAND_OFF
    assert np.allclose(np.linalg.norm(views.boresights, axis=1), 1.0)
    for row in range(0, len(views.positions), 7):
        seen = visible(sight, RULES, views.positions[row])
        said = views.sees[[row]].indices
        assert set(said) <= set(seen.units[in_view(seen, views.boresights[row], RULES.half_angle + 1e-9)])


def test_witnesses_bring_what_drawn_places_miss():
    _, sight, views = views_of(Target.load("box"), 8, Nowhere, witness=2.0)
    assert sight.patches.counted[0]
    assert views.places == 1
    assert views.sees[:, [0]].sum() >= 1


def test_few_directions_show_all_that_is_visible():
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2])
    seen = Visible(np.arange(300), directions, generator.uniform(0.0, 0.1, 300))
    areas = generator.uniform(0.5, 1.0, 300)
    chosen, units = boresights_of(seen, areas, np.ones(300, dtype=np.int64), math.radians(40.0))
    for boresight, some in zip(chosen, units, strict=True):
        assert set(some) == set(np.flatnonzero(in_view(seen, boresight, math.radians(40.0))))
    # A half sphere is 4.3 caps of that size by area.
    assert areas[np.unique(np.concatenate(units))].sum() > 0.97 * areas.sum()
    assert len(chosen) <= 8


def test_the_planned_direction_stays_while_it_shows_all_and_gives_way_where_another_does():
    place, planned = np.zeros(3), np.array([0.0, 0.0, 1.0])
    within = np.array([[0.5, 0.0, 2.0], [-0.5, 0.0, 2.0]])
    assert aim(place, within, planned, np.radians(30.0)) is planned
    aside = np.array([[2.0, 0.0, 2.0], [2.0, 0.5, 2.0]])
    turned = aim(place, aside, planned, np.radians(30.0))
    assert np.all(aside @ turned >= np.linalg.norm(aside, axis=1) * np.cos(np.radians(30.0)))
    around = np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.0, -2.0]])
    assert aim(place, around, planned, np.radians(30.0)) is planned
    assert aim(place, np.zeros((0, 3)), planned, 0.5) is planned
    assert aim(place, place[None], planned, 0.5) is planned

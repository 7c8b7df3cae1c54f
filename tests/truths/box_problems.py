"""What is to be seen of the built-in box, without its proof: from outside each of its sides is seen."""

from functools import cache

import numpy as np

from keepout.apps.inspection.light import Light
from keepout.apps.inspection.problem import Problem, rules_of
from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.core.geometry.target import Target

BOX = Target.load("box")


@cache
def patches_and_sight():
    """Give patches of half a metre and their sight lines."""
    patches = cut(BOX, 0.5)
    return patches, Sightlines(BOX.vertices, BOX.faces, patches)


@cache
def room(stand_off):
    """Give what is left to a chaser."""
    return Room(BOX.distance, stand_off)


def problem_of(mission, undecided=None):
    """Give the problem of a mission; units named undecided are so."""
    patches, sight = patches_and_sight()
    above = np.repeat(patches.centres, 2, axis=0) + 3.0 * patches.unit_normals()
    witness = np.where(patches.counted[:, None], above, np.nan)
    verdict = np.where(patches.counted, Verdict.SEEABLE, Verdict.HIDDEN).astype(np.int8)
    if undecided is not None:
        verdict[undecided] = Verdict.UNDECIDED
    why = np.where(patches.counted, Hidden.NOT, Hidden.ENCLOSED).astype(np.int8)
    seeable = Seeable(patches, verdict, why, witness)
    where = room(mission.inspect.stand_off)
    return Problem(mission, BOX, patches, rules_of(mission), sight, where, seeable, Light(mission))

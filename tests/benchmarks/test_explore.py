"""The counts of `benchmarks/explore.py` find what is wrong when it is made wrong by hand."""

import numpy as np
import pytest
from explore_counts import bad_cubes, meeting

from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.view import SensorBounds
from keepout.core.geometry.mesh_files.contents import MeshContents
from keepout.core.geometry.target import Target, describe

HALF = np.array([0.61, 0.42, 0.33])
"""Of the box, m."""


@pytest.fixture(scope="module")
def box():
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([t for q in quads for t in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])])
    surface = MeshContents(corners * HALF, faces)
    return Target("box", surface.vertices, surface.faces, describe(surface))


def known_round(box):
    """A map in which all cubes that do not meet the box are free."""
    known = KnownFreeMap.begin(np.zeros(3), 1.0, bounds=SensorBounds(), name="box")
    centres = known.origin + known.spacing * (np.argwhere(np.ones_like(known.free)) + 0.5)
    beyond = (np.abs(centres) - 0.5 * known.spacing > HALF).any(axis=1)
    known.fill(beyond.reshape(known.free.shape))
    return known


@pytest.mark.long
def test_a_sound_map_has_no_bad_cube_and_one_made_bad_by_hand_is_found(box):
    known = known_round(box)
    assert len(bad_cubes(known, meeting(box, known))) == 0
    corner = np.floor((HALF - known.origin) / known.spacing).astype(int)
    known.free[tuple(corner)] = True
    assert bad_cubes(known, meeting(box, known)).tolist() == [corner.tolist()]

"""The cells that a grid field's error bound looks at are all that {d = R} can meet, against plain enumeration."""

import numpy as np
import pytest
import trimesh
from truths.cells import used_cells

from keepout.fields.evaluate import values
from keepout.fields.grid_build import build_grid
from keepout.geometry.level_points import level_points
from keepout.geometry.octree import CORNERS, straddling_cells
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.proof import grid

RADIUS = 0.5


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """Three plates for which the cubes that cover {d = 0.5 m} are the grid's own cells, 0.125 m wide.

    Between the plates {d = 0.5 m} lies amid a layer of cells, and a single layer of cubes covers it.
    """
    path = tmp_path_factory.mktemp("plates") / "plates.stl"
    boxes = [((3.0, 3.0, 0.125 if z == 0.0 else 0.0625), (0.0, 0.0, z)) for z in (-1.34375, 0.0, 1.34375)]
    trimesh.util.concatenate(
        [trimesh.creation.box(extents).apply_translation(place) for extents, place in boxes]
    ).export(path)
    return Target.load(path, units="m")


@pytest.fixture(scope="module")
def model(plates):
    return build_grid(plates, spacing=0.125, band=0.5, solid=OffsetSolid.build(plates.distance))


@pytest.fixture(scope="module")
def cubes(plates, model):
    h = float(model.field.spacing)
    pad = RADIUS + h
    lower, upper = plates.distance.lower - pad, plates.distance.upper + pad
    return straddling_cells(plates.distance, RADIUS, leaf=h, lower=lower, upper=upper)


def touching(field, distance, cubes):
    """(level, node) of each cell that shares a point with a cube, as closed boxes, by comparing each with each."""
    lower, side, key = used_cells(field)
    centres, half = cubes
    middle = lower + 0.5 * side[:, None]
    # Further from {d = R} than this no cell can touch a cube that meets it.
    near = np.abs(distance.distance(middle) - RADIUS) <= 3.0**0.5 * (side + 2.0 * half.max())
    middle, side, key = middle[near], side[near], key[near]
    answer = np.zeros(len(side), bool)
    for first in range(0, len(side), 256):
        part = slice(first, first + 256)
        gap = np.full((len(side[part]), len(centres)), -np.inf)
        for axis in range(3):
            np.maximum(gap, np.abs(middle[part, None, axis] - centres[:, axis]), out=gap)
        answer[part] = (gap <= 0.5 * side[part, None] + half + 1e-12).any(axis=1)
    return {tuple(map(int, row)) for row in key[answer]}


@pytest.mark.long
def test_every_touched_cell_is_looked_at(model, plates, cubes):
    field = model.field
    touched = touching(field, plates.distance, cubes)
    number, level, node = grid._touched(field, *cubes)
    looked_at = {tuple(map(int, row)) for row in np.column_stack([level, node])}
    assert len(number) == len(looked_at)
    assert touched <= looked_at
    # And none beyond reach: those added by the slack only share a face.
    wider = (cubes[0], cubes[1] * (1.0 + 1e-6) + 1e-6)
    assert looked_at <= touching(field, plates.distance, wider)
    # A look at the cubes' corners alone, as cubes and cells are aligned here, leaves many out.
    at_corners = set()
    for corner in CORNERS:
        place = cubes[0] + corner * (cubes[1] * (1.0 + 1e-9) + 1e-9)[:, None]
        u = (place - np.asarray(field.origin)) / float(field.spacing)
        for n in range(len(field.tables)):
            found = np.column_stack([np.full(len(u), n), np.floor(u / 2**n).astype(int)])
            at_corners |= {tuple(map(int, row)) for row in found} & touched
    assert len(at_corners) < 0.95 * len(touched)


@pytest.mark.long
def test_a_cell_that_no_cube_has_a_corner_in_counts(model, plates, cubes):
    """Every place with d = R lies in a cell that was looked at, and the bound holds there."""
    field = model.field
    proof = grid.certify_grid(model, plates, chaser_radius=RADIUS).certificate(RADIUS)
    points = level_points(plates.distance, RADIUS, 20_000, np.random.default_rng(0))
    assert (values(field, points) - RADIUS).max() <= proof.error_bound
    _, level, node = grid._touched(field, *cubes)
    looked_at = {tuple(map(int, row)) for row in np.column_stack([level, node])}
    u = (points - np.asarray(field.origin)) / float(field.spacing)
    inside = [[(n, *map(int, place)) in looked_at for place in np.floor(u / 2**n)] for n in range(len(field.tables))]
    assert np.any(inside, axis=0).all()

"""The folder and the pictures of an inspection, against what the made-up one saw, in closed form."""

import matplotlib.image
import numpy as np
import pytest
from truths.made_up_inspection import made_up

from keepout.apps.inspection import inspection_pictures
from keepout.apps.inspection.inspection import Fate
from keepout.apps.inspection.inspection_pictures import best_views

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def inspection():
    return made_up()


def test_the_surface_has_the_colour_of_what_became_of_it(inspection, tmp_path):
    """What is seen of the box from above, back: +z, +y and +x, but for a row of +z not seen at all or seen."""
    inspection_pictures.draw_fates(tmp_path / "surface.png", inspection)
    picture = matplotlib.image.imread(tmp_path / "surface.png")[..., :3]
    found = {}
    for kind in Fate:
        colour = np.array([int(kind.colour[place : place + 2], 16) / 255.0 for place in (1, 3, 5)])
        share = picture @ colour / (colour @ colour)  # shaded, a colour keeps its direction
        found[kind] = ((np.abs(picture - share[..., None] * colour).max(axis=2) < 0.02) & (share > 0.5)).sum()
    assert all(
        found[kind] > 5000
        for kind in (Fate.SEEN, Fate.MISSED, Fate.ENCLOSED_BY_RAYS, Fate.NARROW_BY_RAYS, Fate.UNDECIDED)
    )
    assert found[Fate.SHADOWED] == 0
    assert found[Fate.SEEN] > 4 * found[Fate.UNDECIDED]


def test_each_part_has_the_frame_that_shows_most_of_it_and_parts_share_no_unit(inspection):
    views = best_views(inspection)
    areas, patches = inspection.patches.unit_areas(), inspection.patches
    together = np.concatenate([view.units for view in views])
    assert len(np.unique(together)) == len(together)
    fair = inspection.seen | inspection.lit
    assert sorted(together.tolist()) == np.flatnonzero(fair & patches.counted).tolist()
    normals = patches.unit_normals()
    assert all(np.ptp(normals[view.units], axis=0).max() == 0.0 for view in views)  # a part of a box is on one side
    for view in views:
        scores = []
        for frame in inspection.frames:
            units = np.intersect1d(frame.units, view.units)
            away = frame.position - patches.centres[units // 2]
            far = np.linalg.norm(away, axis=1)
            cosine = np.einsum("ni,ni->n", away, normals[units]) / far
            scores.append((areas[units] * cosine / far**2).sum() * areas[units].sum())
        if view.frame < 0:
            assert max(scores) == 0.0
            continue
        assert scores[view.frame] == pytest.approx(max(scores))
        assert set(view.shown) == set(view.units) & set(inspection.frames[view.frame].units)
        assert view.share == pytest.approx(areas[view.shown].sum() / areas[view.units].sum())

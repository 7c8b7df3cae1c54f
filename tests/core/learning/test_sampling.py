"""Labels of points inside a target, against boxes whose depth is a closed form."""

import numpy as np
import pytest
import trimesh

from keepout.core.fields.continuation import Domain
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.losses import TrainingProfile
from keepout.core.learning.samples import HIDDEN_DEPTH, label, training_points

HALF = np.array([2.0, 1.5, 1.2])
OFFSET = 0.001


def depth(points, half):
    """Distance to the faces of a box, of points inside it."""
    return (half - np.abs(points)).min(axis=1)


@pytest.fixture(scope="module")
def inside():
    points = np.random.default_rng(0).uniform(-HALF, HALF, (2000, 3))
    return points[depth(points, HALF) > 0.01]


def solid_of(meshes, tmp_path):
    path = tmp_path / "mesh.ply"
    trimesh.util.concatenate(meshes).export(path)
    return OffsetSolid.build(Target.load(path, units="m").distance, offset=OFFSET)


@pytest.fixture
def box(tmp_path):
    return solid_of([trimesh.creation.box(extents=2 * HALF)], tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(("spread", "farthest"), [((0.05, 0.2), 0.2), ((0.05, 100.0), 0.6 * np.linalg.norm(HALF))])
def test_samples_next_to_the_surface_lie_within_the_distance_that_the_profile_says(box, spread, farthest):
    """In that order: on the surface, next to it, in the ball."""
    profile = TrainingProfile(spread=spread, room_share=0.0)
    points = training_points(box.distance, Domain.around(box.distance), 6000, np.random.default_rng(0), profile)
    on, near = points[:600], points[600:5000]
    assert box.distance.distance(on).max() < 1e-9
    assert box.distance.distance(near).max() <= farthest
    assert box.distance.distance(near).max() > 0.9 * farthest


@pytest.mark.long
@pytest.mark.parametrize("nearest", [0.02, 0.1, 0.2])
def test_samples_next_to_the_surface_are_even_in_the_logarithm_of_their_distance(box, nearest):
    """Moved from the surface by lengths of the closed form's mean, whichever way: half of that from a face."""
    profile = TrainingProfile(spread=(nearest, 0.2), room_share=0.0)
    points = training_points(box.distance, Domain.around(box.distance), 20_000, np.random.default_rng(0), profile)
    mean = 0.2 if nearest == 0.2 else (0.2 - nearest) / np.log(0.2 / nearest)
    assert box.distance.distance(points[2000:16_000]).mean() == pytest.approx(0.5 * mean, rel=0.1)


@pytest.mark.long
def test_the_whole_depth_of_a_box_is_exact(box, inside):
    labels = label(box, inside, whole_depth=True)
    assert labels.hidden.all()
    np.testing.assert_allclose(labels.distance, -(depth(inside, HALF) + OFFSET), atol=1e-5)


@pytest.mark.long
def test_without_the_whole_depth_a_label_goes_no_deeper_than_the_loss_asks(box, inside):
    labels = label(box, inside)
    np.testing.assert_allclose(labels.distance, -np.minimum(depth(inside, HALF) + OFFSET, HIDDEN_DEPTH), atol=1e-5)


@pytest.mark.long
def test_a_sheet_within_a_box_is_no_way_out(tmp_path, inside):
    """Between outer and inner box the nearest surface may be the inner one, which leads nowhere."""
    nested = solid_of([trimesh.creation.box(extents=2 * HALF), trimesh.creation.box(extents=1.6 * HALF)], tmp_path)
    labels = label(nested, inside, whole_depth=True)
    truth = -(depth(inside, HALF) + OFFSET)
    cell = 2.0 * (nested.envelope + 2 * OFFSET)
    assert labels.hidden.all()
    assert np.all(np.abs(labels.distance - truth) <= cell)
    nearest_is_inner = nested.distance.distance(inside) + cell < depth(inside, HALF)
    assert nearest_is_inner.sum() > 100

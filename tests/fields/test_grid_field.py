"""The grid field against exact distances, and its bounds against search."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.errors import FieldError
from keepout.fields.evaluate import values, values_gradients_hessians
from keepout.fields.grid import BLOCK, GridField
from keepout.fields.grid_build import build_grid
from keepout.fields.model import FieldModel
from keepout.geometry.level_points import surface_points
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.proof.certificate import onto_level
from keepout.proof.grid import certify_grid

pytestmark = pytest.mark.long

H = 0.1


@pytest.fixture(scope="module")
def target():
    return Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})


@pytest.fixture(scope="module")
def solid(target):
    return OffsetSolid.build(target.distance)


@pytest.fixture(scope="module")
def model(target, solid):
    model = build_grid(target, spacing=H, band=0.6, solid=solid)
    return certify_grid(certify_grid(model, target), target, chaser_radius=0.3)


def exact_box_distance(target, points):
    half = 0.5 * (target.vertices.max(axis=0) - target.vertices.min(axis=0))
    q = np.abs(points - 0.5 * (target.vertices.max(axis=0) + target.vertices.min(axis=0))) - half
    return np.where((q > 0).any(axis=1), np.linalg.norm(np.maximum(q, 0.0), axis=1), -q.max(axis=1))


def test_within_one_spacing_of_the_distance_everywhere_in_the_band(model, target, solid):
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.2, 1.2, (50_000, 3))
    d = exact_box_distance(target, points)
    near = (d < 0.3) & solid.is_exterior(points)
    error = values(model.field, points[near]) - solid.signed_distance(points[near])
    assert np.abs(error).max() <= H
    assert np.abs(error).max() > 0.05 * H


@pytest.mark.parametrize("radius", [0.0, 0.3])
def test_certificate_holds_on_the_contact_surface(model, target, radius):
    proof = model.certificate(radius)
    rng = np.random.default_rng(1)
    start = surface_points(target.distance, 100_000, rng, by_area=0.5)
    direction = rng.normal(size=start.shape)
    start = start + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    points = onto_level(target.distance, start, radius)
    on = np.abs(exact_box_distance(target, points) - radius) < 1e-9
    assert on.sum() > 100
    worst = values(model.field, points[on]).max() - radius
    assert worst <= proof.error_bound <= H - model.offset + 1e-6


def test_derivatives_match_autodiff_and_the_gradient_bound(model):
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.5, 1.5, (300, 3))
    value, gradient, hessian = values_gradients_hessians(model.field, points)

    @jax.jit
    def nested(points):
        of = model.field.value
        return of(points), jax.vmap(jax.grad(of))(points), jax.vmap(jax.hessian(of))(points)

    true_value, true_gradient, true_hessian = nested(jnp.asarray(points))
    np.testing.assert_allclose(gradient, true_gradient, atol=1e-10)
    np.testing.assert_allclose(hessian, true_hessian, atol=1e-9)
    np.testing.assert_allclose(value, true_value, atol=1e-12)
    dense = rng.uniform(-1.5, 1.5, (8000, 3))
    slope = np.linalg.norm(values_gradients_hessians(model.field, dense)[1], axis=1).max()
    assert slope <= model.certificate(0.0).gradient_bound <= np.sqrt(3.0) + 1e-6


@pytest.fixture(scope="module")
def nested(target, solid):
    """Three levels, each block beside others of its level and of the next."""
    field = build_grid(target, spacing=0.25 * H, band=0.1, solid=solid).field
    assert isinstance(field, GridField)
    assert len(field.tables) == 3
    return field


def faces_of_blocks(field, level, *, coarser):
    """Points on the blocks' faces, one a face, and the faces' normals: those that part levels, or blocks of one."""
    table = np.asarray(field.tables[level])
    blocks = np.argwhere(table >= 0)
    side = BLOCK * float(field.spacing) * 2**level
    rng = np.random.default_rng(3)
    points, normals = [], []
    for normal in (*np.eye(3, dtype=int), *-np.eye(3, dtype=int)):
        beyond = blocks + normal
        inside = ((beyond >= 0) & (beyond < table.shape)).all(axis=1)
        own, beyond = blocks[inside], beyond[inside]
        parts = (table[tuple(beyond.T)] < 0) == coarser
        place = rng.uniform(size=(int(parts.sum()), 3))
        place[:, normal != 0] = float(normal.sum() > 0)
        points.append(np.asarray(field.origin) + side * (own[parts] + place))
        normals.append(np.broadcast_to(normal, place.shape))
    return np.concatenate(points), np.concatenate(normals)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("coarser", [False, True], ids=["blocks", "levels"])
def test_second_derivatives_join_across_blocks_and_levels(nested, level, coarser):
    points, normals = faces_of_blocks(nested, level, coarser=coarser)
    assert len(points) > 100
    here, there = (values_gradients_hessians(nested, points + step * normals)[2] for step in (-1e-9, 1e-9))
    # Only the coefficients' rounding to float32 is left: half a unit in the last place of each, on both sides, and the
    # weights of a second derivative add up to at most 4/h².
    largest, h = float(np.abs(nested.coefficients).max()), float(nested.spacing) * 2**level
    rounding = 4.0 / h**2 * np.spacing(np.float32(largest))
    assert np.abs(here - there).max() <= rounding
    assert np.abs(here).max() > 100.0 * rounding


def test_file_round_trip_and_refusals(tmp_path, model, target):
    path = tmp_path / "g.keepout"
    model.save(path)
    loaded = FieldModel.load(path, target=target)
    points = np.random.default_rng(4).uniform(-3.0, 3.0, (100, 3))
    np.testing.assert_array_equal(values(loaded.field, points), values(model.field, points))
    with pytest.raises(FieldError, match="both must be positive"):
        build_grid(target, spacing=0.0)
    with pytest.raises(FieldError, match="chaser radius 9 m"):
        certify_grid(model, target, chaser_radius=9.0)

"""The field of a map against SciPy's spline, extended precision and brute-force distances."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.growing_maps import Cubes

from keepout.apps.unknown.map_field import SLOPE, MapField
from keepout.core.errors import FieldError
from keepout.core.fields.field import values, values_and_gradients, values_gradients_hessians

EMPTY = Cubes((0.1, -0.2, 0.3), 0.8)


def scattered(seed):
    """Solid cubes of several kinds: some alone, a sheet one cube thick, a block."""
    generator = np.random.default_rng(seed)
    solid = EMPTY.solid & (generator.uniform(size=EMPTY.solid.shape) < generator.choice([0.0, 0.001, 0.01]))
    at = generator.integers(18, 28, 3)
    solid[at[0], at[1] - 4 : at[1] + 4, at[2] - 4 : at[2] + 4] = True
    solid[at[2] : at[2] + 3, at[0] : at[0] + 3, at[1] : at[1] + 2] = True
    return solid & EMPTY.solid


def places(count, seed=0):
    box = EMPTY.origin, EMPTY.origin + EMPTY.spacing * EMPTY.count
    return np.random.default_rng(seed).uniform(box[0] - 0.4, box[1] + 0.4, (count, 3))


@pytest.mark.long
def test_derivatives_are_those_of_the_value():
    field, points = EMPTY.field(scattered(1)), places(64, 1)
    value, gradient, hessian = values_gradients_hessians(field, points)
    single = jax.jit(lambda points: jax.vmap(jax.value_and_grad(field.value))(points))
    # A batch of single points is the points together.
    np.testing.assert_allclose(value, single(points)[0], atol=1e-12)
    np.testing.assert_allclose(gradient, single(points)[1], atol=1e-11)
    np.testing.assert_allclose(hessian, jax.jit(jax.vmap(jax.hessian(field.value)))(points), atol=1e-9)
    also, slope = values_and_gradients(field, points)
    np.testing.assert_array_equal(also, value)
    np.testing.assert_array_equal(slope, gradient)


@pytest.mark.long
def test_beyond_the_box_it_is_the_cap():
    field = EMPTY.field(scattered(3))
    away = np.array([[9.0, 0.0, 0.0], [0.1, -80.0, 0.3], [3.0, 3.0, -3.0], EMPTY.origin, EMPTY.origin + 0.25])
    value, gradient, hessian = values_gradients_hessians(field, away)
    assert field.cap == pytest.approx(1.2, abs=1e-12)
    np.testing.assert_allclose(value, field.cap, atol=1e-14)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-13)
    np.testing.assert_allclose(hessian, 0.0, atol=1e-11)


def test_evaluation_keeps_its_bound_in_extended_precision():
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("no extended precision on this processor")
    squares, field = EMPTY.squares(scattered(4)), EMPTY.field(scattered(4))
    points = places(3000, 4)
    wide = np.longdouble
    cells = np.clip((points.astype(wide) - EMPTY.origin.astype(wide)) / wide(EMPTY.spacing), 1, EMPTY.count - 1)
    first = np.minimum(np.floor(cells).astype(int), EMPTY.count - 2)
    t, total = cells - first, np.zeros(len(points), wide)
    s = 1 - t
    weights = np.stack([s**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * s**2 + 3 * s**3, t**3]) / 6
    for i, j, k in np.ndindex(4, 4, 4):
        node = squares[tuple((first + np.array([i - 1, j - 1, k - 1])).T)].astype(wide)
        total += weights[i, :, 0] * weights[j, :, 1] * weights[k, :, 2] * np.sqrt(node) * wide(EMPTY.spacing)
    off = np.abs(values(field, points).astype(wide) - total).max()
    assert 0.0 < off < field.evaluation_error < 1e-12


def ascended(field, distance, points, steps=40):
    """Move points uphill along f − √(d² + h²), by random steps that shrink; return its largest value for each."""
    h, generator = EMPTY.spacing, np.random.default_rng(0)

    def excess(p):
        return values(field, p) - np.hypot(distance(p), h)

    best, size = excess(points), 0.1
    for _ in range(steps):
        tried = points + size * generator.normal(size=points.shape)
        found = excess(tried)
        better = found > best
        points, best, size = np.where(better[:, None], tried, points), np.where(better, found, best), 0.9 * size
    return points, best


@pytest.mark.parametrize("seed", range(2))
def test_no_value_passes_its_bound_where_ascent_seeks_it(seed):
    solid = scattered(seed)
    field = EMPTY.field(solid)
    start = EMPTY.centres[solid][np.random.default_rng(seed).integers(0, solid.sum(), 60)]
    points = start + np.random.default_rng(seed + 9).normal(scale=0.15, size=start.shape)
    points, excess = ascended(field, lambda p: EMPTY.distance(p, solid), points)
    assert excess.max() <= field.evaluation_error
    # Ascent comes close to the bound, and the field does pass the distance itself: h² is not there for nothing.
    assert excess.max() > -0.04
    assert (values(field, points) - EMPTY.distance(points, solid)).max() > 0.01


def test_the_error_bound_is_of_that_inequality_and_the_cap_only_lowers():
    field = EMPTY.field(scattered(0))
    for radius in (0.0, 0.5, 1.0, 3.0):
        assert field.error_bound(radius) == pytest.approx(np.sqrt(radius**2 + 0.01) - radius, abs=1e-12)
    uncapped = Cubes((0.1, -0.2, 0.3), 0.8, cap=2.4)
    points = places(2000, 5)
    solid = np.zeros_like(uncapped.solid)
    grown = (uncapped.count - EMPTY.count) // 2
    solid[(slice(grown, -grown),) * 3] = scattered(0)
    assert np.all(values(field, points) <= values(uncapped.field(solid), points) + 1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_no_slope_is_met_that_is_steeper_than_the_bound(seed):
    solid = scattered(seed)
    near = EMPTY.centres[solid][:1] if solid.any() else np.zeros((1, 3))
    points = near + np.random.default_rng(seed).uniform(-0.5, 0.5, (2000, 3))
    gradient = values_and_gradients(EMPTY.field(solid), points)[1]
    assert np.linalg.norm(gradient, axis=1).max() <= SLOPE


def test_the_field_keeps_its_numbers_while_the_map_grows_on():
    squares = EMPTY.squares()
    field = MapField.of(squares, EMPTY.origin, EMPTY.spacing)
    before = values(field, places(50))
    squares[:] = 7
    np.testing.assert_array_equal(values(field, places(50)), before)


def changed(axis, place, value):
    squares = EMPTY.squares()
    np.moveaxis(squares, axis, 0)[place, 20, 20] = value
    return squares


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"squares": EMPTY.squares().astype(np.int32)}, "uint16"),
        ({"squares": EMPTY.squares()[:4]}, "uint16"),
        *(({"spacing": spacing}, "spacing") for spacing in (0.0, -0.1, np.nan, np.inf)),
        *(({"origin": origin}, "origin") for origin in ([0.0, 1.0], [0.0, np.nan, 0.0])),
        *(
            ({"squares": changed(axis, place, 100)}, f"outermost 3 layers along axis {axis}")
            for axis in range(3)
            for place in (2, -3)
        ),
        ({"squares": changed(0, 20, 145)}, "cap, 144"),
    ],
)
def test_what_is_no_map_is_refused(given, said):
    whole = {"squares": EMPTY.squares(), "origin": EMPTY.origin, "spacing": 0.1} | given
    with pytest.raises(FieldError, match=said):
        MapField.of(*whole.values())

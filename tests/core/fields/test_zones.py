"""Zones against clouds of points of their bodies, and turning ones against what they are from moment to moment."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from keepout.core.audit import zones as exact
from keepout.core.fields import zones
from keepout.core.fields.field import Field, values

CENTRE, AXIS = np.array([1.0, -2.0, 0.5]), np.array([2.0, 1.0, -2.0]) / 3.0
SEMI_AXES, LOWER, UPPER = np.array([3.0, 1.0, 0.5]), np.array([-1.0, 0.0, 1.0]), np.array([2.0, 0.5, 4.0])
SHAPES = {
    "sphere": (zones.Sphere(CENTRE, 2.0), exact.sphere(CENTRE, 2.0)),
    "ellipsoid": (zones.Ellipsoid(CENTRE, SEMI_AXES), exact.ellipsoid(CENTRE, SEMI_AXES)),
    "box": (zones.Box(LOWER, UPPER), exact.box(LOWER, UPPER)),
    "cylinder": (zones.Cylinder(CENTRE, AXIS, 1.0, 4.0), exact.cylinder(CENTRE, AXIS, 1.0, 4.0)),
    "cone": (zones.Cone(CENTRE, AXIS, 0.4, 5.0), exact.cone(CENTRE, AXIS, 0.4, 5.0)),
    "beside a cone": (
        zones.BesideCone(CENTRE, AXIS, 4.0, apex=CENTRE - AXIS * 0.5 / np.tan(0.3), half_angle=0.3),
        exact.beside(CENTRE, AXIS, 4.0, half_angle=0.3, radius=0.5),
    ),
    "beside a tube": (zones.BesideTube(CENTRE, AXIS, 4.0, radius=0.7), exact.beside(CENTRE, AXIS, 4.0, radius=0.7)),
}
EXACT = ("sphere", "box", "cylinder", "cone")
_RNG = np.random.default_rng(5)
CLOUD = _RNG.uniform(-7.0, 7.0, (400_000, 3)) + CENTRE
places = arrays(np.float64, 3, elements=st.floats(-12.0, 12.0))


def _inside(name, points):
    """Say which points are in a shape's body, by its definition."""
    away = points - CENTRE
    along = away @ AXIS
    across = np.linalg.norm(away - along[:, None] * AXIS, axis=1)
    size = np.linalg.norm(away, axis=1)
    return {
        "sphere": size <= 2.0,
        "ellipsoid": ((away / SEMI_AXES) ** 2).sum(axis=1) <= 1.0,
        "box": np.all((points >= LOWER) & (points <= UPPER), axis=1),
        "cylinder": (across <= 1.0) & (along >= 0.0) & (along <= 4.0),
        "cone": (np.arctan2(across, along) <= 0.4) & (size <= 5.0),
        "beside a cone": (size <= 4.0) & (across >= 0.5 + along * np.tan(0.3)),
        "beside a tube": (size <= 4.0) & (across >= 0.7),
    }[name]


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_of_the_body(name):
    shape, judged = SHAPES[name]
    body = CLOUD[_inside(name, CLOUD)]
    points = _RNG.uniform(-9.0, 9.0, (200, 3)) + CENTRE
    inside = _inside(name, points)
    nearest = np.array([np.linalg.norm(body - point, axis=1).min() for point in points])
    flown, found = np.asarray(jax.vmap(shape.distance)(points)), judged(points)
    for distance in (flown, found):
        # A point of the body is never nearer than the distance says; the sign is that of the definition.
        assert np.all(distance <= np.where(inside, 0.0, nearest) + 1e-9)
        np.testing.assert_array_equal(distance > 0.0, ~inside)
    # The cloud has a point in every ball of 0.4 m, but for a cone's tip.
    tight = flown if name in EXACT else found
    if not name.startswith("beside"):
        assert np.all(tight[~inside] >= nearest[~inside] - 0.7)
    assert np.all(flown <= found + 1e-9)
    if name in EXACT:
        np.testing.assert_allclose(flown, found, atol=1e-9)


_BATCHES = {name: jax.jit(jax.vmap(shape.distance)) for name, (shape, _) in SHAPES.items()}


@pytest.mark.parametrize("name", SHAPES)
@given(places, places)
def test_no_distance_changes_faster_than_the_way(name, first, second):
    pair = np.stack([first, second])
    for distance in (_BATCHES[name](pair), SHAPES[name][1](pair)):
        assert abs(float(distance[0] - distance[1])) <= np.linalg.norm(first - second) + 1e-9


def _turned(angles):
    """Give axes <- body rotations of axes turned by angles (rad) about z."""
    c, s, zero, one = np.cos(angles), np.sin(angles), np.zeros_like(angles), np.ones_like(angles)
    return np.moveaxis(np.array([[c, s, zero], [-s, c, zero], [zero, zero, one]]), -1, 0)


BOX = zones.Box([2.0, -1.0, -1.0], [6.0, 1.0, 1.0])
CONE = zones.Cone(np.zeros(3), np.array([0.8, 0.0, 0.6]), 0.3, 6.0)
RATE, PERIOD, STEPS = 0.01, 1.0, 120


def _turning_box():
    """Give a box that turns by 0.01 rad/s about z until 120 s, as ten rotations that stand for 12 s each."""
    return zones.Zone(BOX, _turned(RATE * np.arange(6.0, 120.0, 12.0)), np.arange(12.0, 132.0, 12.0), 6.0 * RATE, 0.0)


def _turning_cone():
    return zones.SweptCone(CONE, [0.0, 0.0, 1.0], RATE * np.arange(STEPS + 1.0), PERIOD, 120.0, 0.0)


TRUE = {_turning_box: exact.box(np.array([2.0, -1.0, -1.0]), np.array([6.0, 1.0, 1.0]))}
TRUE[_turning_cone] = exact.cone(np.zeros(3), np.array([0.8, 0.0, 0.6]), 0.3, 6.0)
_value = eqx.filter_jit(lambda zone, place, time: zone.value(place, time))


@pytest.mark.parametrize("made", [_turning_box, _turning_cone])
@given(places, st.floats(0.0, 119.0), st.floats(0.0, 119.0))
def test_what_turns_counts_wherever_it_will_be(made, place, now, later):
    zone = made()

    def told(time):
        return float(_value(zone, place, jnp.asarray(time)))

    rotations = _turned(RATE * np.arange(np.floor(now), STEPS + 0.5, 0.5))
    assert told(now) <= TRUE[made](rotations @ place).min() + 1e-9
    if later >= now:
        assert told(later) >= told(now) - 1e-12
    assert np.isinf(told(120.0))
    assert np.isfinite(told(np.nan))


def test_a_swept_cone_is_the_cones_on_the_way():
    zone, points = _turning_cone(), _RNG.uniform(-8.0, 8.0, (300, 3))
    rotations = _turned(RATE * np.linspace(40.0, 120.0, 401))
    true = np.min([TRUE[_turning_cone](points @ r.T) for r in rotations], axis=0)
    told = jax.jit(jax.vmap(lambda p: zone.value(p, jnp.asarray(40.0))))(points)
    np.testing.assert_allclose(told, true, atol=1e-3)


_derivatives = eqx.filter_jit(lambda field, points: field.value_gradient_hessian(points))


class _Plane(Field):
    """The height over z = 0."""

    def value(self, points):
        return points[..., 2]

    def value_gradient_hessian(self, points):
        up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), points.shape)
        return points[..., 2], up, jnp.zeros((*points.shape, 3))


def test_a_field_with_zones_is_the_least_of_them():
    ball = zones.Zone(zones.Sphere([0.0, 0.0, 5.0], 1.0), np.eye(3)[None], [100.0], 0.0, 0.25)
    field = zones.ZonedField(_Plane(), (ball,))
    points = _RNG.uniform(-6.0, 6.0, (50, 3))
    least = np.minimum(points[:, 2], np.linalg.norm(points - [0.0, 0.0, 5.0], axis=1) - 0.75)
    np.testing.assert_allclose(values(field, points), least, atol=1e-12)
    np.testing.assert_allclose(values(field.at_time(jnp.asarray(100.0)), points), points[:, 2], atol=1e-12)
    value, gradient, hessian = _derivatives(field, jnp.asarray(points))
    step = 1e-6 * np.eye(3)
    slopes = [(values(field, points + d) - values(field, points - d)) / 2e-6 for d in step]
    np.testing.assert_allclose(gradient, np.stack(slopes, axis=1), atol=1e-6)
    np.testing.assert_allclose(value, least, atol=1e-12)
    nearer = least < points[:, 2]
    assert nearer.any()
    # That of a distance to a point: (1 - n n^T)/r.
    away = points[nearer] - [0.0, 0.0, 5.0]
    size = np.linalg.norm(away, axis=1)[:, None, None]
    unit = away / size[:, 0]
    np.testing.assert_allclose(hessian[nearer], (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / size, atol=1e-9)
    assert np.all(np.isneginf(values(field, np.array([[np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0]]))))


@pytest.mark.parametrize("name", ["beside a cone", "beside a tube"])
def test_clear_room_is_inside_the_walls_within_the_length_and_beyond_where_it_begins(name):
    """By its definition; the field then is the larger of the two there, but no more than a zone says."""
    room = zones.ClearRoom(SHAPES[name][0], 0.8, 0.3)
    points = _RNG.uniform(-5.0, 5.0, (4000, 3)) + CENTRE
    away = points - CENTRE
    along = away @ AXIS
    across = np.linalg.norm(away - along[:, None] * AXIS, axis=1)
    wide = 0.5 + along * np.tan(0.3) if name == "beside a cone" else 0.7
    inside = (np.linalg.norm(away, axis=1) < 4.0) & (along > 0.8) & (across < wide)
    said = np.asarray(jax.vmap(room.value)(points))
    np.testing.assert_array_equal(said > 0.3, inside)
    ball = zones.Zone(zones.Sphere(CENTRE + 2.0 * AXIS, 0.2), np.eye(3)[None], [100.0], 0.0, 0.0)
    field = zones.ZonedField(_Plane(), (ball,), (room,))
    far = np.linalg.norm(points - CENTRE - 2.0 * AXIS, axis=1) - 0.2
    np.testing.assert_allclose(values(field, points), np.minimum(np.maximum(points[:, 2], said), far), atol=1e-12)
    gradient = np.asarray(_derivatives(field, jnp.asarray(points))[1])
    step = 1e-6 * np.eye(3)
    slopes = np.stack([(values(field, points + d) - values(field, points - d)) / 2e-6 for d in step], axis=1)
    smooth = np.abs(np.linalg.norm(slopes, axis=1) - 1.0) < 1e-4  # no edge between the two points
    assert smooth.mean() > 0.99
    np.testing.assert_allclose(gradient[smooth], slopes[smooth], atol=1e-4)

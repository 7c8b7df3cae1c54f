"""Images of a depth sensor against closed forms, and what lost returns make of pixels."""

import math

import numpy as np
import pytest

from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, ErrorDraw, first_returns, take
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import ScenarioError
from keepout.core.geometry.target import Target

UP = np.array([0.0, 0.0, 1.0])
EXACT = SensorBounds(range_error=0.0, position_error=0.0, attitude_error=0.0)
SMALL = Pinhole(32, 24, math.radians(60.0))


def quad(corners):
    """A sheet from four corners in turn."""
    return np.array(corners, dtype=np.float64), np.array([[0, 1, 2], [0, 2, 3]])


def joined(*sheets):
    vertices, faces = [], []
    for some, theirs in sheets:
        faces.append(theirs + sum(map(len, vertices)))
        vertices.append(some)
    return FirstHit(np.concatenate(vertices), np.concatenate(faces))


def wall(distance, left=-100.0, right=100.0):
    """A sheet across the boresight x at a distance, from y = left to y = right."""
    return quad([[distance, left, -100], [distance, right, -100], [distance, right, 100], [distance, left, 100]])


def camera(**changes):
    return DepthCamera(**({"camera": SMALL, "bounds": EXACT} | changes))


def looking(first_hit, sensor, draw=None, *, place=(0.0, 0.0, 0.0), at=(1.0, 0.0, 0.0), seed=0):
    axes = axes_towards(np.array(at), UP)
    generator = np.random.default_rng(seed)
    return take(sensor, first_hit, np.array(place), axes, generator, draw or ErrorDraw())


def rays_of(sensor, at=(1.0, 0.0, 0.0)):
    """Directions (height, across, width, across, 3) in the map's frame, from the definition of the pinhole."""
    lens, across = sensor.camera, sensor.bounds.rays_across
    column = (np.arange(lens.width * across) + 0.5) / across - 0.5 * lens.width
    row = (np.arange(lens.height * across) + 0.5) / across - 0.5 * lens.height
    x, y = np.meshgrid(column / lens.focal, row / lens.focal)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ axes_towards(np.array(at), UP).T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays.reshape(lens.height, across, lens.width, across, 3)


@pytest.mark.parametrize("at", [(1.0, 0.0, 0.0), (0.3, -0.5, 0.8), (0.0, 0.0, -1.0)])
def test_a_box(at):
    target = Target.load("box")
    first_hit = FirstHit(target.vertices, target.faces)
    half = first_hit.upper
    np.testing.assert_allclose(first_hit.lower, -half)
    sensor, at = camera(), np.array(at) / np.linalg.norm(at)
    place = -at * (np.linalg.norm(half) + 1.5)
    view = looking(first_hit, sensor, place=place, at=at)
    rays = rays_of(sensor, at)
    with np.errstate(divide="ignore"):
        one, other = (-half - place) / rays, (half - place) / rays
    enter, leave = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
    truth = np.where(enter <= leave, enter, np.inf).min(axis=(1, 3))
    assert 0 < np.isfinite(truth).sum() < truth.size or np.isfinite(truth).all()
    np.testing.assert_allclose(view.ranges, truth, atol=1e-11)


def test_a_pixel_says_its_nearest_ray():
    """The edge of a near wall runs through pixels: with one ray a pixel half of them see past it."""
    across = 3
    near, far = 4.0, 10.0
    scene = joined(wall(near, left=0.048), wall(far))
    bounds = SensorBounds(0.0, 0.0, 0.0, 0.5, across, 15.0, 0.3, 15.0)
    sensor = camera(bounds=bounds)
    rays = rays_of(sensor)
    y = near / rays[..., 0] * rays[..., 1]
    each = np.where(y >= 0.048, near, far) / rays[..., 0]
    view = looking(scene, sensor)
    np.testing.assert_allclose(view.ranges, each.min(axis=(1, 3)), atol=1e-12)
    assert (each.max(axis=(1, 3)) > each.min(axis=(1, 3)) + 1.0).any()


def test_range_limits():
    sensor = camera(bounds=SensorBounds(0.0, 0.0, 0.0, 0.5, 3, 6.0, 4.9, 6.0))
    assert np.isinf(looking(joined(wall(6.01)), sensor).ranges).all()
    for distance in (5.2, 4.8):
        ranges = looking(joined(wall(distance)), sensor).ranges
        nearest = (distance / rays_of(sensor)[..., 0]).min(axis=(1, 3))
        np.testing.assert_array_equal(np.isinf(ranges), nearest > 6.0)
        np.testing.assert_array_equal(np.isnan(ranges), nearest < 4.9)
        assert 0 < np.isfinite(ranges).sum() < ranges.size


def test_a_wall_beyond_its_grazing_angle_says_nothing():
    """Looked at from the normal's direction, incidence is the angle from the boresight."""
    sensor = camera(grazing_angle=math.radians(20.0))
    view = looking(joined(wall(5.0)), sensor)
    rays = rays_of(sensor)
    nearest = rays[..., 0].max(axis=(1, 3))  # the nearest ray of a pixel is the steepest
    np.testing.assert_array_equal(np.isnan(view.ranges), nearest < math.cos(math.radians(20.0)))
    assert 0 < np.isnan(view.ranges).sum() < view.ranges.size
    assert not np.isinf(view.ranges).any()


def slanted(start, end):
    """A sheet along the line from `start` to `end` in the plane of x and y, tall in z."""
    (a, b), (c, d) = start, end
    return quad([[a, b, -100], [c, d, -100], [c, d, 100], [a, b, 100]])


def test_a_lost_ray_that_hides_the_nearest_surface_silences_its_pixel():
    """In one pixel some rays are lost nearer than the others return: it says nothing, and not the farther range."""
    slant, back = slanted((2.0, 0.32), (5.0, 0.3)), wall(8.0)
    sensor = camera(grazing_angle=math.radians(75.0))
    alone = looking(joined(back), sensor).ranges
    view = looking(joined(slant, back), sensor)
    returns = first_returns(sensor, joined(slant, back), np.zeros(3), view.axes)
    # Pixels of which some rays return from the wall, and whose nearest ray is lost on the slanted sheet.
    hidden = (returns.nearest < alone - 1.0) & (returns.farthest > 7.0)
    assert hidden.sum() > 5
    assert np.isnan(view.ranges[hidden]).all()


def test_broken_assumptions_break_what_they_name():
    scene = joined(wall(4.0, left=0.048), wall(10.0))
    sensor = DepthCamera(camera=SMALL, dropout=0.1)
    bounds = sensor.bounds
    exact = looking(scene, camera()).ranges
    for size in ("random", "adversarial"):
        errors = np.abs(looking(scene, sensor, ErrorDraw(size, "range")).ranges - exact)
        assert bounds.range_error < np.nanmax(errors) <= 2.0 * bounds.range_error + 1e-12
        mixed = looking(scene, sensor, ErrorDraw(size, "mixed")).ranges
        assert 2.0 < np.nanmax(mixed - exact) < 4.0
        assert np.isinf(looking(scene, sensor, ErrorDraw(size, "losses")).ranges).any()
        assert not np.isnan(looking(scene, sensor, ErrorDraw(size, "losses")).ranges).any()
    far = [np.linalg.norm(looking(scene, sensor, ErrorDraw("random", "pose"), seed=s).position) for s in range(50)]
    assert bounds.position_error < max(far) <= 2.0 * bounds.position_error
    axes = axes_towards(np.array([1.0, 0.0, 0.0]), UP)
    later = np.array([0.0, 0.4, 0.0]), axes_towards(np.array([1.0, 0.1, 0.0]), UP)
    drawn = np.random.default_rng(0), ErrorDraw("random", "late")
    late = take(sensor, scene, np.zeros(3), axes, *drawn, time=3.0, told=later)
    assert np.linalg.norm(late.position - later[0]) <= bounds.position_error


def test_what_cannot_be_taken_is_refused():
    for words, changes in {
        "position": {"position": np.full(3, np.nan)},
        "rotation matrix": {"axes": -np.eye(3)},
        "no pose of another time": {"draw": ErrorDraw(broken="late")},
        "a pose of another time": {"told": (np.zeros(3), np.eye(3))},
        "dropout is 0": {"draw": ErrorDraw(broken="losses")},
    }.items():
        given = {"position": np.zeros(3), "axes": np.eye(3), "generator": np.random.default_rng(0)} | changes
        with pytest.raises(ScenarioError, match=words):
            take(camera(), joined(wall(5.0)), **given)

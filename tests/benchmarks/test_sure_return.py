"""The assumption that near parts surely return: counted where thin parts break it, and nowhere else."""

import math

import numpy as np
import pytest
from sure_return import _on_surface, sure_return_violations
from truths.messy_meshes import box

from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, first_returns
from keepout.apps.unknown.view import SensorBounds

UP = np.array([0.0, 0.0, 1.0])


def violations(sensor, first_hit, *, place=(0.0, 0.0, 0.0), at=(1.0, 0.013, 0.007), samples=20_000):
    axes = axes_towards(np.array(at), UP)
    generator = np.random.default_rng(0)
    return sure_return_violations(sensor, first_hit, np.array(place), axes, generator, samples=samples)


def by_brute_force(sensor, first_hit, axes, points):
    """The assumption's words, point by point, over all rays of the image."""
    across, w = sensor.bounds.rays_across, sensor.bounds.surely_returned_width
    returns = first_returns(sensor, first_hit, np.zeros(3), axes)
    says = np.where(returns.lost | (returns.nearest < sensor.bounds.least_range), np.nan, returns.nearest)
    says = says.repeat(across, axis=0).repeat(across, axis=1).ravel()
    rays = sensor.camera.directions(across).reshape(-1, 3) @ axes.T
    held = []
    for x in points:
        D = np.linalg.norm(x)
        ahead = rays @ x > 0.0
        lateral = np.linalg.norm(np.cross(rays, x), axis=1)
        held.append(bool((ahead & (lateral <= w) & (np.isnan(says) | (says <= D + w))).any()))
    return np.array(held)


@pytest.mark.long
@pytest.mark.parametrize("grazing", [math.pi / 2, math.radians(60.0)])
def test_agrees_with_the_words_of_the_assumption(grazing):
    """Slats of many widths, seen by a coarse image: some are missed, some not."""
    sensor = DepthCamera(
        Pinhole(40, 30, math.radians(70.0)),
        SensorBounds(surely_returned_width=0.2, rays_across=2, sure_empty_range=10.0, greatest_range=10.0),
        grazing_angle=grazing,
    )
    triangles = []
    rng = np.random.default_rng(1)
    for _ in range(40):
        low = rng.uniform([3.0, -2.0, -2.0], [5.5, 2.0, 2.0])
        triangles.append(box(low, low + rng.permutation([rng.uniform(0.005, 0.08), rng.uniform(0.005, 0.08), 0.8])))
    corners = np.concatenate(triangles)
    first_hit = FirstHit(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    found = violations(sensor, first_hit, samples=3000)
    axes = axes_towards(np.array([1.0, 0.013, 0.007]), UP)
    broken = np.concatenate([found.violations, found.hidden_violations])
    assert 20 < len(broken) < found.tested
    assert not by_brute_force(sensor, first_hit, axes, broken).any()
    # The number as well: the same points drawn anew.
    points = _on_surface(first_hit, np.random.default_rng(0), 3000)
    local = points @ axes
    half = 0.5 / sensor.camera.focal
    inside = (np.abs(local[:, 0]) <= half * 40 * local[:, 2]) & (np.abs(local[:, 1]) <= half * 30 * local[:, 2])
    near = np.linalg.norm(points, axis=1) <= sensor.bounds.usable_range(sensor.camera)
    points = points[inside & near & (local[:, 2] > 0.0)]
    assert len(points) == found.tested
    assert (~by_brute_force(sensor, first_hit, axes, points)).sum() == len(broken)

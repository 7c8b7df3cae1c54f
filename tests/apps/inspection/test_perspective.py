"""Pictures in perspective against rays through every pixel, and their light against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.apps.inspection.inspection_pictures import Studio
from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.led.first_hit import FirstHit

UP = np.array([0.0, 0.0, 1.0])
EDGES = 2
"""Pixels of a picture whose middle may be on an edge to within rounding."""


def soup(triangles):
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


def agree_with_rays(triangles, camera, position, axes):
    """Every pixel shows what a ray through its middle meets first, at that depth; edges may fall to either side."""
    picture = Studio(triangles).take(camera, position, axes)
    rays = camera.directions().reshape(-1, 3)
    ranges, faces = FirstHit(*soup(triangles)).cast(position[None], rays @ axes.T)
    depth = (ranges * rays[:, 2]).reshape(camera.shape)
    faces = faces.reshape(camera.shape)
    far = depth > 0.011  # what is nearer than the picture's near plane hides nothing in it
    clear = far | np.isinf(depth)
    assert ((picture.hit != (faces >= 0)) & clear).sum() <= EDGES
    both = picture.hit & (faces >= 0) & far
    assert (np.abs(picture.depth[both] - depth[both]) > 1e-6 * depth[both]).sum() <= EDGES
    return picture, faces


@pytest.mark.long
@given(st.integers(0, 2**32 - 1))
def test_pictures_of_any_triangles_are_what_rays_meet(seed):
    """Triangles anywhere round the camera: behind it, across its near plane, through each other."""
    rng = np.random.default_rng(seed)
    middles = rng.normal(0.0, 3.0, (40, 1, 3))
    triangles = middles + rng.normal(0.0, rng.uniform(0.05, 3.0), (40, 3, 3))
    camera = Pinhole(int(rng.integers(20, 60)), int(rng.integers(20, 60)), float(rng.uniform(0.3, 2.5)))
    position = rng.normal(0.0, 2.0, 3)
    agree_with_rays(triangles, camera, position, axes_towards(rng.normal(size=3), UP))


def square(centre, half, height):
    x, y = centre
    corners = np.array([[x + a * half, y + b * half, height] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    return corners[[[0, 1, 2], [0, 2, 3]]]


@pytest.mark.long
@pytest.mark.parametrize("height", [0.01, 2.0])
def test_a_plate_shades_what_lies_along_the_sun_behind_it(height):
    """A small square over a floor, the sun aslant: its shadow is the same square, shifted."""
    sun = np.array([0.6, 0.0, 0.8])
    studio = Studio(np.concatenate([square((0.0, 0.0), 4.0, 0.0), square((0.0, 0.0), 0.5, height)]))
    camera, position = Pinhole(200, 200, 1.2), np.array([0.0, 0.3, 6.0])
    axes = axes_towards(-position, np.array([0.0, 1.0, 0.0]))
    picture = studio.take(camera, position, axes)
    bright = studio.light(picture, sun)
    there, _ = picture.places()
    floor = picture.face[picture.hit] < 2
    shift = -height * sun[0] / sun[2]
    across, along = np.abs(there[:, 0] - shift), np.abs(there[:, 1])
    lit = bright[picture.hit]
    inside = floor & (np.maximum(across, along) < 0.49)
    outside = floor & (np.maximum(across, along) > 0.51)
    assert inside.any() or height < 0.1  # a plate right over the floor hides its own shadow from above
    assert (lit[inside] < 0.2).all()
    np.testing.assert_allclose(lit[outside], 0.13 + 0.87 * math.sqrt(0.8))
    np.testing.assert_allclose(lit[~floor], 0.13 + 0.87 * math.sqrt(0.8))

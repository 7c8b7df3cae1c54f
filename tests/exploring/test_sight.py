"""What views are expected to open, against volumes in closed form; cells and frontier against brute force."""

import math

import numpy as np
import pytest
from scipy import ndimage

from keepout.exploring.cells import CLOSE, EXPLAINED, FREE, NEARBY, SURFACE, UNKNOWN, Cells
from keepout.exploring.frontier import frontier
from keepout.exploring.sight import UP, inside, panoramas, sphere
from keepout.exploring.tried import PATIENCE, Tried
from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, View
from keepout.sensing.depth import axes_towards

CAMERA = Pinhole(80, 60, math.radians(60.0))
FULL = np.ones(256, dtype=np.float32)
LENGTHS = {"bins": np.array([1.0, 20.0, 30.0]), "farthest": 55.0, "empty": 55.0}


def world():
    """Make cells of which an unknown ball of radius 12 fills the middle, 30 from the corner."""
    offset = np.indices((60, 60, 60)) + 0.5 - 30.0
    return ((offset**2).sum(axis=0) <= 144.0).astype(np.uint8) * 3


def test_all_rays_together_open_the_volume_of_an_unknown_ball():
    volume = 4.0 / 3.0 * math.pi * 12.0**3
    place = np.array([[30.0, 30.0, 4.0]])
    gains = panoramas(world(), FULL, FULL, place, sphere(20_000), **LENGTHS)
    assert gains.sum() == pytest.approx(volume, rel=0.03)


def test_nothing_is_opened_behind_a_surface_and_less_behind_doubtful_cells():
    codes = world()
    codes[:, :, 16] = np.where(codes[:, :, 16] == 0, 0, 2)
    codes[:, :, :17][codes[:, :, :17] == 3] = 0
    codes[:, :, 16][codes[:, :, 16] == 0] = 1  # a wall through all the room
    passes = FULL.copy()
    passes[1] = passes[2] = 0.0
    place = np.array([[30.0, 30.0, 4.0]])
    worth = FULL.copy()
    worth[1] = worth[2] = 0.0
    assert panoramas(codes, worth, passes, place, sphere(4000), **LENGTHS).sum() == 0.0
    passes[1] = passes[2] = 0.5
    doubtful = panoramas(codes, worth, passes, place, sphere(4000), **LENGTHS).sum()
    passes[1] = passes[2] = 1.0
    open_wall = panoramas(codes, worth, passes, place, sphere(4000), **LENGTHS).sum()
    assert doubtful == pytest.approx(0.5 * open_wall, rel=0.05)  # slanting rays may cross two cells of the wall
    assert doubtful > 0.0


def test_where_no_return_says_nothing_only_rays_that_return_open_anything():
    codes, passes = world(), FULL.copy()
    passes[9] = 0.0
    place = np.array([[30.0, 30.0, 4.0]])
    nothing = LENGTHS | {"empty": 0.0}
    assert panoramas(codes, FULL, passes, place, sphere(4000), **nothing).sum() == 0.0
    codes[:, :, 50] = 9
    behind = panoramas(codes, FULL, passes, place, sphere(4000), **nothing)
    assert behind.sum() == pytest.approx(panoramas(codes, FULL, passes, place, sphere(4000), **LENGTHS).sum(), rel=1e-6)


def test_rays_of_an_image_fill_its_solid_angle():
    directions = sphere(7)
    rays = sphere(40_000)
    images = inside(CAMERA, np.stack([axes_towards(one, UP) for one in directions]), rays, 0.0)
    a, b = math.tan(math.radians(30.0)), 0.75 * math.tan(math.radians(30.0))
    solid = 4.0 * math.asin(a * b / math.sqrt((1.0 + a * a) * (1.0 + b * b)))
    assert images.mean(axis=1) * 4.0 * math.pi == pytest.approx(solid, rel=0.03)
    assert (inside(CAMERA, np.stack([axes_towards(one, UP) for one in directions]), rays, 0.1) <= images).all()


def begun(radius=1.5, **bounds):
    return KnownFreeMap.begin(np.zeros(3), radius, bounds=SensorBounds(**bounds), name="test")


def test_cells_and_frontier_are_what_brute_force_says():
    known = begun()
    generator = np.random.default_rng(0)
    known.fill(known.free | (generator.random(known.free.shape) < 0.5))
    position = np.array([0.0, 0.0, 2.6])
    ranges = np.full(CAMERA.shape, np.nan)
    ranges[30, 40] = 2.0  # one return, at z = 0.6
    known.see(View(CAMERA, position, axes_towards(-UP, np.array([1.0, 0.0, 0.0])), ranges, 0.0))
    cells = Cells.of(known)
    n = len(cells.kinds)
    closed = ~known.free.reshape(n, 2, n, 2, n, 2).all(axis=(1, 3, 5))
    assert np.array_equal(cells.kinds != FREE, closed)
    holding = np.floor((known.returns[0] - known.origin) / 0.2).astype(int)
    assert (cells.kinds == SURFACE).sum() == closed[tuple(holding)]
    if closed[tuple(holding)]:
        apart = np.linalg.norm(np.argwhere(np.ones_like(closed)) - holding, axis=1).reshape(closed.shape) * 0.2
        explained = closed & (apart <= 0.35) & (apart > 0.0)
        assert np.array_equal(cells.kinds == EXPLAINED, explained)
        assert (apart[cells.kinds == CLOSE] < 1.6 + 1.1).all()
        assert (apart[(cells.kinds == UNKNOWN) | (cells.kinds == NEARBY)] > 1.6 - 1.1).all()
    edge = frontier(cells)
    beside = ndimage.binary_dilation(cells.kinds == FREE) & (cells.kinds > EXPLAINED)
    beside[[0, -1]] = beside[:, [0, -1]] = beside[:, :, [0, -1]] = False
    assert np.array_equal(edge.cells, np.argwhere(beside))
    assert edge.sizes.sum() == len(edge.cells)
    assert np.array_equal(np.bincount(edge.cluster), edge.sizes)


def test_the_frontier_of_a_new_map_looks_outwards():
    edge = frontier(Cells.of(begun(3.0)))
    outward = edge.centres / np.linalg.norm(edge.centres, axis=1, keepdims=True)
    large = edge.sizes >= 8
    assert large.sum() > 20
    assert ((edge.normals * outward).sum(axis=1)[large] > 0.8).all()


def test_a_cell_that_stays_closed_is_given_up_after_views_from_different_directions_only():
    known, camera = begun(), CAMERA
    tried = Tried.nothing(known)
    blind = np.full(camera.shape, np.nan)

    def look(position):
        position = np.asarray(position, dtype=float)
        tried.note(known, View(camera, position, axes_towards(-position, UP), blind, 0.0))

    look([2.6, 0.0, 0.0])
    once = tried.failures.copy()
    assert once.max() == 1
    facing = np.argwhere(once == 1)
    assert (known.origin[0] + 0.2 * (facing[:, 0] + 0.5) > 0.5).all()  # the side that it looked at
    look([2.6, 0.0, 0.05])
    assert np.array_equal(tried.failures, once)
    look([2.55, 0.45, 0.0])
    look([2.55, 0.0, 0.45])
    assert tried.failures.max() == PATIENCE == tried.patience
    assert len(tried.positions) == 4


def test_the_memory_of_views_can_be_made_again_from_the_map():
    known = begun()
    tried = Tried.nothing(known)
    for position in ([2.6, 0.0, 0.0], [0.0, 2.6, 0.0], [0.0, 0.3, 2.6]):
        position = np.array(position)
        ranges = np.full(CAMERA.shape, np.inf)
        ranges[:, :30] = np.nan
        view = View(CAMERA, position, axes_towards(-position, UP), ranges, 0.0)
        assert known.see(view).opened > 0
        tried.note(known, view)
    again = Tried.of_map(known, CAMERA)
    closed = Cells.of(known).kinds != FREE
    assert (again.failures[closed] >= tried.failures[closed]).all()
    assert np.array_equal(np.array(again.positions), np.array(tried.positions))

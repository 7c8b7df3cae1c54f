"""Depth images of balls and boxes in closed form, and what a view frees by the rule, without Keepout's loops."""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.rule import SLACK
from keepout.apps.unknown.view import SensorBounds, View


@dataclass(frozen=True)
class Ball:
    centre: tuple[float, float, float]
    radius: float

    def ranges(self, origin, directions):
        """Distance along unit vectors (..., 3) to the surface; inf where a ray misses it."""
        offset = origin - np.array(self.centre)
        along = directions @ offset
        inside = along**2 - (offset @ offset - self.radius**2)
        near = -along - np.sqrt(np.maximum(inside, 0.0))
        return np.where((inside >= 0.0) & (near > 0.0), near, np.inf)

    def meets_cubes(self, centres, spacing):
        gap = np.maximum(np.abs(centres - np.array(self.centre)) - 0.5 * spacing, 0.0)
        return (gap**2).sum(axis=-1) <= self.radius**2


@dataclass(frozen=True)
class Box:
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def ranges(self, origin, directions):
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (np.array(self.lower) - origin) / directions
            two = (np.array(self.upper) - origin) / directions
        near, far = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
        return np.where((near <= far) & (near > 0.0), near, np.inf)

    def meets_cubes(self, centres, spacing):
        low, high = centres - 0.5 * spacing, centres + 0.5 * spacing
        return ((high >= np.array(self.lower)) & (low <= np.array(self.upper))).all(axis=-1)


def axes_towards(direction, roll=0.0):
    """Camera axes as columns, the boresight along a direction."""
    ahead = np.asarray(direction, dtype=np.float64)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    return np.stack([np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, ahead], 1)


def turned(axes, angle, about):
    """Axes turned by an angle (rad) about a vector of the map's frame."""
    about = np.asarray(about) / np.linalg.norm(about)
    across = np.cross(np.eye(3), about) * -1.0
    return (np.eye(3) + np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across) @ axes


def true_ranges(bodies, camera: Pinhole, bounds: SensorBounds, position, axes):
    """First return of each pixel's rays, without error; inf beyond the greatest range."""
    rays = camera.directions(bounds.rays_across) @ axes.T
    ranges = np.min([body.ranges(position, rays) for body in bodies], axis=0)
    across = bounds.rays_across
    pixels = ranges.reshape(camera.height, across, camera.width, across).min(axis=(1, 3))
    return np.where(pixels > bounds.greatest_range, np.inf, pixels)


def view_of(
    bodies, camera, bounds, position, axes, *, range_error=0.0, move=(0.0, 0.0, 0.0), turn=0.0, about=(0, 0, 1)
):
    """A view whose ranges are long by an error, its estimated pose moved (m) and turned (rad) from the true one."""
    ranges = true_ranges(bodies, camera, bounds, position, axes) + range_error
    return View(camera, position + np.asarray(move), turned(axes, turn, about), ranges)


def cube_centres(known):
    """Centres (n, n, n, 3) of a map's cubes."""
    steps = np.arange(len(known.free)) + 0.5
    return known.origin + known.spacing * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)


def _in_camera(known, view, centres):
    local = (centres - view.position) @ view.axes
    distance = np.linalg.norm(centres - view.position, axis=-1)
    bounds = known.bounds
    reach = 0.5 * np.sqrt(3.0) * known.spacing + bounds.position_error
    clear = reach + bounds.surely_returned_width + SLACK
    fits = distance + reach + SLACK <= bounds.usable_range(view.camera)
    fits &= distance - reach - SLACK >= bounds.least_range
    radius = clear + distance * bounds.attitude_error
    return local, distance, radius, clear, fits & (local[..., 2] > radius)


def _empty(view, bounds):
    sure = min(bounds.sure_empty_range, bounds.greatest_range) or -np.inf
    return np.where(
        np.isnan(view.ranges), -np.inf, np.where(np.isinf(view.ranges), sure, view.ranges - bounds.range_error)
    )


def _rectangle(local, radius, camera):
    """Sides of the ball's projection in pixels, by angles: left, right, top, bottom; the slack is Keepout's."""
    sides = []
    for axis, middle in ((0, 0.5 * camera.width), (1, 0.5 * camera.height)):
        bearing = np.arctan2(local[..., axis], local[..., 2])
        half = np.arcsin(radius / np.hypot(local[..., axis], local[..., 2]))
        for sign in (-1.0, 1.0):
            sides.append(camera.focal * np.tan(bearing + sign * half) + middle + sign * SLACK)
    return sides


def freed_by_rectangles(known, view):
    """Which cubes not yet free the rule frees, each window the exact bounding rectangle of the ball."""
    camera, empty = view.camera, _empty(view, known.bounds)
    local, distance, radius, clear, fits = _in_camera(known, view, cube_centres(known))
    fits &= ~known.free
    left, right, top, bottom = _rectangle(local[fits], radius[fits], camera)
    inside = (left >= 0.0) & (top >= 0.0) & (right <= camera.width) & (bottom <= camera.height)
    cubes, limit = np.argwhere(fits)[inside], distance[fits][inside] + clear
    left, right, top, bottom = (np.floor(side[inside]).astype(int) for side in (left, right, top, bottom))
    sizes = np.stack([bottom - top, right - left], axis=1) + 1
    freed = np.zeros_like(known.free)
    for rows, columns in np.unique(sizes, axis=0):
        least = sliding_window_view(empty, rows, axis=0).min(axis=2)
        least = sliding_window_view(least, columns, axis=1).min(axis=2)
        alike = (sizes == (rows, columns)).all(axis=1)
        freed[tuple(cubes[alike].T)] = least[top[alike], left[alike]] > limit[alike]
    return freed


def freed_by_projections(known, view, cubes):
    """Which of some cubes may be freed where the window is every pixel whose square meets the ball's projection.

    The projection is {u : |u|² |c|² cos² a <= (c . u)²} on the plane u = (x, y, 1), an ellipse; a convex quadratic is
    least over a square at its own lowest point or on a side.
    """
    camera, empty = view.camera, _empty(view, known.bounds)
    local, distance, radius, clear, fits = _in_camera(known, view, cube_centres(known))
    left = (np.arange(camera.width) - 0.5 * camera.width) / camera.focal
    top = (np.arange(camera.height) - 0.5 * camera.height) / camera.focal
    step = 1.0 / camera.focal
    x0, y0 = np.meshgrid(left, top)

    def may_be(cube):
        c = local[cube]
        sides = _rectangle(c, radius[cube], camera)
        if sides[0] < 0.0 or sides[2] < 0.0 or sides[1] > camera.width or sides[3] > camera.height:
            return False
        form = (c @ c - radius[cube] ** 2) * np.eye(3) - np.outer(c, c)

        def value(x, y):
            u = np.stack([x, y, np.ones_like(x)])
            return np.einsum("i...,ij,j...->...", u, form, u)

        def along(x, y, axis):
            """Least value on a side that begins at (x, y) and runs along an axis."""
            u = np.stack([x, y, np.ones_like(x)])
            slope = 2.0 * np.einsum("j,j...->...", form[axis], u)
            t = np.clip(-slope / (2.0 * form[axis, axis]), 0.0, step)
            return value(x + t, y) if axis == 0 else value(x, y + t)

        least = np.minimum.reduce(
            [along(x0, y0, 0), along(x0, y0 + step, 0), along(x0, y0, 1), along(x0 + step, y0, 1)]
        )
        middle = np.linalg.solve(form[:2, :2], -form[:2, 2])
        holds = (x0 <= middle[0]) & (middle[0] <= x0 + step) & (y0 <= middle[1]) & (middle[1] <= y0 + step)
        meets = holds | (least <= 0.0)
        return bool((empty[meets] > distance[cube] + clear).all())

    return np.array([bool(fits[cube]) and may_be(cube) for cube in map(tuple, cubes)], dtype=bool)

"""Whether a flight entered a zone at any instant, by distances of its own and the tube between the samples.

The shapes are written here once more, in NumPy: what law and guard fly by is not asked. Each distance is exact in its
sign, and 1-Lipschitz; that of room beside a corridor is the larger of two, which says no more than the distance does.
A zone that turns is bounded piece by piece: while it is turned by at most φ against where it is in the middle of a
piece, a point p of the path is nearer to it by at most φ ‖p‖. Pieces are halved until that decides, or are one step.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.spatial
from jaxtyping import Float

from keepout.core.audit.tube import Contact, Tube, lengths, nearest
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.hulls import Hulls

Signed = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]
_LONGEST = 512
"""Steps in a piece of path beside a zone that turns, at first."""
_CLEAR, _NEAR = 0.25, 0.9
"""A piece whose bound is above so many metres, and above this share of the least distance found, is not halved."""
_ROUNDING = 1e-9
"""Metres taken off every bound."""


def sphere(centre: Float[np.ndarray, "3"], radius: float) -> Signed:
    """Give the distance, m, to a ball."""
    return lambda points: lengths(points - centre) - radius


def ellipsoid(centre: Float[np.ndarray, "3"], semi_axes: Float[np.ndarray, "3"]) -> Signed:
    """Give the distance, m, to an ellipsoid along the axes.

    Outside, the nearest point is a² p/(a² + t) with the t ≥ 0 for which it lies on the surface; t is bisected from the
    side on which the distance is less. Inside it says 0 or less by the shorter axes, which is enough.
    """
    a = np.asarray(semi_axes, dtype=float)

    def distance(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        p = np.abs(points - centre)
        low, high = np.zeros(len(p)), lengths(p) * a.max()
        for _ in range(80):
            t = 0.5 * (low + high)
            outside = ((a * p / (a**2 + t[:, None])) ** 2).sum(axis=1) > 1.0
            low, high = np.where(outside, t, low), np.where(outside, high, t)
        inside = ((p / a) ** 2).sum(axis=1) <= 1.0
        near = a**2 * p / (a**2 + low[:, None])
        deep = (np.sqrt(((p / a) ** 2).sum(axis=1)) - 1.0) * a.min()
        return np.where(inside, deep, lengths(p - near))

    return distance


def box(lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> Signed:
    """Give the distance, m, to a box along the axes."""

    def distance(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        beyond = np.maximum(lower - points, points - upper)
        return lengths(np.maximum(beyond, 0.0)) + np.minimum(beyond.max(axis=1), 0.0)

    return distance


def cylinder(centre: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], radius: float, length: float) -> Signed:
    """Give the distance, m, to a cylinder from its first face along a unit axis."""

    def distance(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        across, along = _polar(points - centre, axis)
        side, ends = across - radius, np.maximum(-along, along - length)
        out = np.hypot(np.maximum(side, 0.0), np.maximum(ends, 0.0))
        return np.where(out > 0.0, out, np.maximum(side, ends))

    return distance


def cone(centre: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], half_angle: float, length: float) -> Signed:
    """Give the distance, m, to all within `length` of an apex and `half_angle` (rad) of a unit axis."""
    rim = length * np.array([np.sin(half_angle), np.cos(half_angle)])

    def distance(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        plane = np.stack(_polar(points - centre, axis), axis=1)
        size, angle = np.hypot(*plane.T), np.arctan2(*plane.T)
        edge = _to_segment(plane, np.zeros(2), rim)
        return np.where(angle <= half_angle, np.maximum(size - length, -edge), edge)

    return distance


def mesh(hulls: Hulls) -> Signed:
    """Give the distance, m, to convex bodies by their corners and triangles; inside of one it says 0."""
    within = [scipy.spatial.Delaunay(hull.corners) for hull in hulls.parts]
    surface = ExactDistance(*hulls.surface)

    def distance(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        inside = np.any([body.find_simplex(points) >= 0 for body in within], axis=0)
        return np.where(inside, 0.0, surface.distance(points))

    return distance


def beside(
    port: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    length: float,
    *,
    half_angle: float | None = None,
    radius: float | None = None,
) -> Signed:
    """Give the distance, m, to all within `length` of a port but an endless tube or cone along a unit axis.

    A cone that is `radius` wide at the port has its apex behind it.
    """
    wide = radius or 0.0
    apex = port if half_angle is None else port - axis * wide / np.tan(half_angle)

    def distance(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        away = points - apex
        across, along = _polar(away, axis)
        if half_angle is None:
            room = wide - across
        else:
            angle = np.arctan2(across, along)
            # Within a right angle of the wall the foot of the perpendicular is on it, else the apex is nearest.
            room = lengths(away) * np.where(angle - half_angle < 0.5 * np.pi, np.sin(half_angle - angle), -1.0)
        return np.maximum(lengths(points - port) - length, room)

    return distance


def _polar(away: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along = away @ axis
    return lengths(away - along[:, None] * axis), along


def _to_segment(points: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    way = second - first
    t = np.clip((points - first) @ way / (way @ way), 0.0, 1.0)
    return np.hypot(*(points - first - t[:, None] * way).T)


@dataclass(frozen=True)
class Region:
    """Room that a flight must not enter while it stands.

    Attributes:
        name: in words.
        distance: signed, in the region's own axes, m.
        radius: of the ball about the chaser's centre that must not enter, m.
        rotations: region's axes ← body axes at each sample, or one for all of them.
        rate: bound on how fast the one turns against the other, rad/s.
        start: from when it stands, s.
        until: until when it stands, s.

    """

    name: str
    distance: Signed
    radius: float
    rotations: Float[np.ndarray, "samples 3 3"]
    rate: float = 0.0
    start: float = 0.0
    until: float = np.inf


@dataclass(frozen=True)
class Entered:
    """What is known of a region and one flight.

    Attributes:
        name: of the region.
        entered: whether it was, proved either way, or undecided.
        minimum_clearance: lower bound on how far from the region the chaser was at any instant while it stood, m;
            infinite where it never stood.
        measured_clearance: the least found at a sample, m.
        time: of that, s.

    """

    name: str
    entered: Contact
    minimum_clearance: float
    measured_clearance: float
    time: float


def entered(tube: Tube, region: Region, *, tolerance: float = 1e-3) -> list[Entered]:
    """Judge for each flight of a tube whether it entered a region.

    Args:
        tube: flights that share their sample times.
        region: the room.
        tolerance: how close to the truth the bound of a region that does not turn is driven, m.

    """
    time, flights = tube.time, len(tube.position)
    stands = np.flatnonzero((time >= region.start) & (time < region.until))
    steps = np.flatnonzero((time[1:] > region.start) & (time[:-1] < region.until))
    found, when = np.full(flights, np.inf), np.full(flights, np.nan)
    if stands.size:
        rotations = region.rotations[np.minimum(stands, len(region.rotations) - 1)]
        turned = np.einsum("kij,fkj->fki", rotations, tube.position[:, stands])
        away = region.distance(turned.reshape(-1, 3)).reshape(flights, -1)
        found, when = away.min(axis=1), time[stands][away.argmin(axis=1)]
    lower, end = np.full(flights, np.inf), int(steps[-1]) + 1 if steps.size else 0
    length = _LONGEST if region.rate else max(end, 1)
    for first in range(int(steps[0]), end, length) if steps.size else ():
        last = min(first + length, end)
        np.minimum(lower, _bounded(tube, region, first, last, found, tolerance), out=lower)
    lower, found = np.minimum(lower, found) - region.radius - _ROUNDING, found - region.radius
    return [
        Entered(region.name, _said(low, least), float(low), float(least), float(t))
        for low, least, t in zip(lower, found, when, strict=True)
    ]


def _said(lower: float, found: float) -> Contact:
    if found <= 0.0:
        return Contact.YES
    return Contact.NO if lower > 0.0 else Contact.UNDECIDED


def _at(region: Region, sample: int) -> Float[np.ndarray, "3 3"]:
    return region.rotations[min(sample, len(region.rotations) - 1)]


def _bounded(
    tube: Tube, region: Region, first: int, last: int, found: Float[np.ndarray, "flights"], tolerance: float
) -> Float[np.ndarray, "flights"]:
    """Bound each flight's distance from below over the steps from `first` until `last`; `found` is a least one, m."""
    middle = (first + last) // 2
    turned = region.rate * max(tube.time[middle] - tube.time[first], tube.time[last] - tube.time[middle])
    rotation = _at(region, middle)

    def nearer(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        return (region.distance(points @ rotation.T) - turned * lengths(points)) / (1.0 + turned)

    lower = nearest(_part(tube, first, last), nearer, tolerance=tolerance).lower
    clear = (lower - region.radius > _CLEAR) & (lower > _NEAR * found)
    if turned == 0.0 or last - first == 1 or np.all(clear):
        return lower
    halves = [_bounded(tube, region, *ends, found, tolerance) for ends in ((first, middle), (middle, last))]
    return np.maximum(lower, np.minimum(*halves))


def _part(tube: Tube, first: int, last: int) -> Tube:
    """Give the steps of a tube from `first` until `last`."""
    per_sample = ("time", "position", "velocity", "acceleration")
    parts = {}
    for name in (field.name for field in fields(tube) if field.name != "excursion"):
        array, end = getattr(tube, name), last + (name in per_sample)
        parts[name] = array[first:end] if array.ndim == 1 else array[:, first:end]
    return replace(tube, **parts)

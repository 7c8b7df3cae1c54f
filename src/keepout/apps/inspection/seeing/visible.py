"""When a patch counts as seen, what a camera at a place can see, and what of it is in view once it looks one way."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing.patches import Marks, Patches, Units
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.core.cores import kernel
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Point

_FINITE = 1e6
"""Metres; farther than any camera of an inspection looks."""
_ANGLE_ROUNDING = 1e-9
"""Added to angles, rad: more than rounding takes from them."""


@dataclass(frozen=True)
class SeeingRules:
    """What a frame must show of a patch to count: the whole of it, near enough, steep enough, fine enough, and lit.

    The camera's image is a square; of it the round middle counts, a cone about the boresight, so that a turn of the
    camera about its boresight changes nothing.

    Attributes:
        field_of_view: full angle of that cone, rad: across the image.
        pixels: across the image.
        least_range: every corner of a patch must be farther than this from the camera, m.
        greatest_range: every corner of a patch must be nearer than this, m.
        greatest_incidence: from a patch's normal to the line to the camera, at the corner where that is most,
            rad.
        greatest_sample_distance: on the patch, along the line of sight's slant, at the farthest corner, m a
            pixel; inf: not asked.
        greatest_sun_incidence: from a patch's normal to the sun, rad.

    """

    field_of_view: float = math.radians(60.0)
    pixels: int = 1024
    least_range: float = 0.3
    greatest_range: float = 10.0
    greatest_incidence: float = math.radians(60.0)
    greatest_sample_distance: float = math.inf
    greatest_sun_incidence: float = math.radians(80.0)

    def __post_init__(self) -> None:
        for name, most in (
            ("field_of_view", math.radians(170.0)),
            ("greatest_incidence", math.radians(89.0)),
            ("greatest_sun_incidence", math.radians(89.9)),
        ):
            value = getattr(self, name)
            if not 0.0 < value <= most:
                raise InspectionError(f"seeing: {name} is {value:g} rad; it must be above 0 and at most {most:.3f} rad")
        if not 8 <= self.pixels <= 65536:
            raise InspectionError(f"seeing: pixels is {self.pixels}; it must be 8 to 65536")
        if not 0.0 < self.least_range < self.greatest_range <= _FINITE:
            raise InspectionError(
                f"seeing: least_range is {self.least_range:g} m and greatest_range {self.greatest_range:g} m; the "
                f"first must be above 0 and below the second, which may be {_FINITE:g} m"
            )
        if not self.greatest_sample_distance > 0.0:
            raise InspectionError(
                f"seeing: greatest_sample_distance is {self.greatest_sample_distance:g} m; it must be above 0"
            )

    @property
    def half_angle(self) -> float:
        """Half the angle of the cone, rad."""
        return 0.5 * self.field_of_view

    @property
    def pixel_angle(self) -> float:
        """Angle of a pixel in the middle of the image, where it is widest, rad."""
        return 2.0 * math.tan(self.half_angle) / self.pixels


@dataclass(frozen=True, eq=False)
class Visible:
    """What can be seen from a place.

    Attributes:
        units: (k,) wholly visible, by all the rules but the field of view and the light.
        directions: (k, 3) unit vectors from the place.
        spread: (k,) rad: all of the unit lies within this angle of its direction.

    """

    units: Int[np.ndarray, " k"]
    directions: Float[np.ndarray, "k 3"]
    spread: Float[np.ndarray, " k"]

    def only(self, which: Bool[np.ndarray, " k"]) -> "Visible":
        """Give some of it."""
        return Visible(self.units[which], self.directions[which], self.spread[which])


def visible(sight: Sightlines, rules: SeeingRules, place: Point, *, among: Marks | None = None) -> Visible:
    """Say which units can be seen from a place.

    Over a plane piece range, incidence and ground sample distance are greatest at its farthest point, a corner.

    Args:
        sight: the mesh and its units.
        rules: range, incidence and ground sample distance.
        place: (3,) of the camera, m, body frame.
        among: (units,) those that are asked for; those that are counted if absent.

    """
    found = within_rules(sight.patches, rules, place, among)
    return found.only(sight.clear(place[None], found.units))


def within_rules(patches: Patches, rules: SeeingRules, place: Point, among: Marks | None = None) -> Visible:
    """Say which units keep range, incidence and ground sample distance, whatever stands between; as of `visible`."""
    place, among = np.ascontiguousarray(place, dtype=np.float64), patches.counted if among is None else among
    ranges = rules.least_range, rules.greatest_range
    steepest, finest = math.cos(rules.greatest_incidence), rules.greatest_sample_distance / rules.pixel_angle
    units, directions, spread = _within(patches.shapes, among, place, *ranges, steepest, finest)
    return Visible(units, directions, spread + _ANGLE_ROUNDING)


def in_view(seen: Visible, boresight: Point, half_angle: float) -> Bool[np.ndarray, " k"]:
    """Say which visible units are wholly in the cone of `half_angle` (rad) about a boresight (3,), a unit vector.

    A cone of less than a right angle is convex: a unit is in it if its corners are.
    """
    across = np.linalg.norm(np.cross(seen.directions, boresight), axis=1)
    return np.arctan2(across, seen.directions @ boresight) + seen.spread <= half_angle


def in_frame(
    sight: Sightlines, rules: SeeingRules, place: Point, boresight: Point, *, among: Marks | None = None
) -> Units:
    """Give the units seen from a place in one direction, in any light: those of `visible` that are `in_view`.

    What stands between is looked at last, and only for what is in view.

    Args:
        sight: the mesh and its units.
        rules: range, incidence, ground sample distance and field of view.
        place: (3,) of the camera, m, body frame.
        boresight: (3,) unit vector.
        among: (units,) those that are asked for; those that are counted if absent.

    """
    found = within_rules(sight.patches, rules, place, among)
    units = found.units[in_view(found, boresight, rules.half_angle)]
    return units[sight.clear(place[None], units)]


def lit_units(sight: Sightlines, rules: SeeingRules, sun: Point, *, among: Marks | None = None) -> Marks:
    """Say which units are wholly lit, at an incidence that the rules allow.

    Args:
        sight: the mesh and its units.
        rules: greatest sun incidence.
        sun: (3,) unit vector towards the sun, body frame.
        among: (units,) those that are asked for; those that are counted if absent.

    """
    patches = sight.patches
    steep = np.stack([patches.normals @ sun, -(patches.normals @ sun)], axis=1).reshape(-1)
    lit = (steep >= math.cos(rules.greatest_sun_incidence)) & (patches.counted if among is None else among)
    units = np.flatnonzero(lit)
    lit[units] = sight.lit(sun, units)
    return lit


@kernel()
def _within(shapes, among, place, least, greatest, steepest, finest):
    """Give units that keep range, incidence and sample distance, with a direction to each and its spread.

    With d the distance of the farthest corner and h the height above the plane, incidence is arccos(h / d) and the
    ground sample distance is (pixel angle) d² / h: both grow with d.
    """
    corners, counts, centres, normals = shapes
    number = len(counts)
    units = np.empty(number, dtype=np.int64)
    directions, spread = np.empty((number, 3)), np.empty(number)
    found = 0
    px, py, pz = place[0], place[1], place[2]
    for i in range(number):
        if not (among[2 * i] or among[2 * i + 1]):
            continue
        gx, gy, gz = px - centres[i, 0], py - centres[i, 1], pz - centres[i, 2]
        height = normals[i, 0] * gx + normals[i, 1] * gy + normals[i, 2] * gz
        unit = 2 * i if height > 0.0 else 2 * i + 1
        height = abs(height)
        square = gx * gx + gy * gy + gz * gz
        # The centre is in the patch: where it is too far, a corner is, too.
        if not among[unit] or square >= greatest * greatest or height * height < steepest * steepest * square:
            continue
        far, near = 0.0, np.inf
        x, y, z = 0.0, 0.0, 0.0
        for k in range(counts[i]):
            dx, dy, dz = corners[i, k, 0] - px, corners[i, k, 1] - py, corners[i, k, 2] - pz
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            far, near = max(far, distance), min(near, distance)
            if distance > 0.0:
                x, y, z = x + dx / distance, y + dy / distance, z + dz / distance
        if near <= least or far >= greatest or height < steepest * far or far * far > finest * height:
            continue
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        widest = 0.0
        for k in range(counts[i]):
            dx, dy, dz = corners[i, k, 0] - px, corners[i, k, 1] - py, corners[i, k, 2] - pz
            cx, cy, cz = dy * z - dz * y, dz * x - dx * z, dx * y - dy * x
            widest = max(widest, np.arctan2(np.sqrt(cx * cx + cy * cy + cz * cz), dx * x + dy * y + dz * z))
        units[found] = unit
        directions[found, 0], directions[found, 1], directions[found, 2] = x, y, z
        spread[found] = widest
        found += 1
    return units[:found].copy(), directions[:found].copy(), spread[:found].copy()

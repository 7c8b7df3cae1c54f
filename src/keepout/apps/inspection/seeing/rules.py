"""When a patch counts as seen: the camera's limits and the light's, each a number."""

import math
from dataclasses import dataclass

from keepout.core.errors import InspectionError

_FINITE = 1e6
"""Metres; farther than any camera of an inspection looks."""


@dataclass(frozen=True)
class SeeingRules:
    """What a frame must show of a patch to count: the whole of it, near enough, steep enough, fine enough, and lit.

    The camera's image is a square; of it the round middle counts, a cone about the boresight, so that a turn of the
    camera about its boresight changes nothing.
    """

    field_of_view: float = math.radians(60.0)
    """Full angle of that cone, rad: across the image."""
    pixels: int = 1024
    """Across the image."""
    least_range: float = 0.3
    """Every corner of a patch must be farther than this from the camera, m."""
    greatest_range: float = 10.0
    """Every corner of a patch must be nearer than this, m."""
    greatest_incidence: float = math.radians(60.0)
    """From a patch's normal to the line to the camera, at the corner where that is most, rad."""
    greatest_sample_distance: float = math.inf
    """On the patch, along the line of sight's slant, at the farthest corner, m a pixel; inf: not asked."""
    greatest_sun_incidence: float = math.radians(80.0)
    """From a patch's normal to the sun, rad."""

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

"""Whether the sealed volume hangs on the closing radius: the sign of a compartment with a gap in its wall."""

from dataclasses import dataclass

from keepout.core.geometry.distance import Distance
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.progress import Progress, silent

LARGEST_CHANGE = 0.2
"""Part of the larger sealed volume by which the two may differ without a warning."""


@dataclass(frozen=True)
class LeakCheck:
    """Sealed volumes of one surface at two closing radii. Metres and cubic metres."""

    offset: float
    closing_radius: float
    volume_at_offset: float
    """Sealed with a closing radius as small as the offset: only what is closed by itself."""
    volume_at_closing_radius: float
    envelope: float
    """How far an exterior point's signed distance may lie below d; see `OffsetSolid.envelope`."""

    @property
    def change(self) -> float:
        """Difference of the two volumes as a part of the larger one; 0 where nothing is sealed."""
        larger = max(self.volume_at_offset, self.volume_at_closing_radius)
        return abs(self.volume_at_closing_radius - self.volume_at_offset) / larger if larger > 0.0 else 0.0

    @property
    def warning(self) -> str | None:
        """One line if the change is more than 20 %, and what is done about it; otherwise None."""
        if self.change <= LARGEST_CHANGE:
            return None
        return (
            f"sealed volume {self.volume_at_offset:.4g} m³ at a closing radius of {self.offset:g} m but "
            f"{self.volume_at_closing_radius:.4g} m³ at {self.closing_radius:g} m: a compartment leaks through a gap; "
            f"a chaser wider than {2.0 * self.closing_radius:g} m cannot pass it, and it is sealed"
        )


def leak_check(
    distance: Distance,
    *,
    offset: float = 0.03,
    closing_radius: float = 0.25,
    leaf: float | None = None,
    progress: Progress = silent,
) -> LeakCheck:
    """Build the offset solid at two closing radii, the offset and the given one, and compare what they seal.

    Args:
        distance: exact unsigned distance to the surfaces.
        offset: metres; see `OffsetSolid.build`, also for `leaf`.
        closing_radius: metres, at least the offset.
        leaf: side of the smallest cells, metres.
        progress: called as the two builds advance.

    Raises:
        MeshError: see `OffsetSolid.build`.

    """

    def build(radius: float, part: float) -> OffsetSolid:
        return OffsetSolid.build(
            distance,
            offset=offset,
            closing_radius=radius,
            leaf=leaf,
            progress=lambda done, line: progress(0.5 * (part + done), line),
        )

    # One after the other, so that only one solid is in memory.
    closed = build(closing_radius, 0.0)
    volume, envelope = closed.sealed_volume, closed.envelope
    del closed
    return LeakCheck(offset, closing_radius, build(offset, 1.0).sealed_volume, volume, envelope)

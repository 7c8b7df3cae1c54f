"""Everything that is known about a target's mesh before anything is learned from it, as plain figures."""

import time
from dataclasses import dataclass

from keepout.core.geometry.leak import leak_check
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, silent


@dataclass(frozen=True)
class MeshSurvey:
    """A mesh report with sealed volumes. Metres, cubic metres; every field is plain, `dataclasses.asdict` is JSON."""

    name: str
    sha256: str
    triangles: int
    points: int
    """Balls of a point cloud; 0 for a mesh."""
    parts: int
    open_edges: int
    non_manifold_edges: int
    degenerate_faces: int
    stray_parts: int
    watertight: bool
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    extents: tuple[float, float, float]
    offset: float
    closing_radius: float
    sealed_volume_at_offset: float
    """Cubic metres sealed with a closing radius as small as the offset."""
    sealed_volume: float
    """Cubic metres sealed at the closing radius."""
    envelope: float
    """The most by which the offset solid's distance lies below the exact one, away from sealed gaps."""
    warnings: tuple[str, ...]
    """One line each: what is odd about the mesh, and what is done about it."""
    actions: tuple[str, ...]
    """One line each: what the reading did to the mesh."""
    seconds: float
    """Wall-clock time of the survey."""


def survey(
    target: Target, *, offset: float = 0.03, closing_radius: float = 0.25, progress: Progress = silent
) -> MeshSurvey:
    """Survey a target: its mesh report, and the volumes that its offset solid seals at two closing radii.

    Args:
        target: as loaded.
        offset: metres; see `OffsetSolid.build`.
        closing_radius: metres, at least the offset: the chaser's radius, or 0.25 m if that is less.
        progress: called as the two solids are built.

    Raises:
        MeshError: see `OffsetSolid.build`.

    """
    start = time.perf_counter()
    report = target.report
    leak = leak_check(target.distance, offset=offset, closing_radius=closing_radius, progress=progress)
    return MeshSurvey(
        name=target.name,
        sha256=target.sha256,
        triangles=report.triangles,
        points=report.points,
        parts=report.parts,
        open_edges=report.open_edges,
        non_manifold_edges=report.non_manifold_edges,
        degenerate_faces=report.degenerate_faces,
        stray_parts=report.stray_parts,
        watertight=report.watertight,
        lower=report.lower,
        upper=report.upper,
        extents=report.extents,
        offset=offset,
        closing_radius=closing_radius,
        sealed_volume_at_offset=leak.volume_at_offset,
        sealed_volume=leak.volume_at_closing_radius,
        envelope=leak.envelope,
        warnings=report.warnings + ((leak.warning,) if leak.warning else ()),
        actions=report.actions,
        seconds=time.perf_counter() - start,
    )

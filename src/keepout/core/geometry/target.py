"""The target: one mesh or point cloud in its body frame, in metres; and the survey of it before anything is learned."""

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.distance import BallCloudDistance, Distance, ExactDistance
from keepout.core.geometry.mesh_files.contents import MeshContents, resolved
from keepout.core.geometry.mesh_input import MeshReport, describe, read_surface
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.kept import digest
from keepout.core.plug_ins import load
from keepout.core.progress import Progress, part_of, silent

LARGEST_CHANGE = 0.2
"""Part of the larger sealed volume by which those at two closing radii may differ without a warning."""


@dataclass(frozen=True, eq=False)
class Target:
    """A target's surface in its body frame, in metres.

    A point cloud has one degenerate triangle (i, i, i) a point and a positive `ball_radius`: each point is a ball.
    Of the skin of a map, `broken` says what makes it one that nothing is promised of (docs/mapping.md).
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    report: MeshReport
    ball_radius: float = 0.0
    broken: tuple[str, ...] = ()

    @classmethod
    def load(
        cls,
        source: str | Path,
        *,
        units: str | None = None,
        scale: float | None = None,
        drop_stray: bool = False,
        rotation: Sequence[Sequence[float]] | Float[np.ndarray, "3 3"] | None = None,
        origin: Sequence[float] | Float[np.ndarray, "3"] | None = None,
        parameters: dict[str, float] | None = None,
        thickness: float | None = None,
    ) -> "Target":
        """Load a mesh file, a point cloud, or a built-in target by name.

        Vertices become rotation @ (scale * file vertex - origin).

        Args:
            source: a built-in's name (`keepout targets` lists them) or a path to GLB, glTF, OBJ, STL, PLY, OFF, 3MF,
                a map (KEEPMAP) whose skin it is, or a point cloud as PLY, XYZ or NPY.
            units: of the file: m, cm, mm, in or ft.
            scale: metres a file unit, instead of `units`.
            drop_stray: leave out parts that lie far from the rest.
            rotation: (3, 3) from file axes to body axes; the identity if absent.
            origin: (3,) body origin in file axes, metres; zero if absent.
            parameters: of a built-in, such as {"wing_angle": 0.5}.
            thickness: of a point cloud, metres: each point is a ball of this diameter.

        Raises:
            MeshError: with one line saying what is wrong with the file or an argument, and what would be valid.

        """
        name = str(source)
        if name in BUILTINS:
            if units is not None or scale is not None or thickness is not None or drop_stray:
                raise MeshError(
                    f"{name}: a built-in is in metres; units, scale, thickness and drop_stray are for files"
                )
            vertices, faces = BUILTINS[name].build(parameters)
            surface = MeshContents(vertices, faces)
        else:
            if parameters:
                raise MeshError(f"{name}: parameters are for built-ins; a file takes none")
            name = Path(source).stem
            surface = read_surface(Path(source), units=units, scale=scale, drop_stray=drop_stray, thickness=thickness)
        size = float(np.ptp(surface.vertices, axis=0).max())
        turned, middle = _rotation(rotation), _origin(origin)
        surface = replace(surface, vertices=(surface.vertices - middle) @ turned.T)
        if size > 0.0 and not resolved(surface.vertices, size):
            raise MeshError(
                f"{name}: origin is {np.max(np.abs(middle)):.4g} m away from a mesh of {size:.4g} m: rounding "
                "would change it by more than a millionth"
            )
        return cls(name, surface.vertices, surface.faces, describe(surface), surface.ball_radius, surface.broken)

    @functools.cached_property
    def distance(self) -> Distance:
        """Exact unsigned distance to the surface."""
        if self.ball_radius > 0.0:
            return BallCloudDistance(self.vertices[self.faces[:, 0]], self.ball_radius)
        return ExactDistance(self.vertices, self.faces)

    @functools.cached_property
    def sha256(self) -> str:
        """Hex digest of the vertices (float64, little endian), the faces (int64) and, for a cloud, the ball radius."""
        balls = [np.array([self.ball_radius], dtype="<f8")] if self.ball_radius > 0.0 else []
        return digest(np.asarray(self.vertices, dtype="<f8"), np.asarray(self.faces, dtype="<i8"), *balls)

    def _repr_html_(self) -> str:
        return load("notebook", "target")(self)


def _rotation(rotation: Sequence[Sequence[float]] | Float[np.ndarray, "3 3"] | None) -> Float[np.ndarray, "3 3"]:
    matrix = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    if (
        matrix.shape != (3, 3)
        or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
        or np.linalg.det(matrix) < 0.0
    ):
        raise MeshError(
            f"rotation: {matrix.tolist()}; it must be a 3 x 3 rotation matrix, orthonormal with determinant +1"
        )
    return matrix


def _origin(origin: Sequence[float] | Float[np.ndarray, "3"] | None) -> Float[np.ndarray, "3"]:
    point = np.zeros(3) if origin is None else np.asarray(origin, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise MeshError(f"origin: {point.tolist()}; it must be three finite coordinates in metres")
    return point


@dataclass(frozen=True)
class LeakCheck:
    """Sealed volumes of one surface at two closing radii: the sign of a compartment with a gap in its wall.

    Metres and cubic metres. Sealed at the offset is only what is closed by itself; `envelope` is how far an exterior
    point's signed distance may lie below d (`OffsetSolid.envelope`).
    """

    offset: float
    closing_radius: float
    volume_at_offset: float
    volume_at_closing_radius: float
    envelope: float

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
    distance: Distance, *, offset: float = 0.03, closing_radius: float = 0.25, progress: Progress = silent
) -> LeakCheck:
    """Build the offset solid at two closing radii, the offset and the given one, and compare what they seal.

    Args:
        distance: exact unsigned distance to the surfaces.
        offset: metres; see `OffsetSolid.build`.
        closing_radius: metres, at least the offset.
        progress: called as the two builds advance.

    Raises:
        MeshError: see `OffsetSolid.build`.

    """

    def build(radius: float, part: float) -> OffsetSolid:
        told = part_of(progress, part, part + 0.5)
        return OffsetSolid.build(distance, offset=offset, closing_radius=radius, progress=told)

    # One after the other, so that only one solid is in memory.
    closed = build(closing_radius, 0.0)
    volume, envelope = closed.sealed_volume, closed.envelope
    del closed
    return LeakCheck(offset, closing_radius, build(offset, 0.5).sealed_volume, volume, envelope)


@dataclass(frozen=True)
class MeshSurvey:
    """A mesh report with sealed volumes. Metres, cubic metres; every field is plain, `dataclasses.asdict` is JSON.

    Attributes:
        points: balls of a point cloud; 0 for a mesh.
        sealed_volume_at_offset: sealed with a closing radius as small as the offset.
        sealed_volume: sealed at the closing radius.
        envelope: the most by which the offset solid's distance lies below the exact one, away from sealed gaps.
        warnings: one line each: what is odd about the mesh, and what is done about it.
        actions: one line each: what the reading did to the mesh.
        seconds: wall-clock time of the survey.

    """

    name: str
    sha256: str
    triangles: int
    points: int
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
    sealed_volume: float
    envelope: float
    warnings: tuple[str, ...]
    actions: tuple[str, ...]
    seconds: float


def survey(target: Target, *, progress: Progress = silent) -> MeshSurvey:
    """Survey a target: its mesh report, and the volumes that its offset solid seals at two closing radii.

    Args:
        target: as loaded.
        progress: called as the two solids are built.

    """
    start = time.perf_counter()
    leak = leak_check(target.distance, progress=progress)
    reported: dict[str, Any] = {entry.name: getattr(target.report, entry.name, None) for entry in fields(MeshSurvey)}
    own = {
        "name": target.name,
        "sha256": target.sha256,
        "offset": leak.offset,
        "closing_radius": leak.closing_radius,
        "sealed_volume_at_offset": leak.volume_at_offset,
        "sealed_volume": leak.volume_at_closing_radius,
        "envelope": leak.envelope,
        "warnings": target.report.warnings + ((leak.warning,) if leak.warning else ()),
        "seconds": time.perf_counter() - start,
    }
    return MeshSurvey(**(reported | own))

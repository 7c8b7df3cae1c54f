"""The target: one mesh or point cloud in its body frame, in metres."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.distance import BallCloudDistance, Distance, ExactDistance
from keepout.core.geometry.mesh_files.contents import MeshContents, resolved
from keepout.core.geometry.mesh_input import MeshReport, describe, read_surface
from keepout.core.kept import digest
from keepout.core.plug_ins import load


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

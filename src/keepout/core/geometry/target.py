"""The target: one mesh or point cloud in its body frame, in metres; and what its file says, read with a clear word.

A report says what the mesh is made of and what is odd about it: parts, open edges, duplicates, stray parts.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Int

from keepout.core.errors import MeshError
from keepout.core.geometry.builtin import BUILTINS, triple
from keepout.core.geometry.distance import BallCloudDistance, Distance, ExactDistance
from keepout.core.geometry.mesh_files import READERS
from keepout.core.geometry.mesh_files.contents import MeshContents, counted, resolved, text_lines
from keepout.core.kept import digest
from keepout.core.plug_ins import load


@dataclass(frozen=True)
class MeshReport:
    """What a target's mesh contains. Lengths in metres; counts are of the faces kept.

    `points` are the balls of a point cloud, 0 for a mesh; `parts` are connected through shared vertices; `actions` say
    what the reading did about duplicates, units, stray parts and the like, one line each.
    """

    triangles: int
    points: int
    parts: int
    open_edges: int
    non_manifold_edges: int
    degenerate_faces: int
    stray_parts: int
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    actions: tuple[str, ...]

    @property
    def extents(self) -> tuple[float, float, float]:
        """Size along x, y and z, metres."""
        x, y, z = (float(b - a) for a, b in zip(self.lower, self.upper))
        return x, y, z

    @property
    def watertight(self) -> bool:
        """Whether every edge has exactly two triangles."""
        return self.triangles > 0 and self.open_edges == 0 and self.non_manifold_edges == 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for each oddity that the user should know; none of them stops the offset solid."""
        found = []
        if self.open_edges:
            found.append(
                f"{self.open_edges} open edges: the mesh is not closed; thin sheets get the offset as thickness"
            )
        if self.non_manifold_edges:
            found.append(f"{self.non_manifold_edges} edges with more than two triangles: parts cut or touch each other")
        if self.degenerate_faces:
            found.append(f"{self.degenerate_faces} triangles without area: kept, as the segments that they are")
        if self.stray_parts:
            found.append(f"{self.stray_parts} parts lie far from the rest: drop_stray leaves them out")
        return tuple(found)


def describe(surface: MeshContents) -> MeshReport:
    """Count what is in a surface in metres."""
    used = surface.vertices[surface.faces]
    lower, upper = used.min(axis=(0, 1)) - surface.ball_radius, used.max(axis=(0, 1)) + surface.ball_radius
    cloud = surface.ball_radius > 0.0
    open_edges = crowded = degenerate = stray = 0
    parts = len(surface.faces)
    if not cloud:
        welded = weld(surface.vertices, surface.faces)
        part = part_labels(welded)
        parts = int(part.max()) + 1
        degenerate = int(zero_area(used).sum())
        whole = welded[(welded != np.roll(welded, 1, axis=1)).all(axis=1)]
        edges = np.sort(whole[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, times = np.unique(edges[:, 0] * (int(welded.max()) + 1) + edges[:, 1], return_counts=True)
        open_edges, crowded = int((times == 1).sum()), int((times > 2).sum())
        stray = len(np.unique(part[stray_faces(used, part)]))
    return MeshReport(
        triangles=0 if cloud else len(surface.faces),
        points=len(surface.faces) if cloud else 0,
        parts=parts,
        open_edges=open_edges,
        non_manifold_edges=crowded,
        degenerate_faces=degenerate,
        stray_parts=stray,
        lower=triple(lower),
        upper=triple(upper),
        actions=surface.actions,
    )


def weld(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3"]:
    """Give the faces one index for all vertices at the same position."""
    _, first = np.unique(vertices, axis=0, return_inverse=True)
    return first.reshape(-1)[faces]


def part_labels(welded: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f"]:
    """Label each face with its component, 0, 1, …, connected through shared vertices."""
    count = int(welded.max()) + 1
    start, end = welded[:, [0, 1]].reshape(-1), welded[:, [1, 2]].reshape(-1)
    graph = scipy.sparse.coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(count, count))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, label = np.unique(label[welded[:, 0]], return_inverse=True)
    return label.reshape(-1).astype(np.int64)


def zero_area(triangles: Float[np.ndarray, "f 3 3"]) -> Bool[np.ndarray, "f"]:
    """Whether each triangle's height over its longest edge is below a millionth of that edge."""
    edges = triangles - np.roll(triangles, 1, axis=1)
    longest = (edges**2).sum(axis=2).max(axis=1)
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) <= 1e-6 * longest


def stray_faces(triangles: Float[np.ndarray, "f 3 3"], part: Int[np.ndarray, "f"]) -> Bool[np.ndarray, "f"]:
    """Faces of parts far from the rest.

    The body grows from the part with the largest area: a part joins when the gap between its box and the body's is at
    most a quarter of the body's diagonal. What never joins is stray.
    """
    count = int(part.max()) + 1
    lower, upper = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(lower, part, triangles.min(axis=1))
    np.maximum.at(upper, part, triangles.max(axis=1))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    body = np.zeros(count, dtype=bool)
    body[np.argmax(np.bincount(part, weights=np.linalg.norm(normal, axis=1), minlength=count))] = True
    while True:
        low, high = lower[body].min(axis=0), upper[body].max(axis=0)
        gap = np.linalg.norm(np.maximum(np.maximum(low - upper, lower - high), 0.0), axis=1)
        grown = gap <= 0.25 * np.linalg.norm(high - low)
        if not (grown & ~body).any():
            return ~body[part]
        body |= grown


def enclosed_volume(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Volume in cubic metres inside a closed, outward oriented mesh, by the divergence theorem.

    It means nothing for an open or wrongly oriented mesh: use `OffsetSolid.sealed_volume` there.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_DECLARED = {"micron": 1e-6, "millimeter": 0.001, "centimeter": 0.01, "meter": 1.0, "inch": 0.0254, "foot": 0.3048}
"""Metres in the units that a 3MF file can declare."""
_POINT_SUFFIXES = (".xyz", ".npy")
_MAP_SUFFIX = ".keepmap"
SMALLEST, LARGEST = 0.5, 500.0
"""Metres: a target outside this range without units is questioned."""
_LIMIT = 1e6
"""Metres: a larger target is refused whatever its units; squares of its lengths must not overflow."""


def read_surface(
    path: Path, *, units: str | None, scale: float | None, drop_stray: bool, thickness: float | None
) -> MeshContents:
    """Read one file into vertices and triangles in metres; see `Target.load` for the arguments.

    Raises:
        MeshError: see `Target.load`.

    """
    _check_file(path)
    contents = _read_points(path) if path.suffix.lower() in _POINT_SUFFIXES else _read_mesh(path)
    vertices, faces = contents.vertices, contents.faces
    factor, actions = _scale(path, units, scale, contents.unit)
    actions += contents.actions
    cloud = len(faces) == 0
    if cloud:
        if thickness is not None and not 0.0 < thickness < LARGEST:
            raise MeshError(f"{path.name}: thickness = {thickness}; it must be positive, in metres")
        if thickness is None:
            raise MeshError(
                f"{path.name}: {len(vertices)} points and no triangles{_aside(contents)}; give thickness, the diameter "
                "in metres of the ball that each point stands for"
            )
        faces = np.repeat(np.arange(len(vertices))[:, None], 3, axis=1)
    elif thickness is not None:
        raise MeshError(f"{path.name}: thickness = {thickness} is for point clouds, and this file has triangles")
    if not np.isfinite(vertices[faces]).all():
        bad = int((~np.isfinite(vertices[faces])).any(axis=(1, 2)).sum())
        raise MeshError(f"{path.name}: {bad} of {len(faces)} faces have a coordinate that is not finite")
    vertices = np.where(np.isfinite(vertices), vertices, 0.0) * factor
    used = vertices[faces].reshape(-1, 3)
    # Halved, because the difference of two finite numbers can overflow.
    size = 2.0 * float((0.5 * used.max(axis=0) - 0.5 * used.min(axis=0)).max())
    if not size <= _LIMIT:
        raise MeshError(f"{path.name}: the largest extent would be {size:.4g} m; it must be at most {_LIMIT:.0e} m")
    asked = units is None and scale is None and path.suffix.lower() != _MAP_SUFFIX
    if asked and not SMALLEST <= size <= LARGEST:
        raise MeshError(
            f"{path.name}: the largest extent would be {size:.4g} m; give units (m, cm, mm, in, ft) or "
            f"scale, whether that is right or wrong; without them {SMALLEST} to {LARGEST:.0f} m is taken"
        )
    if size > 0.0 and not resolved(used, size):
        raise MeshError(
            f"{path.name}: its largest extent is {size / factor:.4g} and its coordinates go up to "
            f"{np.abs(used).max() / factor:.4g}, in the file's unit: rounding changes it by more than a millionth"
        )
    if cloud:
        return MeshContents(vertices, faces, tuple(actions), ball_radius=0.5 * float(thickness or 0.0))
    unused = len(vertices) - len(np.unique(faces))
    if unused:
        actions.append(f"left out {counted(unused, 'point')} that no triangle uses")
    faces = _clean(path, vertices, faces, drop_stray, actions)
    kept, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    return MeshContents(vertices[kept], faces, tuple(actions), broken=contents.broken)


def _check_file(path: Path) -> None:
    if not path.exists():
        raise MeshError(f"{path}: no such file, and no built-in target of that name")
    if path.is_dir():
        raise MeshError(f"{path}: a directory; give one mesh file")
    known = sorted({*READERS, *_POINT_SUFFIXES})
    if path.suffix.lower() not in known:
        raise MeshError(f"{path.name}: suffix {path.suffix!r} is unknown; meshes come as {', '.join(known)}")
    if path.stat().st_size == 0:
        raise MeshError(f"{path.name}: the file is empty")


def _read_points(path: Path) -> MeshContents:
    actions = []
    try:
        if path.suffix.lower() == ".npy":
            points = np.load(path, allow_pickle=False)
        else:
            lines, actions = text_lines(path)
            points = np.loadtxt(lines, ndmin=2)
    except Exception as cause:  # both readers raise many kinds on foreign content
        raise MeshError(f"{path.name}: not readable as points: {_one_line(cause)}") from cause
    real = np.issubdtype(points.dtype, np.number) and not np.issubdtype(points.dtype, np.complexfloating)
    if points.ndim != 2 or points.shape[1] < 3 or len(points) == 0 or not real:
        raise MeshError(
            f"{path.name}: an array of {points.dtype} of shape {points.shape}; points need rows of at least three "
            "numbers"
        )
    if points.shape[1] > 3:
        actions = [*actions, f"took the first three of {points.shape[1]} columns"]
    return MeshContents(
        np.ascontiguousarray(points[:, :3], dtype=np.float64), np.zeros((0, 3), dtype=np.int64), tuple(actions)
    )


def _read_mesh(path: Path) -> MeshContents:
    """Read a mesh file with its format's reader; whatever that meets in a damaged file is one line."""
    kind = f"{path.name}: not readable as {path.suffix[1:].upper()}"
    try:
        contents = READERS[path.suffix.lower()](path)
    except MeshError as refusal:
        raise MeshError(f"{kind}: {' '.join(str(refusal).split())}") from refusal
    except Exception as cause:  # a damaged tree or archive can miss anything anywhere
        raise MeshError(f"{kind}: its structure is damaged ({type(cause).__name__}: {_one_line(cause)})") from cause
    if len(contents.vertices) == 0:
        raise MeshError(
            f"{path.name}: no triangles and no points in it{_aside(contents)}; export the geometry itself, not "
            "references to it"
        )
    return contents


def _scale(path: Path, units: str | None, scale: float | None, declared: str | None) -> tuple[float, list[str]]:
    """Metres a file unit, and what to tell the user about it."""
    if path.suffix.lower() == _MAP_SUFFIX and (units not in (None, "m") or scale is not None):
        given = f"scale = {scale}" if units in (None, "m") else f"units = {units!r}"
        raise MeshError(f"{path.name}: {given}; a map is in metres: leave units and scale out")
    if units is not None and scale is not None:
        raise MeshError(f"{path.name}: units = {units!r} and scale = {scale} together; give one of them")
    if scale is not None:
        if not (np.isfinite(scale) and scale > 0.0):
            raise MeshError(f"{path.name}: scale = {scale}; it must be a positive number of metres a file unit")
        aside = "" if declared is None else f", where the file declares {declared[:40]}"
        return float(scale), [f"scaled by {scale}{aside}"]
    if declared is not None:
        if declared not in _DECLARED:
            raise MeshError(f"{path.name}: declares the unit {declared[:40]!r}; valid are {', '.join(_DECLARED)}")
        if units is not None and UNITS.get(units) != _DECLARED[declared]:
            raise MeshError(
                f"{path.name}: units = {units!r}, and the file declares {declared}; leave units out, or give scale, "
                "the metres of a file unit, if the file is wrong"
            )
        said = [] if declared == "meter" else [f"converted from {declared}, the unit that the file declares"]
        return _DECLARED[declared], said
    units = units or "m"
    if units not in UNITS:
        raise MeshError(f"{path.name}: units = {units!r}; valid are {', '.join(UNITS)}")
    return UNITS[units], [] if units == "m" else [f"converted from {units}"]


def _clean(
    path: Path, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], drop_stray: bool, actions: list[str]
) -> Int[np.ndarray, "kept 3"]:
    """Faces without duplicates, without faces that are one point, and without stray parts where asked."""
    welded = weld(vertices, faces)
    _, first = np.unique(np.sort(welded, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        actions.append(f"left out {len(faces) - len(first)} duplicate faces")
    first = np.sort(first)
    faces, welded = faces[first], welded[first]
    if zero_area(vertices[faces]).all():
        raise MeshError(f"{path.name}: none of its {len(faces)} triangles has an area")
    if drop_stray:
        part = part_labels(welded)
        stray = stray_faces(vertices[faces], part)
        if stray.any():
            actions.append(f"left out {len(np.unique(part[stray]))} stray parts, {int(stray.sum())} triangles")
            faces = faces[~stray]
    return faces


def _aside(contents: MeshContents) -> str:
    """Repeat what the reader said, for a refusal that may be due to it."""
    return f" ({'; '.join(contents.actions)})" if contents.actions else ""


def _one_line(cause: Exception) -> str:
    return (" ".join(str(cause).split()) or type(cause).__name__)[:160]


@dataclass(frozen=True, eq=False)
class Target:
    """A target's surface: `vertices` (m, body frame), and `faces`, each of three of them.

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

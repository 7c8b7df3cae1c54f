"""Parts that spacecraft are made of, as exact solids to be united (manifold3d, Lalish)."""

from collections.abc import Iterable, Sequence

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from manifold3d import CrossSection, Manifold

Vector = Sequence[float] | Float[np.ndarray, "3"]


def box(centre: Vector, size: Vector) -> Manifold:
    """Make an axis-aligned box, metres."""
    return Manifold.cube(_triple(size), center=True).translate(_triple(centre))


def rod(start: Vector, end: Vector, radius: float, end_radius: float | None = None, segments: int = 16) -> Manifold:
    """Make a cylinder, or a frustum where `end_radius` differs, between two points."""
    first, last = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    axis = last - first
    length = float(np.linalg.norm(axis))
    shape = Manifold.cylinder(length, radius, radius if end_radius is None else end_radius, segments)
    return shape.transform(np.column_stack([_basis(axis / length), first]))


def turned(origin: Vector, axis: Vector, outline: Sequence[tuple[float, float]], segments: int = 32) -> Manifold:
    """Revolve (distance along the axis, radius) pairs, in rising order, about an axis through the origin given."""
    stations = [(0.0, outline[0][0]), *[(radius, along) for along, radius in outline], (0.0, outline[-1][0])]
    shape = Manifold.revolve(CrossSection([np.array(stations)]), segments)
    direction = np.asarray(axis, dtype=float)
    return shape.transform(
        np.column_stack([_basis(direction / np.linalg.norm(direction)), np.asarray(origin, dtype=float)])
    )


def sphere(centre: Vector, radius: float, segments: int = 24) -> Manifold:
    """Make a faceted sphere whose corners lie on the radius."""
    return Manifold.sphere(radius, segments).translate(_triple(centre))


def dish(
    vertex: Vector, boresight: Vector, diameter: float, focal_length: float, thickness: float = 0.04, segments: int = 32
) -> Manifold:
    """Make a paraboloid shell z = r²/(4 f) of constant thickness along its axis, opening towards `boresight`."""
    radii = np.linspace(0.0, 0.5 * diameter, 9)
    depth = radii**2 / (4.0 * focal_length)
    outline = np.concatenate([np.column_stack([radii, depth - thickness]), np.column_stack([radii, depth])[::-1]])
    shape = Manifold.revolve(CrossSection([outline.tolist()]), segments)
    axis = np.asarray(boresight, dtype=float)
    return shape.transform(np.column_stack([_basis(axis / np.linalg.norm(axis)), np.asarray(vertex, dtype=float)]))


def unite(parts: Iterable[Manifold]) -> Manifold:
    """Unite all parts into one closed surface a body, with nothing inside."""
    return Manifold.batch_boolean(list(parts), manifold3d.OpType.Add)


def mesh(solid: Manifold) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices in metres and outward triangles of a solid."""
    made = solid.to_mesh64()
    return np.array(made.vert_properties[:, :3], dtype=np.float64), np.array(made.tri_verts, dtype=np.int64)


def _triple(vector: Vector) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def _basis(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Make a rotation whose third column is the axis."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])

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
    axis = np.asarray(end, dtype=float) - np.asarray(start, dtype=float)
    length = float(np.linalg.norm(axis))
    shape = Manifold.cylinder(length, radius, radius if end_radius is None else end_radius, segments)
    return _placed(shape, start, axis)


def turned(origin: Vector, axis: Vector, outline: Sequence[tuple[float, float]], segments: int = 32) -> Manifold:
    """Revolve (distance along the axis, radius) pairs, in rising order, about an axis through the origin given."""
    stations = [(0.0, outline[0][0]), *[(radius, along) for along, radius in outline], (0.0, outline[-1][0])]
    return _placed(Manifold.revolve(CrossSection([np.array(stations)]), segments), origin, axis)


def sphere(centre: Vector, radius: float, segments: int = 24) -> Manifold:
    """Make a faceted sphere whose corners lie on the radius."""
    return Manifold.sphere(radius, segments).translate(_triple(centre))


def dish(vertex: Vector, boresight: Vector, diameter: float, focal_length: float, thickness: float) -> Manifold:
    """Make a paraboloid shell z = r²/(4 f) of constant thickness along its axis, opening towards `boresight`."""
    radii = np.linspace(0.0, 0.5 * diameter, 9)
    depth = radii**2 / (4.0 * focal_length)
    outline = np.concatenate([np.column_stack([radii, depth - thickness]), np.column_stack([radii, depth])[::-1]])
    return _placed(Manifold.revolve(CrossSection([outline.tolist()]), 32), vertex, boresight)


def unite(parts: Iterable[Manifold]) -> Manifold:
    """Unite all parts into one closed surface a body, with nothing inside.

    No part may be a union itself: manifold3d makes one apart only where somebody else holds it, be it a debugger, and
    the triangles are others then.
    """
    return Manifold.batch_boolean(list(parts), manifold3d.OpType.Add)


def mesh(solid: Manifold) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices in metres and outward triangles of a solid."""
    made = solid.to_mesh64()
    return np.array(made.vert_properties[:, :3], dtype=np.float64), np.array(made.tri_verts, dtype=np.int64)


def _triple(vector: Vector) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def _placed(shape: Manifold, origin: Vector, axis: Vector) -> Manifold:
    """Turn a body's z axis to a direction of any length, and move its origin."""
    third = np.asarray(axis, dtype=float)
    third = third / np.linalg.norm(third)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return shape.transform(np.column_stack([first, np.cross(third, first), third, np.asarray(origin, dtype=float)]))

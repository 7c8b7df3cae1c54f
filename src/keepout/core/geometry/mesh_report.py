"""What a mesh is made of and what is odd about it: parts, open edges, duplicates, stray parts."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse.csgraph
from jaxtyping import Bool, Float, Int

from keepout.core.geometry.mesh_files.contents import MeshContents


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
        lower=_triple(lower),
        upper=_triple(upper),
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


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z

"""When each place on a target's surface was first in a depth image: worked out on the exact mesh, for pictures."""

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.known_free import Seen
from keepout.core.geometry.first_hit import FirstHit
from keepout.core.geometry.target import Target
from keepout.flights.report.raster import View, eye_axes

_SAMPLES = 12_000
_SHORT = 0.002
"""Metres by which a ray to a place on the surface may end before it and still count as reaching it."""
_APART = 3.0
"""Metres that two sides of a sheet count as apart, so that a place takes its time from its own side."""


class FirstSight:
    """Times of first sight at places spread over a mesh, by the poses of the views that a map took.

    Args:
        target: the true mesh.
        views: poses and times.
        camera: their camera.
        greatest_range: of a return, m.
        grazing_angle: between a ray and the surface's normal, beyond which no return comes, rad.

    """

    def __init__(
        self,
        target: Target,
        views: Sequence[Seen],
        camera: Pinhole,
        *,
        greatest_range: float,
        grazing_angle: float,
    ) -> None:
        mesh = trimesh.Trimesh(target.vertices, target.faces, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)[:2]
        self._normals = _normals(target)
        self.points: Float[np.ndarray, "n 3"] = np.asarray(points)
        self.times: Float[np.ndarray, " n"] = np.full(len(self.points), np.inf)
        """s; inf: never."""
        normals = self._normals[faces]
        self._tree = KDTree(np.concatenate([self.points, _APART * normals], axis=1))
        first_hit, slopes = FirstHit(target.vertices, target.faces), _slopes(camera)
        for view in views:
            unseen = np.flatnonzero(np.isinf(self.times))
            away = self.points[unseen] - view.position
            depth = away @ view.axes
            within = (depth[:, 2] > 0.0) & (np.abs(depth[:, :2]) <= slopes * depth[:, 2:]).all(axis=1)
            length = np.linalg.norm(away, axis=1)
            within &= (length > _SHORT) & (length <= greatest_range)
            upright = np.abs(np.einsum("ni,ni->n", away, normals[unseen])) > np.cos(grazing_angle) * length
            chosen = np.flatnonzero(within & upright)
            ranges = first_hit.ranges(view.position[None], away[chosen])
            self.times[unseen[chosen[ranges >= length[chosen] - _SHORT]]] = view.time

    def of_picture(
        self, target: Target, view: View, *, elevation: float, azimuth: float
    ) -> Float[np.ndarray, "rows columns"]:
        """Give the time of what is seen at each pixel of a picture, s; inf: never seen; nan: nothing is there."""
        axes = eye_axes(elevation, azimuth)
        middle = 0.5 * (target.vertices.min(axis=0) + target.vertices.max(axis=0))
        rows, columns = np.nonzero(view.hit)
        left, right, bottom, top = view.extent
        x = left + (columns + 0.5) * (right - left) / view.hit.shape[1]
        y = bottom + (rows + 0.5) * (top - bottom) / view.hit.shape[0]
        face = view.face[rows, columns]
        normal = self._normals[face] @ axes.T
        corner = (target.vertices[target.faces[face, 0]] - middle) @ axes.T
        # The eye's ray meets the face's plane where its depth says; a face seen edge-on hits no pixel's centre.
        slant = np.where(np.abs(normal[:, 2]) > 1e-9, normal[:, 2], 1.0)
        z = corner[:, 2] - ((x - corner[:, 0]) * normal[:, 0] + (y - corner[:, 1]) * normal[:, 1]) / slant
        places = np.column_stack([x, y, z]) @ axes + middle
        _, nearest = self._tree.query(np.concatenate([places, _APART * self._normals[face]], axis=1))
        times = np.full(view.hit.shape, np.nan)
        times[rows, columns] = self.times[nearest]
        return times


def _normals(target: Target) -> Float[np.ndarray, "f 3"]:
    a, b, c = np.moveaxis(target.vertices[target.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(length > 0.0, length, 1.0)


def _slopes(camera: Pinhole) -> Float[np.ndarray, "2"]:
    """Tangents of half the angles of view, across and down."""
    return 0.5 * np.array([camera.width, camera.height]) / camera.focal

"""Pictures of triangles as a camera has them: in perspective, with depth, lit by the sun or from the camera."""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing.sightlines import slab
from keepout.apps.led.camera import Pinhole
from keepout.apps.led.first_hit import FirstHit
from keepout.core.cores import kernel
from keepout.flights.pages.mesh_pictures import fill_triangle

_NEAR = 0.01
"""Metres before the camera within which nothing is drawn."""
_ABOVE = 1e-3
"""Metres over the surface from which a ray to the sun starts: an absolute length, so that no shadow is lost."""
_SHADOW = 0.13
"""Share of the light that a place without sun still gets, so that it is seen that something is there."""
_AMBIENT = 0.25
"""The same of the light at the camera."""
_BEND = 0.45
"""Angle between normals from which on there is an outline, rad."""
_STEP = 0.02
"""Step of the depth across a pixel beyond what the slope explains that makes an outline, as a share of the depth."""


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera has in its pixels, row 0 at the top.

    Attributes:
        camera: its image.
        position: of the camera, m.
        axes: of the camera as columns: x right, y down, z along the boresight.
        face: the nearest triangle at the pixel's middle; -1: none.
        depth: its distance along the boresight, m; inf: none.

    """

    camera: Pinhole
    position: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    face: Int[np.ndarray, "rows columns"]
    depth: Float[np.ndarray, "rows columns"]

    @property
    def hit(self) -> Bool[np.ndarray, "rows columns"]:
        """Whether anything is there."""
        return self.face >= 0

    def places(self) -> tuple[Float[np.ndarray, "hits 3"], Float[np.ndarray, "hits 3"]]:
        """Give the places that the pixels with something in them show, m, and unit vectors from there to the camera."""
        rows, columns = np.nonzero(self.hit)
        across = (columns + 0.5 - 0.5 * self.camera.width) / self.camera.focal
        down = (rows + 0.5 - 0.5 * self.camera.height) / self.camera.focal
        rays = np.column_stack([across, down, np.ones(len(rows))]) @ self.axes.T
        there = self.position + rays * self.depth[rows, columns, None]
        return there, -rays / np.linalg.norm(rays, axis=1, keepdims=True)


class Studio:
    """Triangles to take pictures of.

    Args:
        triangles: (f, 3, 3) corners, m.

    """

    def __init__(self, triangles: Float[np.ndarray, "f 3 3"]) -> None:
        self.triangles = np.ascontiguousarray(triangles, np.float64)
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    @functools.cached_property
    def _first_hit(self) -> FirstHit:
        return FirstHit(self.triangles.reshape(-1, 3), np.arange(3 * len(self.triangles)).reshape(-1, 3))

    def take(self, camera: Pinhole, position: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"]) -> Picture:
        """Take a picture.

        Args:
            camera: its image.
            position: of the camera, m.
            axes: of the camera as columns: x right, y down, z along the boresight.

        """
        face = np.full(camera.shape, -1)
        inverse = np.zeros(camera.shape)  # of the depth, which is linear in the image
        _paint(self.triangles, np.asarray(position, float), np.ascontiguousarray(axes), camera.focal, face, inverse)
        with np.errstate(divide="ignore"):
            return Picture(camera, position, axes, face, 1.0 / inverse)

    def light(self, picture: Picture, sun: Float[np.ndarray, "3"] | None = None) -> Float[np.ndarray, "rows columns"]:
        """Say how bright each pixel is, 0 to 1: by the sun, with the shadows of all triangles, or by a headlight.

        Args:
            picture: of these triangles.
            sun: (3,) unit vector towards it; None: the light is at the camera.

        """
        there, back = picture.places()
        normals = self.normals[picture.face[picture.hit]]
        normals = normals * np.where(np.einsum("ni,ni->n", normals, back) < 0.0, -1.0, 1.0)[:, None]
        if sun is None:
            shade = _AMBIENT + (1.0 - _AMBIENT) * np.clip(np.einsum("ni,ni->n", normals, back), 0.0, 1.0)
        else:
            upright = np.clip(normals @ sun, 0.0, 1.0)
            facing = np.flatnonzero(upright > 0.0)
            rays = np.broadcast_to(sun, (len(facing), 3))
            free = np.isinf(self._first_hit.ranges(there[facing] + _ABOVE * normals[facing], rays))
            sunlight = np.zeros(len(there))
            sunlight[facing[free]] = upright[facing[free]]
            shade = _SHADOW + (1.0 - _SHADOW) * np.sqrt(sunlight)
        bright = np.zeros(picture.face.shape)
        bright[picture.hit] = shade
        return bright

    def outlines(self, picture: Picture) -> Bool[np.ndarray, "rows columns"]:
        """Mark pixels of a picture of these triangles at whose right or lower side the surface bends or breaks off."""
        normals = np.zeros((*picture.face.shape, 3))
        normals[picture.hit] = self.normals[picture.face[picture.hit]]
        depth = np.where(picture.hit, picture.depth, 1e9)
        marked = np.zeros(picture.face.shape, bool)
        for axis in (0, 1):
            near, far = (np.take(normals, np.arange(k, normals.shape[axis] - 1 + k), axis) for k in (0, 1))
            here, there = (np.take(depth, np.arange(k, depth.shape[axis] - 1 + k), axis) for k in (0, 1))
            bends = np.abs(np.einsum("abi,abi->ab", near, far)) < np.cos(_BEND)
            breaks = np.abs(here - there) > _STEP * np.minimum(here, there)
            slanted = np.abs(np.einsum("abi,abi->ab", near, far)) > 1.0 - 1e-9  # one plane: steep, not broken
            found = bends | (breaks & ~slanted)
            marked[: found.shape[0], : found.shape[1]] |= found & (picture.hit[: found.shape[0], : found.shape[1]])
        return marked


@kernel(error_model="numpy")
def _paint(triangles, position, axes, focal, face, inverse):
    """Draw triangles into `face` and the inverse of the depth; what is nearer than `_NEAR` is cut away."""
    rows, columns = face.shape
    corner, cut = np.empty((3, 3)), np.empty((4, 3))
    for f in range(len(triangles)):
        for k in range(3):
            x, y, z = triangles[f, k, 0], triangles[f, k, 1], triangles[f, k, 2]
            dx, dy, dz = x - position[0], y - position[1], z - position[2]
            for axis in range(3):
                corner[k, axis] = dx * axes[0, axis] + dy * axes[1, axis] + dz * axes[2, axis]
        count = slab(corner, corner[:, 2], 3, _NEAR, 1.0, cut, cut[:, 2])
        for k in range(count):
            z = cut[k, 2]
            cut[k, 0] = focal * cut[k, 0] / z + 0.5 * columns - 0.5
            cut[k, 1] = focal * cut[k, 1] / z + 0.5 * rows - 0.5
            cut[k, 2] = 1.0 / z
        for k in range(1, count - 1):
            fill_triangle(cut[0], cut[k], cut[k + 1], f, face, inverse)

"""Shaded pictures of large triangle meshes with a depth buffer: matplotlib sorts triangles, which fails on big ones."""

from typing import NamedTuple, no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

_LIGHT = np.array([-0.35, 0.45, 0.82])
"""Direction to the light in the eye's axes: right, up, towards the eye."""


class View(NamedTuple):
    """What an eye at infinity sees, row 0 at the bottom.

    Attributes:
        hit: whether a triangle is seen there.
        face: which one; 0 where none is.
        light: 0 to 1.
        extent: left, right, bottom, top of the picture in metres from the mesh's middle.

    """

    hit: Bool[np.ndarray, "rows columns"]
    face: Int[np.ndarray, "rows columns"]
    light: Float[np.ndarray, "rows columns"]
    extent: tuple[float, float, float, float]


def eye_axes(elevation: float, azimuth: float) -> Float[np.ndarray, "3 3"]:
    """Rows to the right, up, and towards an eye that looks from this elevation and azimuth, degrees."""
    e, a = np.radians([elevation, azimuth])
    eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(eye, right), eye])


def rasterise(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    *,
    elevation: float,
    azimuth: float,
    columns: int = 1200,
) -> View:
    """Draw a mesh orthographically from a direction given by elevation and azimuth in degrees."""
    axes = eye_axes(elevation, azimuth)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    seen = (vertices - middle) @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = 0.03 * float((high - low)[:2].max())
    step = (float(high[0] - low[0]) + 2.0 * room) / columns
    rows = int(np.ceil((float(high[1] - low[1]) + 2.0 * room) / step))
    corners = seen[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)  # real meshes have flipped faces; both sides catch the light
    light = np.clip(0.4 + 0.6 * normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.3, 1.0)
    pixels = corners.copy()
    pixels[..., :2] = (corners[..., :2] - low[:2] + room) / step - 0.5
    nearest = _paint(pixels, rows, columns)
    hit = nearest >= 0
    face = np.where(hit, nearest, 0)
    extent = (float(low[0] - room), float(high[0] + room), float(low[1] - room), float(low[1] - room + rows * step))
    return View(hit, face, np.where(hit, light[face], 1.0), extent)


@no_type_check  # run-time shape checks would wrap what numba compiles
@numba.njit(cache=True)
def _paint(pixels, rows, columns):
    """Index of the nearest triangle at each pixel's centre, or -1; depth is the third coordinate, larger is nearer."""
    depth = np.full((rows, columns), -np.inf)
    nearest = np.full((rows, columns), -1, np.int64)
    for f in range(len(pixels)):
        ax, ay, az = pixels[f, 0]
        bx, by, bz = pixels[f, 1]
        cx, cy, cz = pixels[f, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        first_row = max(0, int(np.ceil(min(ay, by, cy))))
        last_row = min(rows - 1, int(np.floor(max(ay, by, cy))))
        first_column = max(0, int(np.ceil(min(ax, bx, cx))))
        last_column = min(columns - 1, int(np.floor(max(ax, bx, cx))))
        for y in range(first_row, last_row + 1):
            for x in range(first_column, last_column + 1):
                u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                if u < -1e-9 or v < -1e-9 or u + v > 1.0 + 1e-9:
                    continue
                z = az + u * (bz - az) + v * (cz - az)
                if z > depth[y, x]:
                    depth[y, x] = z
                    nearest[y, x] = f
    return nearest

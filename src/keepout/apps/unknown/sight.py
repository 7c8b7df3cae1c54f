"""What a camera somewhere would open: rays over the whole sphere through the cells, and images made of them.

A ray goes on through unknown cells, with less confidence after each. What it opens is the volume it passes times the
worth of the cells times that confidence, so views that look through much unknown room are worth what they may show.
"""

import math
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from keepout.apps.led.camera import Pinhole

UP = np.array([0.0, 0.0, 1.0])
"""What the camera holds up in the image, in the map's frame."""


def sphere(count: int) -> Float[np.ndarray, "count 3"]:
    """Spread unit vectors evenly over the sphere, on a Fibonacci spiral."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = math.pi * (3.0 - math.sqrt(5.0)) * np.arange(count)
    around = np.sqrt(1.0 - height**2)
    return np.stack([around * np.cos(angle), around * np.sin(angle), height], axis=1)


def inside(
    camera: Pinhole, axes: Float[np.ndarray, "n 3 3"], rays: Float[np.ndarray, "m 3"], border: float
) -> Bool[np.ndarray, "n m"]:
    """Whether each ray lies in each image, `border` rad away from its edges."""
    seen = np.einsum("nij,mi->nmj", axes, rays)
    ahead = seen[..., 2] > 1e-6
    forward = np.where(ahead, seen[..., 2], 1.0)
    across = math.tan(max(math.atan(0.5 * camera.width / camera.focal) - border, 0.02))
    down = math.tan(max(math.atan(0.5 * camera.height / camera.focal) - border, 0.02))
    return ahead & (np.abs(seen[..., 0]) <= across * forward) & (np.abs(seen[..., 1]) <= down * forward)


def panoramas(
    codes: UInt8[np.ndarray, "nx ny nz"],
    worth: Float32[np.ndarray, "256"],
    passes: Float32[np.ndarray, "256"],
    places: Float[np.ndarray, "n 3"],
    rays: Float[np.ndarray, "m 3"],
    *,
    bins: Float[np.ndarray, " b"],
    farthest: float,
    empty: float,
) -> Float32[np.ndarray, "b n m"]:
    """Give the worth, in cells, that each ray from each place is expected to open. All lengths are in cells.

    Args:
        codes: kinds of cells; 0 is known free.
        worth: by code, of opening a cell.
        passes: by code, confidence left after a cell; 0 where a ray ends with a return, negative where nothing is hoped
            of what lies behind.
        places: in cells from the corner of the first.
        rays: unit vectors.
        bins: ranges at which the bins begin that what is opened is sorted into; cells nearer than the first are not.
        farthest: cells farther are not opened.
        empty: how far a ray without a return opens.

    """
    gains = np.zeros((len(bins), len(places), len(rays)), dtype=np.float32)
    solid = 4.0 * math.pi / len(rays)
    _march(codes, worth, passes, np.ascontiguousarray(places), rays, bins, farthest, empty, solid, gains)
    return gains


@numba.njit(cache=True, nogil=True)
@no_type_check
def _march(codes, worth, passes, places, rays, bins, farthest, empty, solid, gains):
    count = bins.shape[0]
    unsure = np.zeros(count, dtype=np.float32)
    nx, ny, nz = codes.shape
    steps = int(farthest)
    for p in range(places.shape[0]):
        for r in range(rays.shape[0]):
            x, y, z = places[p, 0], places[p, 1], places[p, 2]
            dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
            confidence = 1.0
            unsure[:] = 0.0  # opened only with a return
            returned = 0.0
            b = 0
            for step in range(1, steps + 1):
                i, j, k = int(x + step * dx), int(y + step * dy), int(z + step * dz)
                if x + step * dx < 0.0 or y + step * dy < 0.0 or z + step * dz < 0.0 or i >= nx or j >= ny or k >= nz:
                    break
                code = codes[i, j, k]
                if code == 0:
                    continue
                if passes[code] <= 0.0:
                    if passes[code] == 0.0:
                        returned += confidence
                    break
                if step >= bins[0]:
                    while b + 1 < count and step >= bins[b + 1]:
                        b += 1
                    volume = confidence * worth[code] * step * step
                    if step <= empty:
                        gains[b, p, r] += solid * volume
                    else:
                        unsure[b] += solid * volume
                returned += confidence * (1.0 - passes[code])
                confidence *= passes[code]
                if confidence < 0.02:
                    break
            for b in range(count):
                gains[b, p, r] += unsure[b] * min(returned, 1.0)


@numba.njit(cache=True, nogil=True)
@no_type_check
def first_closed(codes, place, rays, nearest, farthest, found):
    """Write into `found` (m, 3) the first cell not free on each ray within the ranges, -1 where there is none."""
    nx, ny, nz = codes.shape
    for r in range(rays.shape[0]):
        found[r, 0] = -1
        for step in range(1, int(farthest) + 1):
            x, y, z = place[0] + step * rays[r, 0], place[1] + step * rays[r, 1], place[2] + step * rays[r, 2]
            i, j, k = int(x), int(y), int(z)
            if x < 0.0 or y < 0.0 or z < 0.0 or i >= nx or j >= ny or k >= nz:
                break
            if codes[i, j, k] != 0:
                if step >= nearest:
                    found[r, 0], found[r, 1], found[r, 2] = i, j, k
                break

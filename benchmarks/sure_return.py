"""Whether what a map is proved from holds for a mesh and a view: does every part near enough surely return?

    python benchmarks/sure_return.py [TARGET ...] [--views N] [--json]

Counts the points of a target's surface for which the default sensor's promise fails, from places round it.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float
from kept_rows import command, tell

from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, first_returns
from keepout.core.geometry.level_set import random_directions
from keepout.core.geometry.target import Target

_WIDEST = 1.55
"""Angle from the boresight, rad, beyond which the whole image is looked at."""
_SEEN = 1e-7
"""Part of a distance by which a ray to a visible point may stop short of it."""


@dataclass(frozen=True, eq=False)
class SureReturn:
    """Points of a surface for which the assumption of sure return was looked at.

    Attributes:
        tested: points in the image, within the usable range.
        visible: of these, points that the straight line from the sensor reaches.
        violations: (m, 3) visible points for which it does not hold, m.
        hidden_violations: (k, 3) points behind others for which it does not hold, m.

    """

    tested: int
    visible: int
    violations: Float[np.ndarray, "m 3"]
    hidden_violations: Float[np.ndarray, "k 3"]


def sure_return_violations(
    camera: DepthCamera,
    first_hit: FirstHit,
    position: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    generator: np.random.Generator,
    *,
    samples: int = 20_000,
) -> SureReturn:
    """Look for points of the surface past which an image would see.

    For a point x at the distance D from the sensor, in the image and within the usable range, some ray must pass
    within w = `surely_returned_width` of x whose pixel says, without errors, at most D + w, or says nothing. Points are
    drawn evenly from the surface of the mesh; a measurement, which proves nothing of the points between them.

    Args:
        camera: the sensor; its dropout is left out.
        first_hit: the mesh.
        position: of the sensor, m.
        axes: the camera's axes as columns.
        generator: of random numbers.
        samples: points drawn on the whole mesh; those out of the image or range are not tested.

    """
    width = camera.bounds.surely_returned_width
    farthest = min(camera.bounds.usable_range(camera.camera), camera.bounds.greatest_range - width)
    points = _on_surface(first_hit, generator, samples)
    points = points[_in_image(camera, (points - position) @ axes, farthest)]
    nearest, _, lost = first_returns(camera, first_hit, position, axes)
    silent = lost | (nearest < camera.bounds.least_range)
    says = np.where(silent, -np.inf, nearest)
    held = np.empty(len(points), dtype=np.bool_)
    rays = camera.camera.directions(camera.bounds.rays_across)
    _returns(np.ascontiguousarray((points - position) @ axes), rays, says, camera.camera.focal, width, held)
    distance = np.linalg.norm(points - position, axis=1)
    visible = np.zeros(len(points), dtype=bool)
    if len(points):
        visible = first_hit.ranges(position[None], points - position) >= distance * (1.0 - _SEEN)
    return SureReturn(len(points), int(visible.sum()), points[visible & ~held], points[~visible & ~held])


def _on_surface(first_hit: FirstHit, generator: np.random.Generator, samples: int) -> Float[np.ndarray, "n 3"]:
    """Draw points evenly from the surface."""
    corners = first_hit.vertices[first_hit.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[generator.choice(len(corners), samples, p=areas / areas.sum())]
    root, share = np.sqrt(generator.random((samples, 1))), generator.random((samples, 1))
    return (1.0 - root) * chosen[:, 0] + root * (1.0 - share) * chosen[:, 1] + root * share * chosen[:, 2]


def _in_image(camera: DepthCamera, points: Float[np.ndarray, "n 3"], farthest: float) -> Bool[np.ndarray, " n"]:
    """Say which points in camera axes are in the image and within a range."""
    x, y, z = points.T
    half = 0.5 / camera.camera.focal
    inside = (z > 0.0) & (np.abs(x) <= half * camera.camera.width * z) & (np.abs(y) <= half * camera.camera.height * z)
    return inside & (np.linalg.norm(points, axis=1) <= farthest)


@numba.njit(cache=True)
def _returns(points, rays, says, focal, width, held):
    """Say for points in camera axes whether some ray within `width` of each has a pixel that says at most D + w."""
    rows, columns = rays.shape[0], rays.shape[1]
    across = rows // says.shape[0]
    pitch = 1.0 / (focal * across)
    for i in range(len(points)):
        x, y, z = points[i]
        D = math.sqrt(x * x + y * y + z * z)
        # Rays within an angle of one at `off` from the boresight are, in the plane z = 1, within `reach` of it.
        off, angle = math.acos(min(z / D, 1.0)), math.asin(min(width / D, 1.0))
        reach = math.inf if off + angle >= _WIDEST else math.tan(off + angle) - math.tan(off)
        row, column = y / z / pitch + 0.5 * rows, x / z / pitch + 0.5 * columns
        steps = min(reach / pitch + 1.0, float(rows + columns))
        held[i] = False
        for r in range(max(int(row - steps), 0), min(int(row + steps) + 1, rows)):
            for c in range(max(int(column - steps), 0), min(int(column + steps) + 1, columns)):
                if says[r // across, c // across] > D + width:
                    continue
                along = x * rays[r, c, 0] + y * rays[r, c, 1] + z * rays[r, c, 2]
                if along > 0.0 and D * D - along * along <= width * width:
                    held[i] = True
                    break
            if held[i]:
                break


def row(name: str, views: int) -> dict:
    """Count over views from one to five metres outside the ball round a target, towards its middle."""
    target, camera, generator = Target.load(name), DepthCamera(), np.random.default_rng(0)
    first_hit = FirstHit(target.vertices, target.faces)
    middle = 0.5 * (first_hit.lower + first_hit.upper)
    radius = 0.5 * float(np.linalg.norm(first_hit.upper - first_hit.lower))
    found = []
    for way in random_directions(generator, views):
        place = middle + (radius + generator.uniform(1.0, 5.0)) * way
        axes = axes_towards(-way, np.array([0.0, 0.0, 1.0]))
        found.append(sure_return_violations(camera, first_hit, place, axes, generator))
    return {
        "target": target.name,
        "tested": sum(one.tested for one in found),
        "visible": sum(one.visible for one in found),
        "violations": sum(len(one.violations) for one in found),
        "hidden_violations": sum(len(one.hidden_violations) for one in found),
    }


def main():
    parser = command(__doc__)
    parser.add_argument("targets", nargs="*", default=["intelsat30"])
    parser.add_argument("--views", type=int, default=20)
    arguments = parser.parse_args()
    rows = [row(name, arguments.views) for name in arguments.targets]
    tell(rows, arguments)


if __name__ == "__main__":
    main()

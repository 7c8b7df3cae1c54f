"""Milliseconds of a picture of a contact sheet: with depth, lit from the camera, lit by the sun with all shadows.

A row a target: cameras round it look at its middle; medians over the pictures, one thread. Beside it the share of
pixels whose depth is that at which an exact ray through their middle meets the mesh, to a millionth.

    python benchmarks/inspection_pictures.py
    python benchmarks/inspection_pictures.py --pixels 512 --meshes FOLDER --json
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from kept_rows import command, tell, timed, with_meshes

from keepout.apps.inspection.inspection_pictures import Studio
from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.core.geometry.target import Target

SHIPPED = ("intelsat30", "tiangong", "iss")
SUN = np.array([0.48, -0.6, 0.64])
UP = np.array([0.0, 0.0, 1.0])


def row(source: str, pixels: int, pictures: int) -> dict[str, Any]:
    """Take pictures of one target from random places round it."""
    target = Target.load(source, units="m" if "/" in source else None)
    studio = Studio(target.vertices[target.faces])
    first_hit = FirstHit(target.vertices, target.faces)
    middle = 0.5 * (target.distance.lower + target.distance.upper)
    far = 0.6 * float(np.linalg.norm(target.distance.upper - target.distance.lower))
    camera, rng = Pinhole(pixels, pixels, math.radians(60.0)), np.random.default_rng(0)
    taken, headlight, sunlight, same = [], [], [], []
    for _ in range(pictures):
        direction = rng.normal(size=3)
        position = middle + far * direction / np.linalg.norm(direction)
        axes = axes_towards(middle - position, UP)
        picture, seconds = timed(studio.take, camera, position, axes)
        taken.append(1e3 * seconds)
        headlight.append(1e3 * timed(studio.light, picture)[1])
        sunlight.append(1e3 * timed(studio.light, picture, SUN)[1])
        rays = camera.directions().reshape(-1, 3)
        ranges, _ = first_hit.cast(position[None], rays @ axes.T)
        depth = (ranges * rays[:, 2]).reshape(camera.shape)
        close = np.isclose(depth, picture.depth, rtol=1e-6, atol=1e-6)
        same.append(np.mean(close))
    return {
        "target": Path(source).name,
        "triangles": len(target.faces),
        "pixels": pixels**2,
        "picture_ms": round(float(np.median(taken)), 1),
        "picture_ms_most": round(max(taken), 1),
        "headlight_ms": round(float(np.median(headlight)), 1),
        "sunlight_ms": round(float(np.median(sunlight)), 1),
        "as_rays_say": round(float(np.mean(same)), 6),
    }


def main() -> None:
    """Print a row a target."""
    parser = command(__doc__)
    parser.add_argument("--meshes", type=Path, help="folder of GLB and OBJ files in metres, beside the shipped targets")
    parser.add_argument("--pixels", type=int, default=400, help="across a picture")
    parser.add_argument("--pictures", type=int, default=20)
    arguments = parser.parse_args()
    row("box", 64, 1)  # compiles
    sources = with_meshes(SHIPPED, arguments.meshes)
    tell([row(source, arguments.pixels, arguments.pictures) for source in sources], arguments)


if __name__ == "__main__":
    main()

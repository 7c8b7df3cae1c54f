"""Milliseconds of a picture of a contact sheet: with depth, lit from the camera, lit by the sun with all shadows.

A row a target: cameras round it look at its middle; medians over the pictures, one thread. Beside it the share of
pixels whose depth is that at which an exact ray through their middle meets the mesh, to a millionth.

    python benchmarks/inspection_pictures.py
    python benchmarks/inspection_pictures.py --pixels 512 --meshes FOLDER --json
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from keepout.apps.inspection.perspective import Studio
from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.core.geometry.first_hit import FirstHit
from keepout.core.geometry.target import Target

SHIPPED = ("intelsat30", "tiangong", "iss")
SUN = np.array([0.48, -0.6, 0.64])
UP = np.array([0.0, 0.0, 1.0])


def timed(task: Callable[[], Any]) -> tuple[float, Any]:
    """Run a task; give the milliseconds that it took, and its answer."""
    begin = time.perf_counter()
    answer = task()
    return 1e3 * (time.perf_counter() - begin), answer


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
        milliseconds, picture = timed(lambda p=position, a=axes: studio.take(camera, p, a))
        taken.append(milliseconds)
        headlight.append(timed(lambda s=picture: studio.light(s))[0])
        sunlight.append(timed(lambda s=picture: studio.light(s, SUN))[0])
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=Path, help="folder of GLB and OBJ files in metres, beside the shipped targets")
    parser.add_argument("--pixels", type=int, default=400, help="across a picture")
    parser.add_argument("--pictures", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    sources = list(SHIPPED)
    if arguments.meshes:
        sources += sorted(str(path) for path in arguments.meshes.iterdir() if path.suffix in (".glb", ".obj"))
    row("box", 64, 1)  # compiles
    rows = [row(source, arguments.pixels, arguments.pictures) for source in sources]
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    print("| " + " | ".join(rows[0]) + " |")
    print("|" + "---|" * len(rows[0]))
    for each in rows:
        print("| " + " | ".join(str(value) for value in each.values()) + " |")


if __name__ == "__main__":
    main()

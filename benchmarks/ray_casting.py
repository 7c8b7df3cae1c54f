"""Time of rays against meshes, for images of a depth sensor, beside Embree and brute force in the same run.

    python benchmarks/ray_casting.py [--meshes DIRECTORY] [--views N] [--json]

One thread. Each view is one of the sensor's default images (160 x 120 pixels of 3 x 3 rays, 60 degrees) from 2 to 8 m
beyond the ball around the mesh or beside its surface, towards it. `embree` is that of libigl (single precision), one
call a ray, so that the calls are in its time; `brute_force` tests all triangles with NumPy. Both are given a few rays
of the same images. `take_ms` is a whole image with errors.
"""

import functools
import time
from pathlib import Path
from typing import Any

import igl.embree
import kept_rows
import numpy as np
from kept_rows import command, tell, with_meshes

from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.depth_sensor import DepthCamera, take
from keepout.core.geometry.target import Target

# Aura's file has no real unit (deployed length 17.37 m); Itokawa's is normalised, and is shown at 20 m.
SCALES = {"aura_arbitrary_units": 0.342, "itokawa": 20.0}
SHIPPED = ("intelsat30", "iss", "tiangong")
UP = np.array([0.0, 0.0, 1.0])
Rays = tuple[np.ndarray, np.ndarray]


timed = functools.partial(kept_rows.timed, clock=time.process_time)


def places(target: Target, first_hit: FirstHit, views: int) -> list[Rays]:
    """Sensor's place and axes of each view: every second one from outside, the others 1 to 5 m from the surface."""
    generator = np.random.default_rng(0)
    middle = 0.5 * (first_hit.lower + first_hit.upper)
    radius = 0.5 * float(np.linalg.norm(first_hit.upper - first_hit.lower))
    chosen = []
    while len(chosen) < views:
        direction = generator.normal(size=3)
        direction /= np.linalg.norm(direction)
        if len(chosen) % 2 == 0:
            place = middle + (radius + generator.uniform(2.0, 8.0)) * direction
            chosen.append((place, axes_towards(middle - place, UP)))
            continue
        place = middle + radius * generator.uniform(0.0, 1.0) * direction
        distance, nearest, _ = target.distance.closest(place[None])
        if 1.0 < distance[0] < 5.0:
            chosen.append((place, axes_towards(nearest[0] - place, UP)))
    return chosen


def by_brute_force(triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Möller and Trumbore's test of every triangle, vectorised over triangles."""
    a, e, f = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    ranges = np.empty(len(origins))
    for i, (o, d) in enumerate(zip(origins, directions)):
        across = np.cross(d, f)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / (e * across).sum(1)
            turned = np.cross(o - a, e)
            u, v, t = ((o - a) * across).sum(1) * inverse, turned @ d * inverse, (f * turned).sum(1) * inverse
        ranges[i] = t[(u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0)].min(initial=np.inf)
    return ranges


def by_embree(embree: igl.embree.EmbreeIntersector, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Embree's first hits, a call each."""
    hits = [embree.intersectRay_first(origin, direction) for direction in directions]
    return np.array([hit[1] if hit[0] >= 0 else np.inf for hit in hits])


def row(source: str, views: int) -> dict[str, Any]:
    name = Path(source).stem
    target = Target.load(source, scale=SCALES.get(name))
    first_hit = FirstHit(target.vertices, target.faces)
    triangles, camera = first_hit.vertices[first_hit.faces], DepthCamera()
    rays = camera.camera.directions(camera.bounds.rays_across).reshape(-1, 3)
    _, build = timed(first_hit.ranges, np.zeros((1, 3)), rays[:1])
    embree = igl.embree.EmbreeIntersector()
    embree.init(np.asfortranarray(target.vertices.astype(np.float32)), np.asfortranarray(target.faces.astype(np.int32)))
    generator = np.random.default_rng(1)
    ours, theirs, brute, whole, met, agree = [], [], [], [], [], []
    for place, axes in places(target, first_hit, views):
        directions = rays @ axes.T
        ranges, seconds = timed(first_hit.ranges, place[None], directions)
        ours.append(1e6 * seconds / len(rays))
        met.append(float(np.isfinite(ranges).mean()))
        whole.append(1e3 * timed(take, camera, first_hit, place, axes, generator)[1])
        part = slice(None, None, 37)
        single, origin = directions[part].astype(np.float32), place.astype(np.float32)
        told, seconds = timed(by_embree, embree, origin, single)
        theirs.append(1e6 * seconds / len(single))
        agree.append(float(np.isclose(ranges[part], told, rtol=0.0, atol=1e-3).mean()))
        few = generator.choice(len(rays), 20, replace=False)
        origins = np.broadcast_to(place, (20, 3))
        truth, seconds = timed(by_brute_force, triangles, origins, directions[few])
        brute.append(1e6 * seconds / 20)
        agree.append(float(np.isclose(ranges[few], truth, rtol=0.0, atol=1e-9).mean()))
    us, embree_us, brute_us = (float(np.median(each)) for each in (ours, theirs, brute))
    return {
        "mesh": Path(source).name,
        "triangles": len(target.faces),
        "views": views,
        "build_s": round(build, 4),
        "us_per_ray": round(us, 4),
        "us_per_ray_most": round(max(ours), 4),
        "met": round(float(np.mean(met)), 3),
        "embree_us_per_ray": round(embree_us, 3),
        "times_embree": round(embree_us / us, 2),
        "brute_force_us_per_ray": round(brute_us, 1),
        "times_brute_force": round(brute_us / us, 0),
        "agree": round(float(np.mean(agree)), 5),
        "take_ms": round(float(np.median(whole)), 1),
    }


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--meshes", type=Path, help="folder of GLB and OBJ files, beside the shipped targets")
    parser.add_argument("--views", type=int, default=20)
    arguments = parser.parse_args()
    row("box", 1)  # compiles
    tell([row(source, arguments.views) for source in with_meshes(SHIPPED, arguments.meshes)], arguments)


if __name__ == "__main__":
    main()

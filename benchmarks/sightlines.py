"""Pyramids from places to patches: pairs a second on one core, and how often rays alone would be wrong.

    python benchmarks/sightlines.py [--meshes DIRECTORY] [--places N] [--json]

One thread. Places lie 1.5 to 6 m from the mesh (processor time; median over the places). Pairs are a place and a unit
that keeps range (10 m; ISS 20 m) and incidence (60 degrees) from it.

`one_ray_wrong` is the share, of the pairs that a ray to the patch's centre calls seen, in which some other ray is
blocked; `seven_rays_wrong` the same with the centre and six points of the border. Truth there is several hundred rays
to each patch, by `FirstHit`, which shares no code with the pyramids. `refused_though_rays_pass` is the share of pairs
that are called blocked and of which none of those rays is. `too_careful` counts those of them that rational arithmetic
finds clear; the others are blocked between the rays. `clear_though_a_ray_is_blocked` must be 0, and so must
`clear_though_not_exactly`, of 30 clear pairs that rational arithmetic looks at. `bisected` counts the pieces of
triangles halved across their longest edge until none is longer than the patch size.
"""

import math
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from kept_rows import command, tell

from keepout.apps.inspection.seeing.patches import Patches, cut
from keepout.apps.inspection.seeing.sightlines import LIFT, Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules, lit_units, within_rules
from keepout.apps.led.first_hit import FirstHit
from keepout.core.geometry.target import Target

Point = list[Fraction]
SHIPPED = ("intelsat30", "tiangong", "iss")
FILES = ("ssl1300", "hubble")
SIDE, BORDER = 13, 12
"""Rays to a patch: a lattice of SIDE² points over each wedge of it, and points of each border."""


def places_around(target: Target, count: int) -> np.ndarray:
    """Places 1.5 to 6 m from the mesh."""
    generator = np.random.default_rng(0)
    used = target.vertices[target.faces]
    low, high = used.min(axis=(0, 1)) - 6.0, used.max(axis=(0, 1)) + 6.0
    chosen = np.empty((0, 3))
    while len(chosen) < count:
        some = generator.uniform(low, high, size=(1000, 3))
        distance = target.distance.distance(some)
        chosen = np.concatenate([chosen, some[(distance > 1.5) & (distance < 6.0)]])
    return chosen[:count]


def points_of(patches: Patches, patch: int) -> np.ndarray:
    """Give the centre, six points of the border, and then many: of the border, a thousandth inwards, and inside."""
    count = patches.counts[patch]
    corners, centre = patches.corners[patch, :count], patches.centres[patch]
    following = np.roll(corners, -1, axis=0)
    lengths = np.linalg.norm(following - corners, axis=1)
    places = (np.arange(6) + 0.5) / 6.0 * lengths.sum()
    ends = np.cumsum(lengths)
    edge = np.minimum(np.searchsorted(ends, places), count - 1)
    share = 1.0 - (ends[edge] - places) / lengths[edge]
    six = corners[edge] + share[:, None] * (following[edge] - corners[edge])
    steps = (np.arange(BORDER) / BORDER)[:, None, None]
    border = (corners + steps * (following - corners)).reshape(-1, 3)
    u, v = np.meshgrid((np.arange(SIDE) + 0.5) / SIDE, (np.arange(SIDE) + 0.5) / SIDE)
    u, v = u[u + v < 1.0], v[u + v < 1.0]
    inside = [centre + u[:, None] * (a - centre) + v[:, None] * (b - centre) for a, b in zip(corners, following)]
    return np.concatenate([centre[None], six, 0.999 * border + 0.001 * centre, *inside])


def blocked_rays(patches: Patches, first_hit: FirstHit, place: np.ndarray, unit: int) -> np.ndarray:
    """Whether each ray to a unit is blocked, farther than LIFT above its plane."""
    points = points_of(patches, unit // 2)
    ways = points - place
    lengths = np.linalg.norm(ways, axis=1)
    steep = -(ways @ patches.unit_normals()[unit])
    return first_hit.ranges(place[None], ways) < lengths * (1.0 - LIFT / steep)


def kept(polygon: list[Point], normal: Point, level: Fraction) -> list[Point]:
    """Give the part of a convex polygon where normal . x >= level."""
    values, out = [dot(normal, x) - level for x in polygon], []
    for i, (here, a) in enumerate(zip(polygon, values)):
        there, b = polygon[(i + 1) % len(polygon)], values[(i + 1) % len(polygon)]
        if a >= 0:
            out.append(here)
        if a * b < 0:
            out.append([x + a / (a - b) * (y - x) for x, y in zip(here, there)])
    return out


def exactly_clear(patches: Patches, triangles: np.ndarray, place: np.ndarray, unit: int) -> bool:
    """Whether no triangle has a point in the pyramid, LIFT above the unit to LIFT below the place: without rounding."""
    corners = patches.corners[unit // 2, : patches.counts[unit // 2]]
    corners = corners[::-1] if unit % 2 else corners
    hull = np.concatenate([corners, place[None]])
    near = (triangles.max(axis=1) >= hull.min(axis=0)).all(axis=1) & (triangles.min(axis=1) <= hull.max(axis=0)).all(
        axis=1
    )
    eye, normal = exact(place), exact(patches.unit_normals()[unit])
    polygon = [exact(corner) for corner in corners]
    base, lift = max(dot(normal, corner) for corner in polygon), Fraction(LIFT)
    down = [-x for x in normal]
    sides = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1]):
        (gx, gy, gz), (ex, ey, ez) = ([x - y for x, y in zip(one, a)] for one in (eye, b))
        sides.append([gy * ez - gz * ey, gz * ex - gx * ez, gx * ey - gy * ex])
    for triangle in triangles[near]:
        part = kept([exact(corner) for corner in triangle], normal, base + lift)
        part = part and kept(part, down, lift - dot(normal, eye))
        for side in sides:
            part = part and kept(part, side, dot(side, eye))
        if part:
            return False
    return True


def exact(point: np.ndarray) -> Point:
    """Give coordinates as the fractions that they are."""
    return [Fraction(float(x)) for x in point]


def dot(a: Point, b: Point) -> Fraction:
    """Give the scalar product."""
    return sum((x * y for x, y in zip(a, b)), Fraction(0))


def bisected(target: Target, size: float) -> int:
    """Pieces of triangles halved across their longest edge until none is longer than `size`."""
    triangles, pieces = target.vertices[target.faces], 0
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        small = edges.max(axis=1) <= size
        pieces += int(small.sum())
        triangles, longest = triangles[~small], edges[~small].argmax(axis=1)
        rows = np.arange(len(triangles))
        a, b, c = (triangles[rows, (longest + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return pieces


def row(source: str, count: int, size: float, looked_at: int) -> dict[str, Any]:
    """All figures of one mesh."""
    target = Target.load(source, units="m") if source.endswith(".glb") else Target.load(source)
    cut(Target.load("box"), 1.0)  # compiles
    start = time.process_time()
    patches = cut(target, size)
    cut_s = time.process_time() - start
    sight = Sightlines(target.vertices, target.faces, patches)
    first_hit = FirstHit(target.vertices, target.faces)
    rules = SeeingRules(greatest_range=20.0 if "iss" in source else 10.0)
    generator = np.random.default_rng(1)
    rates, clear_share, pairs, sun_rates = [], [], [], []
    for place in places_around(target, count):
        units = within_rules(patches, rules, place).units
        if len(units) < 50:
            continue
        sight.clear(place[None], units[:1])
        start = time.process_time()
        clear = sight.clear(place[None], units)
        rates.append(len(units) / (time.process_time() - start))
        clear_share.append(float(clear.mean()))
        some = generator.choice(len(units), min(len(units), looked_at), replace=False)
        pairs += [(place, int(units[k]), bool(clear[k])) for k in some]
    for _ in range(5):
        sun = generator.normal(size=3)
        sun /= np.linalg.norm(sun)
        asked = int((np.abs(patches.normals @ sun) >= math.cos(rules.greatest_sun_incidence)).sum())
        lit_units(sight, rules, sun)
        start = time.process_time()
        lit_units(sight, rules, sun)
        sun_rates.append(asked / (time.process_time() - start))
    rays = [blocked_rays(patches, first_hit, place, unit) for place, unit, _ in pairs]
    clear = np.array([says for _, _, says in pairs])
    one, seven = np.array([not r[0] for r in rays]), np.array([not r[:7].any() for r in rays])
    some_ray = np.array([bool(r.any()) for r in rays])
    doubtful = [(place, unit) for (place, unit, says), ray in zip(pairs, some_ray) if not (says or ray)]
    sure = [(place, unit) for place, unit, says in pairs if says][:: max(int(clear.sum()) // 30, 1)][:30]
    triangles = target.vertices[target.faces]
    return {
        "mesh": Path(source).name,
        "triangles": len(target.faces),
        "size_m": size,
        "patches": len(patches.areas),
        "bisected": bisected(target, size),
        "units_counted": int(patches.counted.sum()),
        "cut_s": round(cut_s, 3),
        "places": len(rates),
        "pairs_per_s": round(float(np.median(rates)), -3),
        "pairs_per_s_least": round(float(min(rates)), -3),
        "sun_pairs_per_s": round(float(np.median(sun_rates)), -3),
        "clear": round(float(np.mean(clear_share)), 3),
        "pairs_looked_at": len(pairs),
        "one_ray_wrong": round(float((some_ray & one).sum() / max(one.sum(), 1)), 4),
        "seven_rays_wrong": round(float((some_ray & seven).sum() / max(seven.sum(), 1)), 4),
        "refused_though_rays_pass": round(float((~clear & ~some_ray).mean()), 5),
        "too_careful": sum(exactly_clear(patches, triangles, place, unit) for place, unit in doubtful),
        "clear_though_a_ray_is_blocked": int((clear & some_ray).sum()),
        "clear_though_not_exactly": sum(not exactly_clear(patches, triangles, place, unit) for place, unit in sure),
    }


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--meshes", type=Path, help="folder with ssl1300.glb and hubble.glb")
    parser.add_argument("--places", type=int, default=60)
    parser.add_argument("--pairs", type=int, default=100, help="pairs of a place that rays are cast for")
    given = parser.parse_args()
    sources = list(SHIPPED)
    if given.meshes is not None:
        sources += [str(given.meshes / f"{name}.glb") for name in FILES]
    rows = [row(source, given.places, 1.0 if source == "iss" else 0.25, given.pairs) for source in sources]
    tell(rows, given)


if __name__ == "__main__":
    main()

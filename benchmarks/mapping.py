"""What a view costs the map: freeing cubes, and the distances made anew; each against plain NumPy in the same run.

    python benchmarks/mapping.py [--radius R] [--views N] [--width W] [--json]

The target is two balls and a plate in a declared ball; views of 160 x 120 pixels and 60 degrees are taken from places
outside the ball and then, as the map opens, from known-free places inside it. NumPy answers the same question: the rule
with the same windows for every cube within range that is not free, in whole arrays, and the capped transform of the
whole grid. `same` says that both gave the same bits in every view that NumPy repeated.
"""

import math
from typing import Any

import numpy as np
from kept_rows import command, tell, timed

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.distance_transform import renew
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.rule import BLOCK, SLACK, empty_ranges, free_cubes, pyramid, rule_of
from keepout.apps.unknown.view import SensorBounds, View

CAMERA = Pinhole(160, 120, math.radians(60.0))
BALLS = (((0.0, 0.0, 0.0), 2.0), ((0.0, 5.0, 1.0), 1.2))
PLATE = ((-6.0, -0.3, -2.0), (6.0, -0.2, 2.0))


def ranges_from(position: np.ndarray, axes: np.ndarray, bounds: SensorBounds) -> np.ndarray:
    """First return of each pixel's rays in closed form."""
    rays = CAMERA.directions(bounds.rays_across) @ axes.T
    found = np.full(rays.shape[:2], np.inf)
    for centre, radius in BALLS:
        offset = position - np.array(centre)
        along = rays @ offset
        inside = along**2 - (offset @ offset - radius**2)
        near = -along - np.sqrt(np.maximum(inside, 0.0))
        found = np.where((inside >= 0.0) & (near > 0.0), np.minimum(found, near), found)
    with np.errstate(divide="ignore"):
        one, two = (np.array(PLATE[0]) - position) / rays, (np.array(PLATE[1]) - position) / rays
    near, far = np.minimum(one, two).max(axis=2), np.maximum(one, two).min(axis=2)
    found = np.where((near <= far) & (near > 0.0), np.minimum(found, near), found)
    found = np.where(found > bounds.greatest_range, np.inf, found)
    across = bounds.rays_across
    return found.reshape(CAMERA.height, across, CAMERA.width, across).min(axis=(1, 3))


def view_towards(position: np.ndarray, aim: np.ndarray, bounds: SensorBounds) -> View:
    ahead = (aim - position) / np.linalg.norm(aim - position)
    right = np.cross(ahead, [0.3, 0.2, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return View(CAMERA, position, axes, ranges_from(position, axes, bounds))


def freed_by_numpy(known: KnownFreeMap, view: View) -> np.ndarray:
    """Give the cubes that the rule frees, by whole arrays: box of the range, windows, tables of least values."""
    rule, bounds = rule_of(view, known.bounds, known.spacing), known.bounds
    low = np.clip(np.floor((view.position - rule.farthest - known.origin) / known.spacing), 0, len(known.free))
    high = np.clip(np.ceil((view.position + rule.farthest - known.origin) / known.spacing), 0, len(known.free))
    low, high = low.astype(int), high.astype(int)
    cubes = np.argwhere(~known.free[low[0] : high[0], low[1] : high[1], low[2] : high[2]]) + low
    offset = known.origin + known.spacing * (cubes + 0.5) - view.position
    distance = np.sqrt((offset**2).sum(axis=1))
    x, y, z = (offset @ view.axes).T
    radius = rule.clearance + distance * bounds.attitude_error
    fits = (z > radius) & (distance >= rule.nearest) & (distance <= rule.farthest)
    cubes, x, y, z, radius, distance = (array[fits] for array in (cubes, x, y, z, radius, distance))
    sides = []
    for across, middle in ((y, 0.5 * CAMERA.height), (x, 0.5 * CAMERA.width)):
        below = z * z - radius * radius
        spread = radius * np.sqrt(across * across + below)
        sides.append(CAMERA.focal * (across * z - spread) / below + middle - SLACK)
        sides.append(CAMERA.focal * (across * z + spread) / below + middle + SLACK)
    top, bottom, left, right = sides
    inside = (top >= 0) & (left >= 0) & (bottom <= CAMERA.height) & (right <= CAMERA.width)
    cubes, limit = cubes[inside], (distance + rule.clearance)[inside]
    top, left = (np.floor(side[inside]).astype(int) for side in (top, left))
    bottom = np.minimum(np.floor(bottom[inside]).astype(int), CAMERA.height - 1)
    right = np.minimum(np.floor(right[inside]).astype(int), CAMERA.width - 1)
    least = pyramid(empty_ranges(view, bounds))
    short = np.minimum(bottom - top, right - left) + 1
    level = np.floor(np.log2(short)).astype(int)
    side = 2**level
    found = np.full(len(cubes), np.inf)
    for a in range(int(np.max((bottom - top) // side, initial=0)) + 1):
        for b in range(int(np.max((right - left) // side, initial=0)) + 1):
            row = np.minimum(top + a * side, bottom - side + 1)
            column = np.minimum(left + b * side, right - side + 1)
            found = np.minimum(found, least[level, row, column])
    return cubes[found > limit]


def squares_by_numpy(free: np.ndarray, cap: int) -> np.ndarray:
    """Give the capped transform of the whole grid: the least over shifts along each axis."""
    nodes = len(free) + 1
    squares = np.full((nodes, nodes, nodes), cap * cap, dtype=np.uint16)
    for a in (0, 1):
        for b in (0, 1):
            for c in (0, 1):
                part = squares[a : nodes - 1 + a, b : nodes - 1 + b, c : nodes - 1 + c]
                part[~free] = 0
    for axis in range(3):
        before = squares.copy()
        for shift in range(1, cap):
            head = tuple(slice(shift, None) if other == axis else slice(None) for other in range(3))
            tail = tuple(slice(None, -shift) if other == axis else slice(None) for other in range(3))
            np.minimum(squares[head], before[tail] + np.uint16(shift * shift), out=squares[head])
            np.minimum(squares[tail], before[head] + np.uint16(shift * shift), out=squares[tail])
    return squares


def measure(radius: float, views: int, width: float, repeated: int) -> dict[str, Any]:
    """Time views of one map; NumPy repeats every so manieth."""
    bounds = SensorBounds(surely_returned_width=width)
    known = KnownFreeMap.begin(np.zeros(3), radius, bounds=bounds, name="benchmark")
    generator = np.random.default_rng(0)
    freeing, renewing, seeing, opened_by_view = [], [], [], []
    numpy_freeing, numpy_renewing, same = [], [], True
    number = 0
    while number < views:
        place = generator.normal(size=3)
        place *= generator.uniform(radius + 0.5, radius + 2.0) / np.linalg.norm(place)
        if number >= views // 2:  # from inside, where the map lets a sensor be
            place *= generator.uniform(0.4, 0.9)
            if not known.is_free(place[None])[0]:
                continue
        view = view_towards(place, generator.uniform(-3.0, 3.0, 3), bounds)
        judged = number % max(views // repeated, 1) == 0
        before = known.free.copy() if judged else None
        if judged:
            freed, seconds = timed(freed_by_numpy, known, view)
            numpy_freeing.append(seconds)
        # The two parts on their own, on copies, then the whole on the map.
        rule, empty = rule_of(view, bounds, known.spacing), empty_ranges(view, bounds)
        free, unknown, squares = known.free.copy(), known._unknown.copy(), known.squares.copy()
        changed = np.zeros(unknown.shape, dtype=np.bool_)

        def open_cubes(free=free, unknown=unknown, changed=changed, rule=rule, empty=empty, view=view):
            blocks = known.blocks_in_view(view, rule.farthest)
            return free_cubes(rule, pyramid(empty), known.origin, known.spacing, *blocks, free, unknown, changed)

        opened, seconds = timed(open_cubes)
        freeing.append(seconds)
        renewing.append(timed(renew, free, squares, known.cap_cells, changed, BLOCK)[1])
        report, seconds = timed(known.see, view)
        assert report.status is ViewStatus.SEEN
        assert report.opened == opened
        seeing.append(seconds)
        opened_by_view.append(opened)
        if before is not None:
            before[tuple(freed.T)] = True
            whole, seconds = timed(squares_by_numpy, known.free, known.cap_cells)
            numpy_renewing.append(seconds)
            same &= bool((before == known.free).all() and (whole == known.squares).all())
        number += 1
    # What was compiled or read from the disk in the first view is no view's cost.
    freeing, renewing, seeing = (np.array(times[1:]) for times in (freeing, renewing, seeing))
    return {
        "cubes_across": len(known.free),
        "usable_range_m": bounds.usable_range(CAMERA),
        "views": views,
        "opened_median": float(np.median(opened_by_view)),
        "free_ms": 1e3 * float(np.median(freeing)),
        "free_ms_most": 1e3 * float(freeing.max()),
        "free_ratio": float(np.median(numpy_freeing) / np.median(freeing)),
        "transform_ms": 1e3 * float(np.median(renewing)),
        "transform_ms_most": 1e3 * float(renewing.max()),
        "transform_ratio": float(np.median(numpy_renewing) / np.median(renewing)),
        "see_ms": 1e3 * float(np.median(seeing)),
        "see_ms_most": 1e3 * float(seeing.max()),
        "same": same,
        "map_mb": (known.free.nbytes + known.squares.nbytes + known.returned.keys.nbytes) / 1e6,
    }


def main() -> None:
    parser = command(__doc__)
    parser.add_argument(
        "--radius", type=float, default=14.5, help="of the declared ball, m; 14.5 gives 320 cubes across"
    )
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--width", type=float, nargs="+", default=[0.05, 0.075], help="surely returned widths, m")
    parser.add_argument("--repeated", type=int, default=6, help="views that NumPy repeats")
    arguments = parser.parse_args()
    rows = [measure(arguments.radius, arguments.views, width, arguments.repeated) for width in arguments.width]
    tell(rows, arguments)


if __name__ == "__main__":
    main()

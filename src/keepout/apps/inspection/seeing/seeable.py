"""What of a mesh can be seen at all: each unit has a witness, a proof that no place of the room sees it, or neither."""

import collections
import enum
import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from keepout.apps.inspection.seeing import sightlines
from keepout.apps.inspection.seeing.patches import Marks, Patches
from keepout.apps.inspection.seeing.polygons import hull_of, sort_points
from keepout.apps.inspection.seeing.room import Limits, Room, beam_workspace, first_place, least_height, place_of
from keepout.apps.inspection.seeing.sightlines import LIFT, Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.apps.led.camera import axes_across
from keepout.apps.led.first_hit import RayTree
from keepout.core.cores import kernel
from keepout.core.geometry.distance import DEEPEST
from keepout.core.progress import Progress, silent

SQUARES = 4_000_000
"""Of directions looked at in all, unless told otherwise."""
_SQUARES = (300, 3_000, 30_000)
"""Squares of directions a unit in each stage: most are decided in the first, and the next takes what is left."""
_TOGETHER = (512, 64, 8)
"""Units between two looks at what was spent."""
_RAYS = 1000
"""Over the half sphere of directions: a unit is called enclosed if all of them meet the mesh."""
SEEN, NONE, OPEN = 0, 1, 2
"""What a search ends with: a place, the proof that there is none, or neither."""
_SHADOWS = 96
"""Shadows that are tried before a ray is sent."""
_SMALLEST = 1e-9
"""Half the side of a square of directions that is not split further."""
MOST_EDGES = 48
"""Of a shadow: a triangle cut by two planes has 5 corners, a patch 8."""
_ROUNDING = 16 * np.finfo(np.float64).eps
"""Part of the largest coordinate by which rounding moves a point in the patch's axes: more than it does."""
FAR, _STEEP = 0.97, 0.97
"""Of the greatest range and incidence, the most that places are drawn at: a patch has an extent."""
_DRAWN = 64
"""Places drawn for a unit that is seen from where more than the mesh is too near."""
_SAME = 1e-9
"""Points of a shadow nearer to each other than this part of their size are taken as one."""


class Verdict(enum.IntEnum):
    """What is known of a unit."""

    SEEABLE = 0
    """A place in the room allowed is known from which it is wholly seen."""
    HIDDEN = 1
    """Proved: from no place in the room allowed."""
    UNDECIDED = 2
    """Neither a place was found nor a proof."""


class Hidden(enum.IntEnum):
    """Why a unit that is proved hidden is so, for people: measured by rays from its middle, not proved."""

    NOT = 0
    """It is seeable, or not decided."""
    ENCLOSED = 1
    """Each of many rays over its side meets the mesh."""
    NARROW = 2
    """Some of them gets out: incidence, range, stand-off or the width of what is open forbid it."""


@dataclass(frozen=True, eq=False)
class Seeable:
    """The verdict on each unit (2 n) of a mesh's patches.

    Attributes:
        patches: the units.
        verdict: (2 n,) a `Verdict`.
        why: (2 n,) a `Hidden`.
        witness: (2 n, 3) a place from which the unit is wholly seen, m; nan where none is known.
        squares: of directions that were looked at for it.
        by_clock: whether a clock ended the search before that was all it might look at: another machine may then decide
            more, or less.

    """

    patches: Patches
    verdict: Int8[np.ndarray, " units"]
    why: Int8[np.ndarray, " units"]
    witness: Float[np.ndarray, "units 3"]
    squares: int = 0
    by_clock: bool = False

    @property
    def possible(self) -> Marks:
        """Say which counted units are not proved hidden: an inspection wants to see them."""
        return self.patches.counted & (self.verdict != Verdict.HIDDEN)

    @property
    def lower(self) -> float:
        """Share of the area counted that surely can be seen: a witness is known."""
        return self.patches.coverage(self.verdict == Verdict.SEEABLE)

    @property
    def upper(self) -> float:
        """Share of the area counted beyond which no chaser can see: the rest is proved hidden."""
        return 1.0 - self.patches.coverage(self.verdict == Verdict.HIDDEN)


def seeable(
    sight: Sightlines,
    rules: SeeingRules,
    room: Room,
    *,
    squares: int = SQUARES,
    seconds: float | None = None,
    progress: Progress = silent,
) -> Seeable:
    """Say of each counted unit whether it can be seen at all from the room allowed, without regard to light.

    A unit that is called seeable has a witness, checked by `sight`, the rules and the room. One that is called hidden
    is proved to be (docs/seeing.md), to a part in 5000 of the stand-off. What a narrowed room takes away is
    in no proof: a unit of which only that leaves no witness is called undecided.

    Args:
        sight: the mesh and its units.
        rules: range, incidence and ground sample distance; the field of view holds any one patch.
        room: around that mesh: where the camera may be.
        squares: of directions that are looked at in all, after which what is left is called undecided. It is counted
            between groups of units, so that some more may be looked at.
        seconds: of the clock, after which it is called undecided as well; by default none. The verdicts that a clock
            ends differ from machine to machine.
        progress: told of the share that is decided.

    """
    began, patches, tree, limits = time.monotonic(), sight.patches, sight.tree, room.limits(rules)
    count = patches.units
    verdict = np.full(count, Verdict.UNDECIDED, dtype=np.int8)
    witness = np.full((count, 3), np.nan)
    areas, decided = patches.unit_areas(), 0.0
    units = np.flatnonzero(patches.counted)
    units = units[np.argsort(-areas[units], kind="stable")]
    # In each queue the largest come first; of the queues, the one whose first unit has most area for the work ahead.
    generator = np.random.default_rng(0)
    queues = [collections.deque([units] if len(units) else [])] + [collections.deque() for _ in _SQUARES[1:]]
    looked, by_clock = 0, False
    while any(queues) and looked < squares:
        if seconds is not None and time.monotonic() - began >= seconds:
            by_clock = True
            break
        stage = max((k for k in range(len(queues)) if queues[k]), key=lambda k: areas[queues[k][0][0]] / _SQUARES[k])
        some = queues[stage].popleft()
        if len(some) > _TOGETHER[stage]:
            queues[stage].appendleft(some[_TOGETHER[stage] :])
            some = some[: _TOGETHER[stage]]
        ends, places, spent = _searched(tree, limits, patches, some, _SQUARES[stage])
        looked += spent
        seen = some[ends == SEEN]
        sure = witnessed(sight, rules, room, places[ends == SEEN], seen)
        verdict[seen[sure]], witness[seen[sure]] = Verdict.SEEABLE, places[ends == SEEN][sure]
        verdict[some[ends == NONE]] = Verdict.HIDDEN
        if stage + 1 < len(queues) and (ends == OPEN).any():
            queues[stage + 1].append(some[ends == OPEN])
        decided += float(areas[seen[sure]].sum() + areas[some[ends == NONE]].sum())
        share = decided / float(areas.sum())
        progress(0.02 + 0.93 * share, f"of {share:.2%} of the area it is known whether it can be seen")
    for _ in range(_DRAWN if room.narrowed else 0):
        left = np.flatnonzero(patches.counted & (verdict == Verdict.UNDECIDED))
        places = drawn_before(patches, left, rules, room.stand_off, generator)
        sure = witnessed(sight, rules, room, places, left)
        verdict[left[sure]], witness[left[sure]] = Verdict.SEEABLE, places[sure]
    why = np.full(count, Hidden.NOT, dtype=np.int8)
    hidden = np.flatnonzero(verdict == Verdict.HIDDEN)
    why[hidden] = np.where(_enclosed(tree, patches, hidden), Hidden.ENCLOSED, Hidden.NARROW)
    found = Seeable(patches, verdict, why, witness, looked, by_clock)
    progress(1.0, f"{found.lower:.2%} to {found.upper:.2%} of the area can be seen")
    return found


def witnessed(
    sight: Sightlines, rules: SeeingRules, room: Room, places: Float[np.ndarray, "m 3"], units: Int[np.ndarray, " m"]
) -> Bool[np.ndarray, " m"]:
    """Say of pairs of a place and a unit whether the place is in the room and sees all of the unit by the rules."""
    patches, patch = sight.patches, units >> 1
    height = np.einsum("mi,mi->m", patches.unit_normals()[units], places - patches.centres[patch])
    ranges = np.linalg.norm(patches.corners[patch] - places[:, None], axis=2)
    far, near = ranges.max(axis=1, initial=0.0), ranges.min(axis=1, initial=np.inf)
    kept = (near > rules.least_range) & (far < rules.greatest_range)
    kept &= height >= math.cos(rules.greatest_incidence) * far
    kept &= far**2 * rules.pixel_angle <= rules.greatest_sample_distance * height
    kept &= room.allowed(places)
    kept[kept] = sight.clear(places[kept], units[kept])
    return kept


def drawn_before(
    patches: Patches,
    units: Int[np.ndarray, " m"],
    rules: SeeingRules,
    least: float,
    generator: np.random.Generator,
) -> Float[np.ndarray, "m 3"]:
    """Draw a place (m) for each unit, by range and incidence such as the rules allow, from `least` metres on."""
    low, high = max(least, rules.least_range), FAR * rules.greatest_range
    cosine = generator.uniform(np.cos(_STEEP * rules.greatest_incidence), 1.0, len(units))
    turn = generator.uniform(0.0, 2.0 * np.pi, len(units))
    normals = patches.unit_normals()[units]
    side, other = axes_across(normals)
    sine = np.sqrt(1.0 - cosine**2)[:, None]
    towards = cosine[:, None] * normals + sine * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
    return patches.centres[units // 2] + generator.uniform(low, max(low, high), len(units))[:, None] * towards


def _enclosed(tree: RayTree, patches: Patches, units: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    """Say from the middle of which units every one of many rays meets the mesh: a measurement, no proof."""
    turn = np.arange(_RAYS) * math.pi * (3.0 - math.sqrt(5.0))
    steep = 1.0 - np.arange(_RAYS) / _RAYS
    flat = np.sqrt(1.0 - steep**2)
    rays = np.stack([flat * np.cos(turn), flat * np.sin(turn), steep], axis=1)
    return _all_blocked(tree, _frames(patches, units), rays)


def _frames(patches: Patches, units: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 4 3"]:
    """Give the middle of each unit, two axes in its plane, and its normal."""
    normals = patches.unit_normals()[units]
    frames = np.stack([patches.centres[units >> 1], *axes_across(normals), normals], axis=1)
    return np.ascontiguousarray(frames)


def _searched(
    tree: RayTree, limits: Limits, patches: Patches, units: Int[np.ndarray, " m"], squares: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"], int]:
    """Search for each unit among so many squares of directions; give the ends, the places, and the squares in all."""
    patch = units >> 1
    frames, centres = _frames(patches, units), patches.centres[patch]
    # Counter-clockwise about the unit's own normal, the last corner still repeated.
    order = np.arange(patches.corners.shape[1])
    backward = np.maximum(patches.counts[patch, None] - 1 - order, 0)
    order = np.where((units & 1 == 1)[:, None], backward, order)
    corners = np.take_along_axis(patches.corners[patch], order[:, :, None], axis=1)
    outlines = np.ascontiguousarray(np.einsum("mkj,maj->mka", corners - centres[:, None], frames[:, 1:3]))
    # A place is at least the stand-off from the mesh next to the patch's middle, at the greatest incidence at most.
    lowest = limits.stand_off / math.hypot(1.0, limits.spread)
    least = max(lowest - 1e-3, 0.5 * lowest)
    largest = float(np.abs(tree.corners).max()) + limits.greatest_range
    asked = frames, outlines, np.ascontiguousarray(corners), np.ascontiguousarray(patches.counts[patch])
    return _search(tree, limits, asked, least, largest, squares)


class Unit(NamedTuple):
    """A unit as the compiled loops take it.

    Attributes:
        frame: its centre, two axes in its plane, and its normal.
        outline: corners in these axes about the centre, counter-clockwise about the normal, m.
        patch: the same corners in the body frame, m.

    """

    frame: Float[np.ndarray, "4 3"]
    outline: Float[np.ndarray, "k 2"]
    patch: Float[np.ndarray, "k 3"]


class Shadows(NamedTuple):
    """Shadows that were made last, and room to make one in.

    Attributes:
        edges: half planes of each: inward unit normal, least value.
        numbers: of them.
        heights: at which each was made, m.

    """

    edges: Float[np.ndarray, "shadows most 3"]
    numbers: Int[np.ndarray, " shadows"]
    heights: Float[np.ndarray, " shadows"]
    polygon: Float[np.ndarray, "8 3"]
    cut: Float[np.ndarray, "8 3"]
    points: Float[np.ndarray, "most 3"]
    order: Int[np.ndarray, " most"]
    chain: Int[np.ndarray, " most2"]


@kernel()
def shadows_of(number):
    """Give room for so many shadows."""
    edges, numbers, heights = np.empty((number, MOST_EDGES, 3)), np.zeros(number, dtype=np.int64), np.empty(number)
    points, order, chain = np.empty((MOST_EDGES, 3)), np.arange(MOST_EDGES), np.empty(2 * MOST_EDGES, dtype=np.int64)
    return Shadows(edges, numbers, heights, np.empty((8, 3)), np.empty((8, 3)), points, order, chain)


@kernel()
def _search(tree, limits, units, least, largest, most):
    """Search for each unit: give how each ends, the place from which it is seen, and the squares looked at in all."""
    frames, outlines, patches, counts = units
    ends, places, looked = np.empty(len(frames), dtype=np.int64), np.full((len(frames), 3), np.nan), 0
    queue = np.empty((4 * most + 8, 4))
    work = shadows_of(_SHADOWS), beam_workspace(), sightlines.workspace(patches.shape[1])
    for m in range(len(frames)):
        unit = Unit(frames[m], outlines[m][: counts[m]], patches[m][: counts[m]])
        queue[0, 0], queue[0, 1], queue[0, 2], queue[0, 3] = 0.0, 0.0, limits.spread, least
        ends[m], spent = _search_one(tree, limits, unit, largest, most, queue, work, places[m])
        looked += spent
    return ends, places, looked


@kernel()
def _search_one(tree, limits, unit, largest, most, queue, work, place):
    """Branch and bound over squares of directions from a unit: the end and the squares looked at; writes the place.

    A square is done with where a shadow covers it or nothing is allowed in it at any height; it is looked at in its
    middle, from the least height on, and what blocks that look throws a shadow. Else it is split.
    """
    shadows, beam, lines = work
    kept, latest, head, tail = 0, 0, 0, 1
    reach = 1.5 * limits.spread
    rounding = sightlines.ROUNDING * largest
    while head < tail:
        if head >= most:
            return OPEN, head
        x, y, half, height = queue[head, 0], queue[head, 1], queue[head, 2], queue[head, 3]
        head += 1
        if max(abs(x) - half, 0.0) ** 2 + max(abs(y) - half, 0.0) ** 2 > limits.spread**2:
            continue
        if _covered(shadows, kept, latest, height, x, y, half):
            continue
        raised = least_height(limits, unit.frame, unit.outline, x, y, half, height, beam)
        if raised == np.inf:
            continue
        if raised != height and _covered(shadows, kept, latest, raised, x, y, half):
            continue
        height = raised
        found = _blocker(tree, unit, x, y, height, rounding, lines)
        if found < 0:
            # What is blocked at a height is blocked at every greater one, so only the first place is asked for.
            first = np.inf
            if x * x + y * y < limits.spread**2:
                first = first_place(limits, unit.frame, unit.outline, x, y, height, beam)
            if first < np.inf:
                found = _blocker(tree, unit, x, y, first, rounding, lines)
                if found < 0:
                    place[0], place[1], place[2] = place_of(unit.frame, x, y, first)
                    return SEEN, head
        if found >= 0:
            latest = (latest + 1) % _SHADOWS
            kept = min(kept + 1, _SHADOWS)
            number = shadow(tree.corners[found], unit.frame, unit.outline, height, reach, largest, shadows, latest)
            if number > 0 and covers(shadows.edges[latest], number, x, y, half):
                continue
        if half < _SMALLEST:
            return OPEN, head
        for k in range(4):
            queue[tail, 0] = x + (0.5 if k & 1 else -0.5) * half
            queue[tail, 1] = y + (0.5 if k & 2 else -0.5) * half
            queue[tail, 2], queue[tail, 3] = 0.5 * half, height
            tail += 1
    return NONE, head


@kernel()
def _covered(shadows, kept, latest, height, x, y, half):
    """Whether one of the shadows kept, made at this height or below, holds all of a square of directions."""
    for k in range(kept):
        slot = (latest - k) % _SHADOWS
        number = shadows.numbers[slot]
        if shadows.heights[slot] <= height and number > 0 and covers(shadows.edges[slot], number, x, y, half):
            return True
    return False


@kernel()
def _blocker(tree, unit, wx, wy, height, rounding, work):
    """Give a triangle that may stand between a place and the whole of a patch; -1 where all are proved to pass."""
    frame = unit.frame
    gx = height * (wx * frame[1, 0] + wy * frame[2, 0] + frame[3, 0])
    gy = height * (wx * frame[1, 1] + wy * frame[2, 1] + frame[3, 1])
    gz = height * (wx * frame[1, 2] + wy * frame[2, 2] + frame[3, 2])
    cx, cy, cz = frame[0, 0], frame[0, 1], frame[0, 2]
    low = LIFT / height
    found = sightlines.ray_blocker(tree, work.stack, sightlines.Ray(cx, cy, cz, gx, gy, gz, low, 1.0 - low))
    if found >= 0:
        return found
    eye = sightlines.Eye(cx + gx, cy + gy, cz + gz, 1.0, rounding)
    return sightlines.pyramid_blocker(tree, unit.patch, frame[3], 1.0, eye, 0.0, work)


@kernel()
def _all_blocked(tree, frames, rays):
    """Say of units whether all rays from their middle meet the mesh.

    Args:
        tree: a `RayTree` of the mesh.
        frames: (m, 4, 3) centre, two axes in the plane, normal of each unit.
        rays: (k, 3) unit vectors in these axes, above the plane or along it.

    """
    stack, blocked = np.empty(DEEPEST, dtype=np.int64), np.ones(len(frames), dtype=np.bool_)
    for m in range(len(frames)):
        f = frames[m]
        x, y, z = f[0, 0] + LIFT * f[3, 0], f[0, 1] + LIFT * f[3, 1], f[0, 2] + LIFT * f[3, 2]
        for k in range(len(rays)):
            gx = rays[k, 0] * f[1, 0] + rays[k, 1] * f[2, 0] + rays[k, 2] * f[3, 0]
            gy = rays[k, 0] * f[1, 1] + rays[k, 1] * f[2, 1] + rays[k, 2] * f[3, 1]
            gz = rays[k, 0] * f[1, 2] + rays[k, 1] * f[2, 2] + rays[k, 2] * f[3, 2]
            if sightlines.ray_blocker(tree, stack, sightlines.Ray(x, y, z, gx, gy, gz, 0.0, np.inf)) < 0:
                blocked[m] = False
                break
    return blocked


@kernel()
def _apart(points, order, count):
    """Leave out of an order of points those that hardly differ from the one before; the number of those left."""
    kept = 1
    for i in range(1, count):
        here, before = order[i], order[kept - 1]
        x, y = points[here, 0], points[here, 1]
        if abs(x - points[before, 0]) + abs(y - points[before, 1]) > _SAME * (1.0 + abs(x) + abs(y)):
            order[kept] = here
            kept += 1
    return kept


@kernel()
def shadow(triangle, frame, outline, height, reach, largest, shadows, slot):
    """Write the shadow of a triangle at a height as half planes (inward unit normal, least value); their number.

    A place p at height h over a patch's centre is written (w, h): p = c + h (w_x e1 + w_y e2 + n). For a triangle and a
    height the directions w from which the whole patch cannot be seen because of it are a convex polygon, and it grows
    with the height; docs/seeing.md has the theorem. It is made a little smaller than rounding could make it larger.

    Args:
        triangle: (9,) corners, m.
        frame: (4, 3) the patch's centre, two axes in its plane, and the normal of the unit.
        outline: (k, 2) corners of the patch in these axes, m, about its centre.
        height: of the camera over the patch's plane, m.
        reach: length of the longest direction w that is asked for.
        largest: coordinate of the mesh and the places, m.
        shadows: to be written into.
        slot: where.

    """
    polygon, cut, points, edges = shadows.polygon, shadows.cut, shadows.points, shadows.edges[slot]
    for k in range(3):
        x, y, z = triangle[3 * k] - frame[0, 0], triangle[3 * k + 1] - frame[0, 1], triangle[3 * k + 2] - frame[0, 2]
        for axis in range(3):
            polygon[k, axis] = frame[axis + 1, 0] * x + frame[axis + 1, 1] * y + frame[axis + 1, 2] * z
    shadows.heights[slot], shadows.numbers[slot] = height, 0
    number = sightlines.slab(polygon, polygon[:, 2], 3, 2.0 * LIFT, 1.0, cut, cut[:, 2])
    number = sightlines.slab(cut, cut[:, 2], number, height - 2.0 * LIFT, -1.0, polygon, polygon[:, 2])
    if number < 2:
        return 0
    sigma, total = 1.0 / height, 0
    for i in range(number):
        inverse = 1.0 / polygon[i, 2]
        for j in range(len(outline)):
            x = (polygon[i, 0] - outline[j, 0]) * inverse + sigma * outline[j, 0]
            y = (polygon[i, 1] - outline[j, 1]) * inverse + sigma * outline[j, 1]
            points[total, 0], points[total, 1] = x, y
            points[total, 2] = _ROUNDING * (1.0 + abs(x) + abs(y)) * (1.0 + largest * inverse)
            total += 1
    sort_points(points, total, shadows.order)
    total = _apart(points, shadows.order, total)
    if total < 3:
        return 0
    # A corner that rounding leaves out makes the hull smaller, never larger.
    total = hull_of(points, shadows.order, total, shadows.chain)
    if total < 3:
        return 0
    for i in range(total):
        a, b = points[shadows.chain[i]], points[shadows.chain[i + 1 if i + 1 < total else 0]]
        ex, ey = b[0] - a[0], b[1] - a[1]
        length = np.sqrt(ex * ex + ey * ey)
        edges[i, 0], edges[i, 1] = -ey / length, ex / length
        value = max(edges[i, 0] * a[0] + edges[i, 1] * a[1], edges[i, 0] * b[0] + edges[i, 1] * b[1])
        # How far its moved ends move the line between them, beside the directions that are asked for.
        foot, span = -(a[0] * ex + a[1] * ey) / length**2, reach / length
        moved = 0.0
        for part in (foot - span, foot + span):
            moved = max(moved, abs(1.0 - part) * a[2] + abs(part) * b[2])
        edges[i, 2] = value + 2.0 * moved
    shadows.numbers[slot] = total
    return total


@kernel(inline="always")
def covers(edges, number, x, y, half):
    """Whether a shadow holds all of a square of directions."""
    for i in range(number):
        if edges[i, 0] * x + edges[i, 1] * y - half * (abs(edges[i, 0]) + abs(edges[i, 1])) < edges[i, 2]:
            return False
    return True

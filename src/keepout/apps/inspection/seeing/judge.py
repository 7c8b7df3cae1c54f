"""The verdict on every unit of a mesh: a place that sees it, or the proof that no place of the room allowed does."""

import collections
import math
import time

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.inspection.seeing.beam import Limits
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.search import NONE, OPEN, SEEN, all_blocked, search
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.first_hit import DEEPEST, RayTree, build_tree
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, part_of, silent

SQUARES = 4_000_000
"""Of directions looked at in all, unless told otherwise."""
_SQUARES = (300, 3_000, 30_000)
"""Squares of directions a unit in each stage: most are decided in the first, and the next takes what is left."""
_TOGETHER = (512, 64, 8)
"""Units between two looks at what was spent."""
_RAYS = 1000
"""Over the half sphere of directions: a unit is called enclosed if all of them meet the mesh."""


def seeable(
    target: Target,
    patches: Patches,
    sight: Sightlines,
    rules: SeeingRules,
    stand_off: float,
    *,
    room: Room | None = None,
    squares: int = SQUARES,
    seconds: float | None = None,
    progress: Progress = silent,
) -> Seeable:
    """Say of each counted unit whether it can be seen at all from the room allowed, without regard to light.

    A unit that is called seeable has a witness, checked by `sight`, the rules and the room. One that is called hidden
    is proved to be (docs/seeable.md), to a part in 5000 of the stand-off.

    Args:
        target: the mesh.
        patches: its units.
        sight: of these patches.
        rules: range, incidence and ground sample distance; the field of view holds any one patch.
        stand_off: least distance of the camera to the mesh, m.
        room: of that stand-off, where one is at hand.
        squares: of directions that are looked at in all, after which what is left is called undecided. It is counted
            between groups of units, so that some more may be looked at.
        seconds: of the clock, after which it is called undecided as well; by default none. The verdicts that a clock
            ends differ from machine to machine.
        progress: told of the share that is decided.

    Raises:
        InspectionError: a point cloud, a stand-off that is not positive, or a room of another one.

    """
    distance = target.distance
    if not isinstance(distance, ExactDistance):
        raise InspectionError(f"{target.name}: a point cloud has no surface to be seen; a mesh or a map has")
    if room is None:
        room = Room(distance, stand_off, progress=part_of(progress, 0.0, 0.02))
    elif room.stand_off != stand_off:
        raise InspectionError(f"seeable: the room is for a stand-off of {room.stand_off:g} m, not {stand_off:g} m")
    began = time.monotonic()
    count = patches.units
    verdict = np.full(count, Verdict.UNDECIDED, dtype=np.int8)
    witness = np.full((count, 3), np.nan)
    limits = room.limits(rules)
    tree = build_tree(distance.vertices[distance.faces])
    areas, decided = patches.unit_areas(), 0.0
    units = np.flatnonzero(patches.counted)
    units = units[np.argsort(-areas[units], kind="stable")]
    # In each queue the largest come first; of the queues, the one whose first unit has most area for the work ahead.
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
        sure = witnessed(patches, sight, rules, room, places[ends == SEEN], seen)
        verdict[seen[sure]], witness[seen[sure]] = Verdict.SEEABLE, places[ends == SEEN][sure]
        verdict[some[ends == NONE]] = Verdict.HIDDEN
        if stage + 1 < len(queues) and (ends == OPEN).any():
            queues[stage + 1].append(some[ends == OPEN])
        decided += float(areas[seen[sure]].sum() + areas[some[ends == NONE]].sum())
        share = decided / float(areas.sum())
        progress(0.02 + 0.93 * share, f"of {share:.2%} of the area it is known whether it can be seen")
    why = np.full(count, Hidden.NOT, dtype=np.int8)
    hidden = np.flatnonzero(verdict == Verdict.HIDDEN)
    why[hidden] = np.where(_enclosed(tree, patches, hidden), Hidden.ENCLOSED, Hidden.NARROW)
    found = Seeable(patches, verdict, why, witness, looked, by_clock)
    progress(1.0, f"{found.lower:.2%} to {found.upper:.2%} of the area can be seen")
    return found


def witnessed(
    patches: Patches,
    sight: Sightlines,
    rules: SeeingRules,
    room: Room,
    places: Float[np.ndarray, "m 3"],
    units: Int[np.ndarray, " m"],
) -> Bool[np.ndarray, " m"]:
    """Say of pairs of a place and a unit whether the place is in the room and sees all of the unit by the rules."""
    patch = units >> 1
    height = np.einsum("mi,mi->m", patches.unit_normals()[units], places - patches.centres[patch])
    ranges = np.linalg.norm(patches.corners[patch] - places[:, None], axis=2)
    far, near = ranges.max(axis=1, initial=0.0), ranges.min(axis=1, initial=np.inf)
    kept = (near > rules.least_range) & (far < rules.greatest_range)
    kept &= height >= math.cos(rules.greatest_incidence) * far
    kept &= far**2 * rules.pixel_angle <= rules.greatest_sample_distance * height
    kept &= room.allowed(places)
    kept[kept] = sight.clear(places[kept], units[kept])
    return kept


def _enclosed(tree: RayTree, patches: Patches, units: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    """Say from the middle of which units every one of many rays meets the mesh: a measurement, no proof."""
    turn = np.arange(_RAYS) * math.pi * (3.0 - math.sqrt(5.0))
    steep = 1.0 - np.arange(_RAYS) / _RAYS
    flat = np.sqrt(1.0 - steep**2)
    enclosed = np.empty(len(units), dtype=bool)
    rays = np.stack([flat * np.cos(turn), flat * np.sin(turn), steep], axis=1)
    all_blocked(tree, DEEPEST, _frames(patches, units), rays, enclosed)
    return enclosed


def _frames(patches: Patches, units: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 4 3"]:
    """Give the middle of each unit, two axes in its plane, and its normal."""
    normals = patches.unit_normals()[units]
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([patches.centres[units >> 1], first, np.cross(normals, first), normals], axis=1)
    return np.ascontiguousarray(frames)


def _searched(
    tree: RayTree,
    limits: Limits,
    patches: Patches,
    units: Int[np.ndarray, " m"],
    squares: int,
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"], int]:
    patch = units >> 1
    frames, centres = _frames(patches, units), patches.centres[patch]
    # Counter-clockwise about the unit's own normal, the last corner still repeated.
    order = np.arange(patches.corners.shape[1])
    backward = np.maximum(patches.counts[patch, None] - 1 - order, 0)
    order = np.where((units & 1 == 1)[:, None], backward, order)
    corners = np.take_along_axis(patches.corners[patch], order[:, :, None], axis=1)
    outlines = np.ascontiguousarray(np.einsum("mkj,maj->mka", corners - centres[:, None], frames[:, 1:3]))
    # A place is at least the stand-off from the mesh next to the patch's middle, at the greatest incidence at most.
    least = limits.stand_off / math.hypot(1.0, limits.spread) - 1e-3
    largest = float(np.abs(tree.corners).max()) + limits.greatest_range
    ends, places = np.full(len(units), OPEN, dtype=np.int64), np.full((len(units), 3), np.nan)
    looked = np.zeros(len(units), dtype=np.int64)
    search(
        tree,
        DEEPEST,
        limits,
        frames,
        outlines,
        np.ascontiguousarray(corners),
        np.ascontiguousarray(patches.counts[patch]),
        np.full(len(units), max(least, 1e-3)),
        largest,
        squares,
        ends,
        places,
        looked,
    )
    return ends, places, int(looked.sum())

"""The parts of a target for a contact sheet, and of each the frame of a flight that shows most of it, and nearest."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.fate import Fate, fates
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.seeing.patches import Patches

MOST_PARTS = 16
_APART = 0.35
"""Units of a part lie within this of its first one: of the target's size, where they face the same way."""
_TURNED = 0.5
"""What a unit vector's difference of 1 between normals counts, beside places as shares of the target's size."""
_TOGETHER = 0.15
"""Edge of the cells, of those places and normals, in which area counts as lying together."""
_ENOUGH = 1.0 / 300.0
"""Share of the area that lies together where a part begins: the rims of plates are no parts of their own."""
_ROUNDS = 8
"""In which the units are given to the nearest part, and the parts moved to the middle of theirs."""


@dataclass(frozen=True, eq=False)
class BestView:
    """A part, and the frame that shows it best.

    Attributes:
        units: of the part.
        frame: number of that frame; -1 where no frame shows any of it.
        shown: units of the part that were wholly seen in it.
        share: of the part's area, 0 to 1, that those are.
        distance: from the camera to the middle of them, m; nan without a frame.
        sample_distance: median over them, m a pixel along the slant; nan without a frame.

    """

    units: Int[np.ndarray, " k"]
    frame: int
    shown: Int[np.ndarray, " s"]
    share: float
    distance: float
    sample_distance: float


def best_views(inspection: Inspection, *, most: int = MOST_PARTS) -> list[BestView]:
    """Divide what was or could have been seen into parts, and choose the best frame of each; the largest part first.

    A part is what lies together and faces the same way. A frame is the better the more pixels the part's wholly seen
    patches fill in it, times the share of the part's area that they are.
    """
    patches, fate = inspection.patches, fates(inspection)
    chosen = np.flatnonzero((fate == Fate.SEEN) | (fate == Fate.MISSED))
    if len(chosen) == 0:
        return []
    areas = patches.unit_areas()
    part = np.full(patches.units, -1)
    part[chosen] = _parts(patches, chosen, areas[chosen], most)
    count = int(part.max()) + 1
    whole = np.bincount(part[chosen], areas[chosen], count)
    best, score = np.full(count, -1), np.zeros(count)
    for number, frame in enumerate(inspection.frames):
        units = frame.units[part[frame.units] >= 0]
        if len(units) == 0:
            continue
        cosine, distance = _aspect(patches, units, frame.position)
        pixels = np.bincount(part[units], areas[units] * cosine / distance**2, count)
        here = pixels * np.bincount(part[units], areas[units], count) / whole
        best, score = np.where(here > score, number, best), np.maximum(here, score)
    order = [k for k in np.argsort(-whole, kind="stable") if whole[k] > 0.0]
    return [_view(inspection, np.flatnonzero(part == k), int(best[k])) for k in order]


def _view(inspection: Inspection, units: Int[np.ndarray, " k"], frame: int) -> BestView:
    patches, areas = inspection.patches, inspection.patches.unit_areas()
    if frame < 0:
        return BestView(units, -1, units[:0], 0.0, np.nan, np.nan)
    taken = inspection.frames[frame]
    shown = np.intersect1d(units, taken.units)
    cosine, distance = _aspect(patches, shown, taken.position)
    middle = np.average(patches.centres[shown // 2], axis=0, weights=areas[shown])
    return BestView(
        units,
        frame,
        shown,
        float(areas[shown].sum() / areas[units].sum()),
        float(np.linalg.norm(middle - taken.position)),
        float(np.median(distance * inspection.rules.pixel_angle / cosine)),
    )


def _aspect(
    patches: Patches, units: Int[np.ndarray, " k"], position: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Give the cosine of the angle at which a camera looks at the middle of each unit, and how far off that is, m."""
    away = position - patches.centres[units // 2]
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    normals = patches.normals[units // 2] * np.where(units % 2 == 0, 1.0, -1.0)[:, None]
    return np.maximum(np.einsum("ni,ni->n", away, normals) / distance, 1e-3), distance


def _parts(
    patches: Patches, units: Int[np.ndarray, " k"], areas: Float[np.ndarray, " k"], most: int
) -> Int[np.ndarray, " k"]:
    """Give each unit a part: first ones as far apart as can be, then each unit to the nearest, weighed by area."""
    centres = patches.centres[units // 2]
    size = max(float(np.linalg.norm(np.ptp(patches.corners.reshape(-1, 3), axis=0))), 1e-9)
    normals = patches.normals[units // 2] * np.where(units % 2 == 0, 1.0, -1.0)[:, None]
    places = np.concatenate([centres / size, _TURNED * normals], axis=1)
    _, cell = np.unique(np.floor(places / _TOGETHER).astype(int), axis=0, return_inverse=True)
    beside = np.bincount(cell.reshape(-1), areas)[cell.reshape(-1)]
    first = places[beside >= min(_ENOUGH * areas.sum(), beside.max())]
    middles = [places[int(np.argmax(beside))]]
    away = np.linalg.norm(first - middles[0], axis=1)
    while len(middles) < most and away.max() > _APART:
        middles.append(first[int(np.argmax(away))])
        away = np.minimum(away, np.linalg.norm(first - middles[-1], axis=1))
    found = np.array(middles)
    nearest = np.zeros(len(units), int)
    for _ in range(_ROUNDS):
        nearest = np.argmin(np.linalg.norm(places[:, None] - found[None], axis=2), axis=1)
        weight = np.bincount(nearest, areas, len(found))
        sums = np.stack([np.bincount(nearest, areas * column, len(found)) for column in places.T], axis=1)
        found = np.where(weight[:, None] > 0.0, sums / np.maximum(weight, 1e-300)[:, None], found)
    return nearest

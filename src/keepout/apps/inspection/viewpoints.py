"""Candidates for views: places where much can be seen, and at each the few directions that show it.

What is visible from a place is found once and serves all directions there. Places are drawn for units that few places
see so far: a unit by its area and rarity, a direction within the allowed incidence of its normal, a range between the
stand-off and the camera's greatest. So they lie on all levels of the distance, and where narrow openings ask for them.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.visible import Visible
from keepout.core.cores import available_cores
from keepout.core.progress import Progress, part_of, silent

Point = Float[np.ndarray, "3"]
Look = Callable[[Point], Visible]
"""What is visible from a place."""
Allowed = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
"""Which places the chaser's centre may be at."""

_ROUNDS = 4
_STEEP = 0.97
"""Of the greatest incidence, the most that places are drawn at: a patch has an extent."""
_FAR = 0.97
"""Likewise of the greatest range."""
_TRIES = 20
_BORESIGHTS = 8
"""At a place, at most."""
_LEAST_GAIN = 0.02
"""Of what a place shows, the share that a further direction there must add, or show a unit that no view does."""
_RARE = 3
"""Places that a unit is visible from, up to which it asks for a direction of its own."""
_DIRECTIONS = 250
_TURNS = ((0.15, 8), (0.08, 8), (0.03, 8))
"""Rad, and how many directions at that angle are tried about the best."""


@dataclass(frozen=True, eq=False)
class Views:
    """Candidate views.

    Attributes:
        positions: (v, 3) m.
        boresights: (v, 3) unit vectors.
        sees: (v, units) 1 where a view sees a unit, whatever the light.
        places: at how many places what is visible was found.

    """

    positions: Float[np.ndarray, "v 3"]
    boresights: Float[np.ndarray, "v 3"]
    sees: sparse.csr_array
    places: int

    def only(self, rows: Int[np.ndarray, " k"]) -> "Views":
        """Give some of them."""
        return Views(self.positions[rows], self.boresights[rows], self.sees[rows], self.places)

    def and_those(self, others: "Views") -> "Views":
        """Give these views, and then others."""
        return Views(
            np.concatenate([self.positions, others.positions]),
            np.concatenate([self.boresights, others.boresights]),
            sparse.csr_array(sparse.vstack([self.sees, others.sees])),
            self.places,
        )


def find_views(
    look: Look,
    look_closely: Look,
    allowed: Allowed,
    patches: Patches,
    rules: SeeingRules,
    *,
    wanted: Bool[np.ndarray, " units"],
    witnesses: Float[np.ndarray, "units 3"],
    stand_off: float,
    places: int,
    seed: int = 0,
    progress: Progress = silent,
) -> Views:
    """Find candidate views of the units wanted.

    Args:
        look: what is visible from a place, among the units wanted, with room for a flight's errors.
        look_closely: the same without, for the places of witnesses.
        allowed: where the chaser's centre may be.
        patches: the units.
        rules: the camera's.
        wanted: (units,) to be seen.
        witnesses: (units, 3) m, places from which each is seen; nan where none is known.
        stand_off: of the places, m.
        places: to be drawn, at most; those of witnesses that show what none of them does come on top.
        seed: of the drawing.
        progress: told how much is seen.

    """
    generator = np.random.default_rng(seed)
    areas, normals = patches.unit_areas() * wanted, patches.unit_normals()
    centres = np.repeat(patches.centres, 2, axis=0)
    times = np.zeros(patches.units, dtype=np.int64)
    found: list[tuple[Point, Visible]] = []
    total = float(areas.sum())
    with ThreadPoolExecutor(available_cores()) as pool:

        def take(some: Float[np.ndarray, "n 3"], with_: Look, told: Progress) -> None:
            for n, (place, seen) in enumerate(zip(some, pool.map(with_, some), strict=True)):
                seen = _within_cone(seen, rules)
                if len(seen.units):
                    found.append((place, seen))
                    times[seen.units] += 1
                if n % 64 == 63:
                    told((n + 1) / len(some), f"{len(found)} places see {areas[times > 0].sum() / total:.2%}")

        for step in range(_ROUNDS):
            weights = areas / (1.0 + times) if step else areas
            if not weights.any():
                break
            drawn = _drawn(generator, weights, centres, normals, rules, stand_off, allowed, places // _ROUNDS)
            take(drawn, look, part_of(progress, 0.8 * step / _ROUNDS, 0.8 * (step + 1) / _ROUNDS))
        while True:
            unseen = np.flatnonzero(wanted & (times == 0) & np.isfinite(witnesses[:, 0]))
            if len(unseen) == 0:
                break
            # A part at a time: a witness often shows what others were known for.
            some = generator.permutation(unseen)[: max(16, len(unseen) // 8)]
            take(witnesses[some], look_closely, silent)
            witnesses = witnesses.copy()
            witnesses[some] = np.nan
            progress(0.85, f"{len(found)} places see {areas[times > 0].sum() / total:.2%}")
        chosen = list(pool.map(lambda one: boresights_of(one[1], areas, times, rules.half_angle), found))
    progress(
        1.0,
        f"{sum(len(one[0]) for one in chosen)} views at {len(found)} places see {areas[times > 0].sum() / total:.2%}",
    )
    return _joined(found, chosen, patches.units)


def boresights_of(
    seen: Visible, areas: Float[np.ndarray, " units"], times: Int[np.ndarray, " units"], half_angle: float
) -> tuple[Float[np.ndarray, "b 3"], list[Int[np.ndarray, " _"]]]:
    """Choose directions to look in at one place, each where most of what is left is wholly in the cone.

    Args:
        seen: from the place.
        areas: of the units, m².
        times: from how many places each unit is visible; one that few see counts for more.
        half_angle: of the cone, rad.

    Returns:
        (b, 3) unit vectors, and of each the units in its cone.

    """
    worth = areas[seen.units] * (1.0 + 10.0 / (1.0 + times[seen.units]))
    enough = np.cos(np.maximum(half_angle - seen.spread, 0.0))
    left, all_of_it = worth.copy(), float(worth.sum())
    chosen, units = [], []
    sphere = _sphere(_DIRECTIONS)
    directions = np.ascontiguousarray(seen.directions)
    for _ in range(_BORESIGHTS):
        best = sphere[int(np.argmax(_gains(directions, enough, left, sphere)))]
        for angle, count in _TURNS:
            tried = np.concatenate([best[None], _about(best, angle, count)])
            best = tried[int(np.argmax(_gains(directions, enough, left, tried)))]
        cone = directions @ best >= enough
        gain = float(left[cone].sum())
        if gain == 0.0:
            # The sphere's directions miss a unit nearly as wide as the cone: look straight at it.
            best = directions[int(np.argmax(left))]
            cone = directions @ best >= enough - 1e-12
            gain = float(left[cone].sum())
        rare = bool(np.any(times[seen.units[cone & (left > 0.0)]] <= _RARE))
        if gain <= 0.0 or (gain < _LEAST_GAIN * all_of_it and not rare):
            break
        chosen.append(best)
        units.append(seen.units[cone])
        left[cone] = 0.0
        if not left.any():
            break
    return np.array(chosen).reshape(-1, 3), units


@numba.njit(cache=True, nogil=True)
@no_type_check
def _gains(directions, enough, left, tried):
    """Give for each direction tried what is left in its cone."""
    gains = np.zeros(len(tried))
    for i in range(len(directions)):
        if left[i] <= 0.0:
            continue
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        for j in range(len(tried)):
            if x * tried[j, 0] + y * tried[j, 1] + z * tried[j, 2] >= enough[i]:
                gains[j] += left[i]
    return gains


def _within_cone(seen: Visible, rules: SeeingRules) -> Visible:
    """Leave out what is wider than the whole cone."""
    fits = seen.spread < rules.half_angle
    return Visible(seen.units[fits], seen.directions[fits], seen.spread[fits])


def _drawn(
    generator: np.random.Generator,
    weights: Float[np.ndarray, " units"],
    centres: Float[np.ndarray, "units 3"],
    normals: Float[np.ndarray, "units 3"],
    rules: SeeingRules,
    stand_off: float,
    allowed: Allowed,
    count: int,
) -> Float[np.ndarray, "n 3"]:
    """Draw places for units by their weights, of which the chaser may be at all; fewer than `count` if that is hard."""
    kept = np.zeros((0, 3))
    low, high = max(stand_off, rules.least_range), _FAR * rules.greatest_range
    flattest = np.cos(_STEEP * rules.greatest_incidence)
    for _ in range(_TRIES if low < high else 0):
        missing = count - len(kept)
        if missing <= 0:
            break
        units = generator.choice(len(weights), size=2 * missing, p=weights / weights.sum())
        cosine = generator.uniform(flattest, 1.0, len(units))
        turn = generator.uniform(0.0, 2.0 * np.pi, len(units))
        side, other = _sides(normals[units])
        sine = np.sqrt(1.0 - cosine**2)[:, None]
        towards = cosine[:, None] * normals[units] + sine * (
            np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
        )
        places = centres[units] + generator.uniform(low, high, len(units))[:, None] * towards
        kept = np.concatenate([kept, places[allowed(places)][:missing]])
    return kept


def _sides(normals: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Give two unit vectors across each."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    side = np.cross(normals, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return side, np.cross(normals, side)


def _about(axis: Float[np.ndarray, "3"], angle: float, count: int) -> Float[np.ndarray, "n 3"]:
    """Give unit vectors all round an axis, at an angle from it, rad."""
    (side,), (other,) = _sides(axis[None])
    turn = 2.0 * np.pi * np.arange(count)[:, None] / count
    return np.cos(angle) * axis + np.sin(angle) * (np.cos(turn) * side + np.sin(turn) * other)


def _sphere(count: int) -> Float[np.ndarray, "n 3"]:
    """Give directions all over the sphere, on Fibonacci's spiral."""
    index = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * index / count, np.pi * (1.0 + 5.0**0.5) * index
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def _joined(
    found: list[tuple[Point, Visible]],
    chosen: list[tuple[Float[np.ndarray, "_ 3"], list[Int[np.ndarray, " _"]]]],
    units: int,
) -> Views:
    rows = [row for _, several in chosen for row in several]
    starts = np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64)
    index = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
    sees = sparse.csr_array((np.ones(len(index)), index, starts), shape=(len(rows), units))
    counts = [len(one[0]) for one in chosen]
    positions = np.repeat(np.array([place for place, _ in found]).reshape(-1, 3), counts, axis=0)
    return Views(positions, np.concatenate([np.zeros((0, 3)), *(one[0] for one in chosen)]), sees, len(found))

"""Candidates for views: places where much can be seen, and at each the few directions that show it.

What is visible from a place is found once and serves all directions there. Places are drawn for units that few places
see so far: a unit by its area and rarity, a direction within the allowed incidence of its normal, a range between the
stand-off and the camera's greatest. So they lie on all levels of the distance, and where narrow openings ask for them.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from keepout.apps.inspection.passive import Drifting
from keepout.apps.inspection.problem import Problem
from keepout.apps.inspection.seeing.patches import Areas, Marks, Units
from keepout.apps.inspection.seeing.seeable import FAR, drawn_before
from keepout.apps.inspection.seeing.visible import SeeingRules, Visible, visible
from keepout.apps.led.camera import axes_across
from keepout.core.cores import available_cores, kernel
from keepout.core.geometry.distance import Point, Points
from keepout.core.progress import Progress, part_of, silent

_PLACES_EACH, _FEWEST_PLACES = 4, 64
"""Places drawn for every unit wanted, and at least; `inspect.candidates` at most."""
INSIDE = 0.02
"""Metres by which candidates keep more than the stand-off."""
_ROOM_TO_FLY = 0.15
"""Metres off its place at which a view is still to show what it was planned for: ranges are planned so much within."""
_TILT = math.radians(1.5)
"""The same for the angles of incidence and of the cone, rad."""
_ROUNDS = 4
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
_STEPS = 60
"""Of the search for the middle, whose error falls with the number of steps."""


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

    def units(self, row: int | np.integer) -> Units:
        """Give the units that a view sees, whatever the light."""
        return self.sees.indices[self.sees.indptr[row] : self.sees.indptr[row + 1]]

    def only(self, rows: Int[np.ndarray, " k"]) -> "Views":
        """Give some of them."""
        return Views(self.positions[rows], self.boresights[rows], self.sees[rows], self.places)

    def and_those(self, others: "Views") -> "Views":
        """Give these views, and then others."""
        positions = np.concatenate([self.positions, others.positions])
        boresights = np.concatenate([self.boresights, others.boresights])
        return Views(positions, boresights, sparse.csr_array(sparse.vstack([self.sees, others.sees])), self.places)


def tighter_rules(rules: SeeingRules, patch: float) -> SeeingRules:
    """Give rules that what a flight does to a view does not break, where that leaves room."""
    greatest = rules.greatest_range - _ROOM_TO_FLY
    least = rules.least_range + _ROOM_TO_FLY
    return replace(
        rules,
        field_of_view=max(rules.field_of_view - 2.0 * _TILT, 0.8 * rules.field_of_view),
        greatest_incidence=max(rules.greatest_incidence - _TILT, 0.8 * rules.greatest_incidence),
        least_range=least if least + patch < greatest else rules.least_range,
        greatest_range=greatest if least + patch < greatest else rules.greatest_range,
    )


@dataclass(eq=False)
class _Places:
    """Where a view may be: in the room allowed, and where passive safety is asked for, where rest is safe."""

    problem: Problem
    drifting: Drifting | None
    time: float
    unsafe: int = 0

    @property
    def level(self) -> float:
        """The distance from mesh and zones that places keep, m."""
        return self.problem.scenario.inspect.stand_off + INSIDE

    def allowed(self, places: Points) -> Bool[np.ndarray, " n"]:
        answer = self.problem.room.free.distance(places) >= self.level
        answer[answer] = self.problem.room.allowed(places[answer])
        answer[answer] = self.safe(places[answer])
        return answer

    def safe(self, places: Points) -> Bool[np.ndarray, " n"]:
        if self.drifting is None:
            return np.ones(len(places), dtype=bool)
        answer = self.drifting.at_rest(places, self.time)
        self.unsafe += int(np.count_nonzero(~answer))
        return answer

    def drawn(
        self, generator: np.random.Generator, weights: Float[np.ndarray, " units"], rules: SeeingRules, count: int
    ) -> Points:
        """Draw places for units by their weights, where the chaser may be at all; fewer if that is hard."""
        kept, patches = np.zeros((0, 3)), self.problem.patches
        within = max(self.level, rules.least_range) < FAR * rules.greatest_range
        for _ in range(_TRIES if within else 0):
            missing = count - len(kept)
            if missing <= 0:
                break
            units = generator.choice(len(weights), size=2 * missing, p=weights / weights.sum())
            tried = drawn_before(patches, units, rules, self.level, generator)
            kept = np.concatenate([kept, tried[self.allowed(tried)][:missing]])
        return kept


def candidates(
    problem: Problem,
    wanted: Marks,
    time: float,
    *,
    within: SeeingRules | None = None,
    progress: Progress = silent,
) -> tuple[Views, int]:
    """Find views of the units wanted; witnesses' places by the camera's limits themselves.

    Places are drawn, at most so many as `inspect.candidates`; those of witnesses that show what none of them does come
    on top. Where passive safety is asked for, rest is safe at all of them.

    Args:
        problem: what there is to be seen, and from where.
        wanted: (units,) to be seen.
        time: at which rest is to be safe, s.
        within: limits of what drawn places show; if absent, the camera's with room for a flight's errors.
        progress: told how much is seen.

    Returns:
        The views, and at how many places that were tried rest is not safe.

    """
    scenario, patches = problem.scenario, problem.patches
    rules = tighter_rules(problem.rules, patches.size) if within is None else within
    count = min(scenario.inspect.candidates, max(_FEWEST_PLACES, _PLACES_EACH * int(wanted.sum())))
    places = _Places(problem, Drifting.of(scenario, problem.target.distance.distance), time)
    generator, witnesses = np.random.default_rng(scenario.seed), problem.seeable.witness.copy()
    areas, times = patches.unit_areas() * wanted, np.zeros(patches.units, dtype=np.int64)
    found: list[tuple[Point, Visible]] = []
    total = float(areas.sum())
    with ThreadPoolExecutor(available_cores()) as pool:

        def take(some: Points, by: SeeingRules, told: Progress) -> None:
            looks = pool.map(lambda place: visible(problem.sight, by, place, among=wanted), some)
            for n, (place, seen) in enumerate(zip(some, looks, strict=True)):
                fitting = seen.only(seen.spread < rules.half_angle)
                if len(fitting.units):
                    found.append((place, fitting))
                    times[fitting.units] += 1
                if n % 64 == 63:
                    told((n + 1) / len(some), f"{len(found)} places see {areas[times > 0].sum() / total:.2%}")

        for step in range(_ROUNDS):
            weights = areas / (1.0 + times) if step else areas
            if not weights.any():
                break
            drawn = places.drawn(generator, weights, rules, count // _ROUNDS)
            take(drawn, rules, part_of(progress, 0.8 * step / _ROUNDS, 0.8 * (step + 1) / _ROUNDS))
        while True:
            unseen = np.flatnonzero(wanted & (times == 0) & np.isfinite(witnesses[:, 0]))
            if len(unseen) == 0:
                break
            # A part at a time: a witness often shows what others were known for.
            some = generator.permutation(unseen)[: max(16, len(unseen) // 8)]
            take(witnesses[some], problem.rules, silent)
            witnesses[some] = np.nan
            progress(0.85, f"{len(found)} places see {areas[times > 0].sum() / total:.2%}")
        chosen = list(pool.map(lambda one: boresights_of(one[1], areas, times, rules.half_angle), found))
    number = sum(len(one[0]) for one in chosen)
    progress(1.0, f"{number} views at {len(found)} places see {areas[times > 0].sum() / total:.2%}")
    at = np.repeat(np.array([place for place, _ in found]).reshape(-1, 3), [len(one[0]) for one in chosen], axis=0)
    boresights = np.concatenate([np.zeros((0, 3)), *(one[0] for one in chosen)])
    views = Views(at, boresights, table_of([row for one in chosen for row in one[1]], patches.units), len(found))
    # The places of witnesses were not drawn.
    return views if places.drifting is None else views.only(np.flatnonzero(places.safe(at))), places.unsafe


def boresights_of(
    seen: Visible, areas: Areas, times: Int[np.ndarray, " units"], half_angle: float
) -> tuple[Float[np.ndarray, "b 3"], list[Units]]:
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


@kernel()
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


def _about(axis: Point, angle: float, count: int) -> Points:
    """Give unit vectors all round an axis, at an angle from it, rad."""
    (side,), (other,) = axes_across(axis[None])
    turn = 2.0 * np.pi * np.arange(count)[:, None] / count
    return np.cos(angle) * axis + np.sin(angle) * (np.cos(turn) * side + np.sin(turn) * other)


def _sphere(count: int) -> Points:
    """Give directions all over the sphere, on Fibonacci's spiral."""
    index = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * index / count, np.pi * (1.0 + 5.0**0.5) * index
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def table_of(rows: list[Units], units: int) -> sparse.csr_array:
    """Give the matrix (rows, units) with 1 where a row names a unit."""
    starts = np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64)
    index = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
    return sparse.csr_array((np.ones(len(index)), index, starts), shape=(len(rows), units))


def middle_of(directions: Points) -> tuple[Point, float]:
    """Give a unit vector whose greatest angle to unit vectors is nearly the least, and that angle, rad.

    Each step turns towards the farthest direction by a share that shrinks (Bădoiu and Clarkson's, on the sphere).
    Directions on all sides have no middle; then the angle says so.
    """
    middle = directions.mean(axis=0)
    size = float(np.linalg.norm(middle))
    middle = middle / size if size > 1e-9 else directions[0]
    best, least = middle, -2.0
    for step in range(_STEPS):
        cosines = directions @ middle
        farthest = int(np.argmin(cosines))
        if cosines[farthest] > least:
            best, least = middle, float(cosines[farthest])
        turned = middle + (directions[farthest] - middle) / (step + 2.0)
        size = float(np.linalg.norm(turned))
        if not size > 1e-9:
            break
        middle = turned / size
    return best, float(np.arccos(np.clip(least, -1.0, 1.0)))


def aim(place: Point, points: Points, planned: Point, half_angle: float) -> Point:
    """Give the direction to look in from a place so that points are in the cone; the planned one if they are not.

    Args:
        place: (3,) of the camera, m.
        points: (k, 3) what is to be seen, m.
        planned: (3,) unit vector.
        half_angle: of the cone, rad.

    """
    if len(points) == 0:
        return planned
    to = points - place
    lengths = np.linalg.norm(to, axis=1)
    if not lengths.min() > 1e-9:
        return planned
    to = to / lengths[:, None]
    if float((to @ planned).min()) >= np.cos(half_angle):
        return planned
    middle, spread = middle_of(to)
    return middle if spread < half_angle else planned

"""What passive safety leaves of a tour: legs flown more slowly, and no view to which no leg is safe."""

import dataclasses
import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.drifting import Course, Drifting, DriftsPlanned
from keepout.apps.inspection.tour import Tour
from keepout.apps.inspection.ways import way_length


def kept_safe(
    drifting: Drifting | None,
    tour: Tour,
    course: Callable[[int, int], Course],
    turn: Callable[[int, int], float],
    begin: float,
    dwell: float,
) -> tuple[Tour, list[Course], list[float], DriftsPlanned | None]:
    """Give what is left of a tour, the courses of its legs, their greatest speeds (m/s), and what became of it.

    A view to which the leg is not safe at any speed is left out, and the next is flown to from where the chaser is.
    Times are moved on where a leg is slower; the end by as much as the last view's.

    Args:
        drifting: judges legs; None: none is judged, and the tour stays as it is.
        tour: rows of views from 1 on; 0 is the start.
        course: of the leg from a row to another, m.
        turn: of the boresight from a row to another, s.
        begin: time at the start, s.
        dwell: at every view, s.

    """
    if drifting is None:
        order = [0, *tour.order.tolist()]
        return tour, [course(*leg) for leg in pairwise(order)], [math.inf] * len(tour.order), None
    at = dict(zip([0, *tour.order.tolist()], [begin, *tour.times.tolist()], strict=True))
    chaser = drifting.scenario.chaser
    limit, settle = chaser.speed_limit, chaser.speed_limit * chaser.mass / chaser.force_limit
    courses: dict[tuple[int, int], Course] = {}
    speeds: dict[tuple[int, int], float] = {}
    kept = [0, *tour.order.tolist()]
    while fresh := [leg for leg in pairwise(kept) if leg not in speeds]:
        courses |= {leg: course(*leg) for leg in fresh}
        times = np.array([(at[a], at[b]) for a, b in fresh])
        speeds |= dict(zip(fresh, drifting.speeds([courses[leg] for leg in fresh], times).tolist(), strict=True))
        kept = _without_unsafe(kept, speeds)
    legs = list(pairwise(kept))
    times = _moved_on(legs, at, courses, speeds, turn, dwell + settle, limit)
    told = DriftsPlanned(
        legs=len(tour.order),
        safe=len(legs),
        slowed=sum(speeds[leg] < limit for leg in legs),
        views_left_out=len(tour.order) - len(legs),
    )
    late = float(times[-1]) - at[kept[-1]] if legs and math.isfinite(at[kept[-1]]) else 0.0
    left = dataclasses.replace(tour, order=np.array(kept[1:], dtype=np.int64), times=times, end=tour.end + late)
    return left, [courses[leg] for leg in legs], [speeds[leg] for leg in legs], told


def _without_unsafe(kept: list[int], speeds: dict[tuple[int, int], float]) -> list[int]:
    """Leave out the end of each leg that is not safe; what comes after one is not known yet, and stays."""
    left = kept[:1]
    for row in kept[1:]:
        if speeds.get((left[-1], row), math.inf) > 0.0:
            left.append(row)
    return left


def _moved_on(
    legs: list[tuple[int, int]],
    at: dict[int, float],
    courses: dict[tuple[int, int], Course],
    speeds: dict[tuple[int, int], float],
    turn: Callable[[int, int], float],
    stay: float,
    limit: float,
) -> Float[np.ndarray, " views"]:
    """Give the times of the views, none before its own: later where legs before it are flown below the limit."""
    times, behind = [], 0.0
    for leg in legs:
        a, b = leg
        way, slew = way_length(courses[leg]), turn(a, b)
        quickest = max(way / limit, slew)
        spare = max(at[b] - at[a] - quickest - stay, 0.0) if math.isfinite(at[b]) and math.isfinite(at[a]) else 0.0
        behind = max(behind + max(way / speeds[leg], slew) - quickest - spare, 0.0)
        times.append(at[b] + behind)
    return np.array(times)

"""An order for a mission that is too short for its plan: what is seen by the mission's end comes first.

The order that is shortest as a whole leaves much for late. So orders are made by greed, each with another price of a
leg: the view next is the one that newly shows most for that price. The first of them counts the way alone. Of the rest
one is taken only where, after no quarter of its way, it has seen less than the first has after as many metres.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.arranging import Arranged, Arranger
from keepout.apps.inspection.light_plan import nearly
from keepout.apps.inspection.plan import InspectionPlan
from keepout.apps.inspection.tour import turning_time

_SETTLES = (0.0, 5.0, 15.0, 40.0)
"""Seconds added to every leg where its time is the price: a near view that shows little is not free."""
_BEHIND = 0.01
"""Share of what is wanted by which an order may be behind the first."""
_LONGER = 1.2
"""Of the time left, for how long an order is made: flown faster than expected, more of it is reached."""
_AT_ONCE = 1e-3
"""Metres or seconds: the least price of a leg."""

Price = Callable[[Float[np.ndarray, " v"], Float[np.ndarray, " v"]], Float[np.ndarray, " v"]]
"""What legs cost, by their ways (m) and by the times (s) that they take."""


def in_short_time(arranger: Arranger, best: Arranged) -> Arranged:
    """Give the order that sees most by the mission's end.

    Args:
        arranger: with the candidates, and the ways between them.
        best: the order that is best where there is time for all of it.

    """
    end, areas = arranger.problem.scenario.duration, arranger.areas

    def seen(one: Arranged) -> float:
        return float(areas[one.drawn.plan.seen_by(end)].sum())

    first = arranger.in_order(_greedy(arranger, lambda way, _: way))
    others = [arranger.in_order(_greedy(arranger, lambda _, taken, more=more: taken + more)) for more in _SETTLES]
    fair = [one for one in (best, *others) if _keeps_up(one.drawn.plan, first.drawn.plan, areas, end)]
    return max([first, *fair], key=seen)


def _keeps_up(one: InspectionPlan, first: InspectionPlan, areas: Float[np.ndarray, " units"], end: float) -> bool:
    """Whether a plan is nowhere behind another at a quarter of its way."""
    mine, seen = _over_way(one, areas, end)
    theirs, seen_by_them = _over_way(first, areas, end)
    quarters = mine[-1] * np.arange(1, 5) / 4.0
    after = seen[np.searchsorted(mine, quarters + _AT_ONCE, side="right") - 1]
    asked = seen_by_them[np.searchsorted(theirs, quarters + _AT_ONCE, side="right") - 1]
    return bool(np.all(after >= asked - _BEHIND * areas.sum()))


def _over_way(
    plan: InspectionPlan, areas: Float[np.ndarray, " units"], end: float
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Give the ways flown by the mission's end after each view, m, and the areas seen by then, m²; 0 and 0 at first."""
    ways, shares, left = [0.0], [0.0], areas.copy()
    for view in plan.views:
        if view.at > end:
            break
        left[view.units] = left[view.on_the_way] = 0.0
        ways.append(ways[-1] + view.way)
        shares.append(float(areas.sum() - left.sum()))
    return np.array(ways), np.array(shares)


def _greedy(arranger: Arranger, price: Price) -> Int[np.ndarray, " k"]:
    """Give rows of the candidates: always that which newly shows most for the price of the leg to it."""
    views, start, scenario = arranger.candidates, arranger.start, arranger.problem.scenario
    lengths, camera = nearly(views, arranger.ways, start.position), scenario.camera
    left, looking, here, now = arranger.areas * arranger.lit.lit[0], start.looking(arranger.problem), -1, start.time
    until = start.time + _LONGER * (scenario.duration - start.time)
    whole, order = float(left.sum()), list[int]()
    while whole - float(left.sum()) < arranger.goal and len(order) < scenario.inspect.most_views:
        way = lengths(here)
        turns = turning_time(looking[None], views.boresights, camera.turn_rate, camera.turn_acceleration)[0]
        taken = np.maximum(way / scenario.chaser.speed_limit, turns) + scenario.inspect.dwell
        rates = np.where(np.isfinite(way), (views.sees @ left) / np.maximum(price(way, taken), _AT_ONCE), 0.0)
        here = int(np.argmax(rates))
        if rates[here] <= 0.0 or (order and now > until):
            break
        order.append(here)
        left[views.sees.indices[views.sees.indptr[here] : views.sees.indptr[here + 1]]] = 0.0
        looking, now = views.boresights[here], now + float(taken[here])
    return np.array(order, dtype=np.int64)

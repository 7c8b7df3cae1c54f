"""The order in which views are flown: an open path from the start, least in time, in Δv, or in both.

A leg takes as long as its way takes at the speed flown, or as the boresight takes to turn if that is longer; then it
is flown slower. At a view the velocity changes from that of one leg to that of the next, which costs Δv = |change| and,
with the acceleration a, half of Δv / a in time. Where the chaser stays, or must wait for light, it stops: the change is
then to rest and from rest. Light windows are the times within which a view is worth anything.
"""

import math
from dataclasses import dataclass
from typing import Literal, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import minimum_spanning_tree

from keepout.apps.inspection.tour_search import best_order

Objective = Literal["time", "delta_v", "both"]
_LATE = 1e7
"""Seconds that a view costs for which the light never comes again."""
_SIDE = 1e-3
"""Of the other quantity (s, or 100 m/s of Δv), what an objective counts of it so that ties are broken by it."""
_WORK = 2e8
"""Legs evaluated while an order is shaken, about; the number of shakes follows."""
_SHAKES = 3000
"""Of orders in which no place has to be reached at a time."""
_SPAN = 60
"""Places in the order by which a segment is moved, and views that are turned round together, at most."""
_DESCENT = 1_500_000
"""Orders tried in one descent, at most."""


@dataclass(frozen=True, eq=False)
class Legs:
    """What lies between a start, row 0, and k views, rows 1 to k.

    Attributes:
        lengths: (k+1, k+1) of the ways, m.
        leave: (k+1, k+1, 3) unit vectors in which they set out.
        turns: (k+1, k+1) times that the boresight takes from one to the other, s.
        speed: m/s.
        acceleration: m/s².
        dwell: at every view, s.
        begin: time at the start, s.
        windows: (k+1, w, 2) s, ordered; rows filled up with nan.

    """

    lengths: Float[np.ndarray, "n n"]
    leave: Float[np.ndarray, "n n 3"]
    turns: Float[np.ndarray, "n n"]
    speed: float
    acceleration: float
    dwell: float
    begin: float
    windows: Float[np.ndarray, "n w 2"]


@dataclass(frozen=True, eq=False)
class Tour:
    """An order and what it costs.

    Attributes:
        order: (k,) rows of the legs, none of them 0.
        times: (k,) at which each view is worth something: on arrival, or when the light comes, s; inf if never.
        length: m.
        end: time at the end, s.
        delta_v: m/s.

    """

    order: Int[np.ndarray, " k"]
    times: Float[np.ndarray, " k"]
    length: float
    end: float
    delta_v: float

    def cost(self, objective: Objective, worth: float) -> float:
        """Give what an objective counts, beside views that come too late; `worth` is of Δv, s per m/s."""
        time_weight, delta_v_weight = _weights(objective, worth)
        return time_weight * self.end + delta_v_weight * self.delta_v


def _weights(objective: Objective, worth: float) -> tuple[float, float]:
    """Give what a second counts, and what 1 m/s does."""
    return {"time": (1.0, 100.0 * _SIDE), "delta_v": (_SIDE, 100.0), "both": (1.0, worth)}[objective]


def turning_time(
    first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "m 3"], rate: float, acceleration: float
) -> Float[np.ndarray, "n m"]:
    """Give the times (s) from rest to rest between boresights, at bounded rate (rad/s) and acceleration (rad/s²)."""
    angle = np.arccos(np.clip(first @ second.T, -1.0, 1.0))
    short = angle < rate * rate / acceleration
    return np.where(short, 2.0 * np.sqrt(angle / acceleration), angle / rate + rate / acceleration)


def flown(legs: Legs, order: Int[np.ndarray, " k"]) -> Tour:
    """Give what an order costs."""
    times = np.empty(len(order))
    length, end, delta_v, _ = _fly(np.asarray(order, dtype=np.int64), *_packed(legs), times)
    return Tour(np.asarray(order), times, length, end, delta_v)


def best_tour(
    legs: Legs,
    objective: Objective = "time",
    *,
    worth: float = 1000.0,
    seed: int = 0,
    begin: Int[np.ndarray, " k"] | None = None,
    shaken: bool = True,
) -> Tour:
    """Order the views: nearest first, then segments moved and turned round while that helps, then shaken.

    Where a view has to be reached at a time, what comes later depends on it, and fewer orders are looked at.

    Args:
        legs: between start and views.
        objective: what is made least.
        worth: of Δv, s per m/s, where both count.
        seed: of the shaking.
        begin: (k,) an order to begin with instead.
        shaken: whether to go on once no move helps, where no view has to be reached at a time.

    """
    count = len(legs.lengths) - 1
    if count == 0:
        return flown(legs, np.zeros(0, dtype=np.int64))
    weights = _weights(objective, worth)
    begin = nearest_first(legs) if begin is None else begin
    if _at_any_time(legs):
        return flown(legs, _searched(legs, begin, *weights, _SHAKES if shaken else 0, seed))
    shakes = int(np.clip(_WORK / (20.0 * count**3), 0, 400))
    cuts = np.sort(np.random.default_rng(seed).integers(0, count + 1, (shakes, 3)), axis=1)
    order = _improved(begin, *weights, *_packed(legs), cuts)
    return flown(legs, order)


def _at_any_time(legs: Legs) -> bool:
    """Whether no place has to be reached at a time."""
    return bool(np.all((legs.windows[:, 0, 0] <= legs.begin) & np.isposinf(legs.windows[:, 0, 1])))


def _searched(
    legs: Legs, begin: Int[np.ndarray, " k"], time_weight: float, delta_v_weight: float, shakes: int, seed: int
) -> Int[np.ndarray, " k"]:
    lengths, leave, turns, _, _ = _packed(legs)
    taken = np.maximum(np.maximum(lengths / legs.speed, turns), 1e-9)
    return best_order(
        begin,
        time_weight * taken,
        lengths / taken,
        leave,
        change=0.5 * time_weight / legs.acceleration + delta_v_weight,
        stops=legs.dwell > 0.0,
        shakes=shakes,
        seed=seed,
    )


def nearest_first(legs: Legs) -> Int[np.ndarray, " k"]:
    """Give the order in which the nearest view comes next, whatever the light."""
    left = np.ones(len(legs.lengths), dtype=bool)
    left[0] = False
    order, here = [], 0
    while left.any():
        cost = np.where(left, np.maximum(legs.lengths[here] / legs.speed, legs.turns[here]), np.inf)
        here = int(np.argmin(cost)) if np.isfinite(cost).any() else int(np.flatnonzero(left)[0])
        order.append(here)
        left[here] = False
    return np.array(order, dtype=np.int64)


def least_length(lengths: Float[np.ndarray, "n n"]) -> float:
    """Bound from below the length of any open path over all places, m: that of the least tree that joins them."""
    return float(minimum_spanning_tree(np.where(np.isfinite(lengths), lengths, 1e12)).sum())


_Packed = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _packed(legs: Legs) -> _Packed:
    lengths = np.where(np.isfinite(legs.lengths), legs.lengths, _LATE)
    numbers = np.array([legs.speed, legs.acceleration, legs.dwell, legs.begin])
    return lengths, legs.leave, legs.turns, legs.windows, numbers


@numba.njit(cache=True)
@no_type_check
def _fly(order, lengths, leave, turns, windows, numbers, times):
    """Length, end, Δv and seconds of lateness; writes the time of each view."""
    speed, acceleration, dwell, begin = numbers
    now, length, delta_v, late = begin, 0.0, 0.0, 0.0
    here = 0
    vx, vy, vz = 0.0, 0.0, 0.0
    for place in range(order.size):
        to = order[place]
        way = lengths[here, to]
        taken = max(way / speed, turns[here, to], 1e-9)
        pace = way / taken
        ox, oy, oz = pace * leave[here, to, 0], pace * leave[here, to, 1], pace * leave[here, to, 2]
        change = np.sqrt((ox - vx) ** 2 + (oy - vy) ** 2 + (oz - vz) ** 2)
        delta_v += change
        now += taken + 0.5 * change / acceleration
        length += way
        # The way back from there leaves against the direction in which this one arrives.
        vx, vy, vz = -pace * leave[to, here, 0], -pace * leave[to, here, 1], -pace * leave[to, here, 2]
        best, wait = np.inf, 0.0
        for w in range(windows.shape[1]):
            # A nan window compares false.
            if now + dwell <= windows[to, w, 1]:
                best = max(now, windows[to, w, 0])
                wait = best - now
                break
        times[place] = best
        if best == np.inf:
            late += _LATE
        if wait + dwell > 0.0:
            delta_v += pace
            now += wait + dwell + 0.5 * pace / acceleration
            vx, vy, vz = 0.0, 0.0, 0.0
        here = to
    # The end is at rest.
    rest = np.sqrt(vx * vx + vy * vy + vz * vz)
    return length, now + 0.5 * rest / acceleration, delta_v + rest, late


@numba.njit(cache=True)
@no_type_check
def _cost(order, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers, times):
    _, end, delta_v, late = _fly(order, lengths, leave, turns, windows, numbers, times)
    return time_weight * (end - numbers[3]) + delta_v_weight * delta_v + late


@numba.njit(cache=True)
@no_type_check
def _moved(order, first, last, to, turned, out):
    """Write the order with the segment first..last (both in it) before what is at `to` among the rest."""
    count, size = order.size, last - first + 1
    read, write = 0, 0
    for place in range(count - size + 1):
        if place == to:
            for k in range(size):
                out[write] = order[last - k] if turned else order[first + k]
                write += 1
        if place == count - size:
            break
        if read == first:
            read += size
        out[write] = order[read]
        write += 1
        read += 1


@numba.njit(cache=True)
@no_type_check
def _descend(order, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers):
    count = order.size
    times, tried = np.empty(count), np.empty(count, dtype=np.int64)
    best = _cost(order, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers, times)
    better, trials = True, 0
    while better:
        better = False
        # Segments of up to three, either way round, to anywhere; and any segment turned round where it is.
        for first in range(count):
            for size in range(1, min(count - first, _SPAN) + 1):
                last = first + size - 1
                low, high = first, first
                if size <= 3:
                    low, high = max(first - _SPAN, 0), min(first + _SPAN, count - size)
                for to in range(low, high + 1):
                    for turned in range(2):
                        if (to == first and turned == 0) or (size == 1 and turned == 1):
                            continue
                        if trials >= _DESCENT * 60 // max(count, 60):
                            return best
                        trials += 1
                        _moved(order, first, last, to, turned == 1, tried)
                        cost = _cost(tried, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers, times)
                        if cost < best - 1e-9:
                            best = cost
                            order[:] = tried
                            better = True
    return best


@numba.njit(cache=True)
@no_type_check
def _improved(order, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers, cuts_of):
    count = order.size
    best_order = order.copy()
    best = _descend(best_order, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers)
    if count < 4:
        return best_order
    for shake in range(len(cuts_of)):
        # Two neighbouring segments change places (the double bridge of Martin, Otto & Felten 1991).
        cuts = cuts_of[shake]
        tried = np.concatenate(
            (best_order[: cuts[0]], best_order[cuts[1] : cuts[2]], best_order[cuts[0] : cuts[1]], best_order[cuts[2] :])
        )
        cost = _descend(tried, time_weight, delta_v_weight, lengths, leave, turns, windows, numbers)
        if cost < best - 1e-9:
            best = cost
            best_order = tried
    return best_order


def waits_never(count: int) -> Float[np.ndarray, "n 1 2"]:
    """Give the windows of `count` places at which light does not matter."""
    return np.tile(np.array([[[-math.inf, math.inf]]]), (count, 1, 1))

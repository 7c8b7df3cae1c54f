"""The order in which views are flown: an open path from the start, least in time, in Δv, or in both.

A leg takes as long as its way takes at the speed flown, or as the boresight takes to turn if that is longer; then it
is flown slower. At a view the velocity changes from that of one leg to that of the next, which costs Δv = |change| and,
with the acceleration a, half of Δv / a in time. Where the chaser stays it stops: from motion to rest, and on from rest.

The cost of an order is a sum over legs and over places between two legs. So a move is judged by the few legs that it
changes: a stretch of the order turned round (2-opt), or up to three places moved elsewhere (Or-opt), either towards a
near neighbour. Where none helps, neighbouring stretches change places (the double bridge of Martin, Otto & Felten
1991), and what is no better than before is undone. In these loops orders are arrays with the start, place 0, first and
`_NONE` at both outer ends: `order[0]` is `_NONE`, `order[1]` is 0. What is paid is a tuple: the cost of each leg, its
velocity, the cost of a change of velocity, and whether the chaser stops at each place.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from keepout.core.cores import kernel
from keepout.core.geometry.distance import Points

Objective = Literal["time", "delta_v", "both"]
_SHUT_OFF = 1e7
"""Metres that a way is taken for where none leads."""
_SIDE = 1e-3
"""Of the other quantity (s, or 100 m/s of Δv), what an objective counts of it so that ties are broken by it."""
_SHAKES = 3000
"""Of an order."""
_NONE = -1
_NEIGHBOURS = 8
"""Places next to which a place is tried."""
_LONGEST = 3
"""Places that are moved together, at most."""
_STRETCH = 50
"""Places that a shake exchanges on either side, at most."""


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

    """

    lengths: Float[np.ndarray, "n n"]
    leave: Float[np.ndarray, "n n 3"]
    turns: Float[np.ndarray, "n n"]
    speed: float
    acceleration: float
    dwell: float
    begin: float


@dataclass(frozen=True, eq=False)
class Tour:
    """An order and what it costs.

    Attributes:
        order: (k,) rows of the legs, none of them 0.
        times: (k,) at which each view is worth something: on arrival, or when the light comes, s.
        end: time at the end, s.
        delta_v: m/s.

    """

    order: Int[np.ndarray, " k"]
    times: Float[np.ndarray, " k"]
    end: float
    delta_v: float

    def cost(self, objective: Objective, worth: float) -> float:
        """Give what an objective counts; `worth` is of Δv, s per m/s."""
        time_weight, delta_v_weight = weights(objective, worth)
        return time_weight * self.end + delta_v_weight * self.delta_v


def weights(objective: Objective, worth: float, *, side: float = 100.0 * _SIDE) -> tuple[float, float]:
    """Give what a second counts, and what 1 m/s does: `side` where time is made least; `worth` where both count."""
    return {"time": (1.0, side), "delta_v": (_SIDE, 100.0), "both": (1.0, worth)}[objective]


def turning_time(
    first: Points, second: Float[np.ndarray, "m 3"], rate: float, acceleration: float
) -> Float[np.ndarray, "n m"]:
    """Give the times (s) from rest to rest between boresights, at bounded rate (rad/s) and acceleration (rad/s²)."""
    angle = np.arccos(np.clip(first @ second.T, -1.0, 1.0))
    short = angle < rate * rate / acceleration
    return np.where(short, 2.0 * np.sqrt(angle / acceleration), angle / rate + rate / acceleration)


def flown(legs: Legs, order: Int[np.ndarray, " k"]) -> Tour:
    """Give what an order costs."""
    times = np.empty(len(order))
    numbers = np.array([legs.speed, legs.acceleration, legs.dwell, legs.begin])
    ways = _finite(legs.lengths), legs.leave, legs.turns
    end, delta_v = _fly(np.asarray(order, dtype=np.int64), *ways, numbers, times)
    return Tour(np.asarray(order), times, end, delta_v)


def best_tour(
    legs: Legs,
    objective: Objective = "time",
    *,
    worth: float = 1000.0,
    seed: int = 0,
    begin: Int[np.ndarray, " k"] | None = None,
    shaken: bool = True,
) -> Tour:
    """Order the views in a light that does not change: nearest first, then moves while they help, then shaken.

    Args:
        legs: between start and views.
        objective: what is made least.
        worth: of Δv, s per m/s, where both count.
        seed: of the shaking.
        begin: (k,) an order to begin with instead.
        shaken: whether to go on once no move helps.

    """
    order = nearest_first(legs) if begin is None else begin
    count = len(order)
    if count < 2:
        return flown(legs, order)
    time_weight, delta_v_weight = weights(objective, worth)
    lengths = _finite(legs.lengths)
    taken = np.maximum(np.maximum(lengths / legs.speed, legs.turns), 1e-9)
    costs, velocities = time_weight * taken, (lengths / taken)[..., None] * legs.leave
    change = 0.5 * time_weight / legs.acceleration + delta_v_weight
    padded = np.concatenate([[_NONE, 0], order, [_NONE]]).astype(np.int64)
    nearest = np.argsort(costs + np.diag(np.full(count + 1, np.inf)), axis=1)[:, : min(_NEIGHBOURS, count)]
    draws = np.random.default_rng(seed).random((_SHAKES if shaken else 0, 4))
    _search(padded, (costs, velocities, float(change), legs.dwell > 0.0), nearest.astype(np.int64), draws)
    return flown(legs, padded[2:-1])


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


def _finite(lengths: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    return np.where(np.isfinite(lengths), lengths, _SHUT_OFF)


@kernel()
def _fly(order, lengths, leave, turns, numbers, times):
    """End and Δv; writes the time of each view."""
    speed, acceleration, dwell, begin = numbers
    now, delta_v = begin, 0.0
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
        # The way back from there leaves against the direction in which this one arrives.
        vx, vy, vz = -pace * leave[to, here, 0], -pace * leave[to, here, 1], -pace * leave[to, here, 2]
        times[place] = now
        if dwell > 0.0:
            delta_v += pace
            now += dwell + 0.5 * pace / acceleration
            vx, vy, vz = 0.0, 0.0, 0.0
        here = to
    # The end is at rest.
    rest = np.sqrt(vx * vx + vy * vy + vz * vz)
    return now + 0.5 * rest / acceleration, delta_v + rest


@kernel()
def _corner(a, p, b, paid):
    """Give what the change of velocity at p costs, from a on to b; where one of them is none, from rest or to rest."""
    if p < 0:
        return 0.0
    _, v, change, stops = paid
    # The way back from p towards a leaves against the direction in which the way from a arrives.
    ix, iy, iz = 0.0, 0.0, 0.0
    ox, oy, oz = 0.0, 0.0, 0.0
    if a >= 0:
        ix, iy, iz = -v[p, a, 0], -v[p, a, 1], -v[p, a, 2]
    if b >= 0:
        ox, oy, oz = v[p, b, 0], v[p, b, 1], v[p, b, 2]
    if stops:
        return change * (np.sqrt(ix * ix + iy * iy + iz * iz) + np.sqrt(ox * ox + oy * oy + oz * oz))
    return change * np.sqrt((ox - ix) ** 2 + (oy - iy) ** 2 + (oz - iz) ** 2)


@kernel()
def _leg(a, b, paid):
    return 0.0 if a < 0 or b < 0 else paid[0][a, b]


@kernel()
def _at(order, q, move):
    """Give what stands at q after a move: the stretch s to e stands right after what was at t, turned round or not.

    With t = s - 1 it stays where it is.
    """
    s, e, t, turned = move
    size = e - s + 1
    if t < s:
        begin = t + 1
        if q < begin or q > e:
            return order[q]
        if q >= begin + size:
            return order[q - size]
    else:
        begin = t + 1 - size
        if q < s or q > t:
            return order[q]
        if q < begin:
            return order[q + size]
    return order[e - (q - begin)] if turned else order[s + (q - begin)]


@kernel()
def _summed(total, sign, before, order, move, paid):
    """Add what the legs after some places of a moved order cost, and the changes of velocity at their ends, once."""
    last = -1
    for k in range(3):
        j = before[k]
        if k > 0 and j == before[k - 1]:
            continue
        total += sign * _leg(_at(order, j, move), _at(order, j + 1, move), paid)
        for p in range(max(j, last + 1), j + 2):
            after = _at(order, p + 1, move) if p + 1 < order.size else _NONE
            total += sign * _corner(_at(order, p - 1, move), _at(order, p, move), after, paid)
            last = p
    return total


@kernel()
def _gain(order, move, paid):
    """Give how much less the order costs after a move."""
    s, e, t, _ = move
    size = e - s + 1
    if t < s - 1:
        old, new = (t, s - 1, e), (t, t + size, e)
    elif t == s - 1:
        old, new = (s - 1, s - 1, e), (s - 1, s - 1, e)
    else:
        old, new = (s - 1, e, t), (s - 1, t - size, t)
    before = _summed(0.0, 1.0, old, order, (s, e, s - 1, False), paid)
    return _summed(before, -1.0, new, order, move, paid)


@kernel()
def _put(order, place, move, spare):
    """Move a stretch."""
    s, e, t, _ = move
    low, high = min(s, t + 1), max(e, t)
    for q in range(low, high + 1):
        spare[q] = _at(order, q, move)
    for q in range(low, high + 1):
        order[q] = spare[q]
        place[order[q]] = q


@kernel()
def _better(here, order, place, paid, nearest, spare):
    """Make the first move found that brings a place beside a near one and helps; give what it gains, or 0."""
    end = order.size - 1
    for n in range(nearest.shape[1]):
        beside = nearest[here, n]
        i, j = place[here], place[beside]
        # No leg that is worse than both legs here gains more than the corner here costs, but by luck elsewhere.
        a, b = order[i - 1], order[i + 1]
        longest = max(_leg(a, here, paid), _leg(here, b, paid))
        if _leg(here, beside, paid) > longest + _corner(a, here, b, paid):
            break
        low, high = min(i, j), max(i, j)
        # Turned round, so that the two come to stand side by side: after the first, or before the second.
        for s, e in ((low + 1, high), (low, high - 1)):
            if s >= 2 and e > s and e < end:
                move = (s, e, s - 1, True)
                gain = _gain(order, move, paid)
                if gain > 1e-9:
                    _put(order, place, move, spare)
                    return gain
        for size in range(1, _LONGEST + 1):
            for lead in range(2):
                s = i if lead else i - size + 1
                e = s + size - 1
                if s < 2 or e >= end or (s <= j <= e) or (size == 1 and lead):
                    continue
                for t in (j - 1, j):
                    if t < 1 or t >= end or s - 1 <= t <= e:
                        continue
                    for turned in range(2):
                        if size == 1 and turned:
                            continue
                        move = (s, e, t, turned == 1)
                        gain = _gain(order, move, paid)
                        if gain > 1e-9:
                            _put(order, place, move, spare)
                            return gain
    return 0.0


@kernel()
def _descend(order, place, waiting, paid, nearest, spare):
    """Improve about the places that wait until none helps; give the gain."""
    total, number = 0.0, place.size
    left = 0
    for p in range(number):
        left += waiting[p]
    at = 0
    while left > 0:
        here = order[1 + at % number]
        at += 1
        if not waiting[here]:
            continue
        gain = _better(here, order, place, paid, nearest, spare)
        if gain == 0.0:
            waiting[here] = False
            left -= 1
            continue
        total += gain
        # What stands about the place now may have moves that it had not.
        for q in range(max(place[here] - 2, 1), min(place[here] + 3, order.size - 1)):
            if not waiting[order[q]]:
                waiting[order[q]] = True
                left += 1
    return total


@kernel()
def _search(order, paid, nearest, draws):
    number = order.size - 2
    place = np.empty(number, dtype=np.int64)
    for q in range(1, order.size - 1):
        place[order[q]] = q
    spare = np.empty_like(order)
    waiting = np.ones(number, dtype=np.bool_)
    _descend(order, place, waiting, paid, nearest, spare)
    count = number - 1
    if count < 4:
        return
    kept = order.copy()
    for shake in range(len(draws)):
        # Stretches s to m and m + 1 to e change places: the first is put after the second.
        span = min(_STRETCH, count // 2)
        first = 1 + int(draws[shake, 0] * span)
        second = 1 + int(draws[shake, 1] * span)
        s = 2 + int(draws[shake, 2] * (count - first - second + 1))
        m, e = s + first - 1, s + first + second - 1
        move = (s, m, e, False)
        gain = _gain(order, move, paid)
        ends = (order[s - 1], order[s], order[m], order[m + 1], order[e], order[e + 1])
        _put(order, place, move, spare)
        for p in ends:
            if p >= 0:
                waiting[p] = True
        gain += _descend(order, place, waiting, paid, nearest, spare)
        for q in range(order.size):
            if gain > 1e-9:
                kept[q] = order[q]
            else:
                order[q] = kept[q]
        if gain <= 1e-9:
            for q in range(1, order.size - 1):
                place[order[q]] = q

"""Search for an order of hundreds of places whose cost is a sum over legs and over places between two legs.

That holds where no place must be reached at a time. So a move is judged by the few legs that it changes: a stretch of
the order turned round (2-opt), or up to three places moved elsewhere (Or-opt), either towards a near neighbour. Where
none helps, neighbouring stretches change places (the double bridge of Martin, Otto & Felten 1991), and what is no
better than before is undone.

Orders are arrays with the start, place 0, first and `_NONE` at both outer ends: `order[0]` is `_NONE`, `order[1]` is 0.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int

_NONE = -1
_NEIGHBOURS = 8
"""Places next to which a place is tried."""
_LONGEST = 3
"""Places that are moved together, at most."""
_STRETCH = 50
"""Places that a shake exchanges on either side, at most."""


def best_order(
    order: Int[np.ndarray, " k"],
    legs: Float[np.ndarray, "n n"],
    paces: Float[np.ndarray, "n n"],
    leave: Float[np.ndarray, "n n 3"],
    *,
    change: float,
    stops: bool,
    shakes: int,
    seed: int,
) -> Int[np.ndarray, " k"]:
    """Improve an order of the places 1 to k from place 0 on.

    Args:
        order: to begin with.
        legs: what it costs to go from one to the other, the same both ways.
        paces: speed on the way, m/s, the same both ways.
        leave: unit vectors in which the ways set out.
        change: cost of a change of velocity, by m/s.
        stops: whether the velocity falls to zero at every place.
        shakes: how many.
        seed: of the shaking.

    Returns:
        (k,) an order that costs no more.

    """
    count = len(order)
    if count < 2:
        return order.copy()
    padded = np.concatenate([[_NONE, 0], order, [_NONE]]).astype(np.int64)
    nearest = np.argsort(legs + np.diag(np.full(count + 1, np.inf)), axis=1)[:, : min(_NEIGHBOURS, count)]
    draws = np.random.default_rng(seed).random((shakes, 4))
    velocities = paces[..., None] * leave
    _search(padded, legs, velocities, float(change), stops, nearest.astype(np.int64), draws)
    return padded[2:-1]


@numba.njit(cache=True)
@no_type_check
def _corner(a, p, b, v, change, stops):
    """Give what the change of velocity at p costs, from a on to b; where one of them is none, from rest or to rest."""
    if p < 0:
        return 0.0
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


@numba.njit(cache=True)
@no_type_check
def _leg(a, b, legs):
    return 0.0 if a < 0 or b < 0 else legs[a, b]


@numba.njit(cache=True)
@no_type_check
def _at(order, q, s, e, t, turned):
    """Give what stands at q once the stretch s to e stands right after what was at t, turned round or not.

    With t = s - 1 it stays where it is.
    """
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


@numba.njit(cache=True)
@no_type_check
def _gain(order, s, e, t, turned, legs, v, change, stops):
    """Give how much less the order costs once the stretch s to e stands right after what was at t."""
    size = e - s + 1
    if t < s - 1:
        old, new = (t, s - 1, e), (t, t + size, e)
    elif t == s - 1:
        old, new = (s - 1, s - 1, e), (s - 1, s - 1, e)
    else:
        old, new = (s - 1, e, t), (s - 1, t - size, t)
    gain = 0.0
    last = -1
    for k in range(3):
        j = old[k]
        if k > 0 and old[k] == old[k - 1]:
            continue
        gain += _leg(order[j], order[j + 1], legs)
        for p in range(max(j, last + 1), j + 2):
            gain += _corner(order[p - 1], order[p], order[p + 1], v, change, stops)
            last = p
    last = -1
    for k in range(3):
        j = new[k]
        if k > 0 and new[k] == new[k - 1]:
            continue
        gain -= _leg(_at(order, j, s, e, t, turned), _at(order, j + 1, s, e, t, turned), legs)
        for p in range(max(j, last + 1), j + 2):
            a = _at(order, p - 1, s, e, t, turned)
            b = _at(order, p + 1, s, e, t, turned) if p + 1 < order.size else _NONE
            gain -= _corner(a, _at(order, p, s, e, t, turned), b, v, change, stops)
            last = p
    return gain


@numba.njit(cache=True)
@no_type_check
def _put(order, place, s, e, t, turned, spare):
    """Put the stretch s to e right after what is at t."""
    low, high = min(s, t + 1), max(e, t)
    for q in range(low, high + 1):
        spare[q] = _at(order, q, s, e, t, turned)
    for q in range(low, high + 1):
        order[q] = spare[q]
        place[order[q]] = q


@numba.njit(cache=True)
@no_type_check
def _better(here, order, place, legs, v, change, stops, nearest, spare):
    """Make the first move found that brings a place beside a near one and helps; give what it gains, or 0."""
    end = order.size - 1
    for n in range(nearest.shape[1]):
        beside = nearest[here, n]
        i, j = place[here], place[beside]
        # No leg that is worse than both legs here gains more than the corner here costs, but by luck elsewhere.
        a, b = order[i - 1], order[i + 1]
        if legs[here, beside] > max(_leg(a, here, legs), _leg(here, b, legs)) + _corner(a, here, b, v, change, stops):
            break
        low, high = min(i, j), max(i, j)
        # Turned round, so that the two come to stand side by side: after the first, or before the second.
        for s, e in ((low + 1, high), (low, high - 1)):
            if s >= 2 and e > s and e < end:
                gain = _gain(order, s, e, s - 1, True, legs, v, change, stops)
                if gain > 1e-9:
                    _put(order, place, s, e, s - 1, True, spare)
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
                        gain = _gain(order, s, e, t, turned == 1, legs, v, change, stops)
                        if gain > 1e-9:
                            _put(order, place, s, e, t, turned == 1, spare)
                            return gain
    return 0.0


@numba.njit(cache=True)
@no_type_check
def _descend(order, place, waiting, legs, v, change, stops, nearest, spare):
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
        gain = _better(here, order, place, legs, v, change, stops, nearest, spare)
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


@numba.njit(cache=True)
@no_type_check
def _search(order, legs, v, change, stops, nearest, draws):
    number = order.size - 2
    place = np.empty(number, dtype=np.int64)
    for q in range(1, order.size - 1):
        place[order[q]] = q
    spare = np.empty_like(order)
    waiting = np.ones(number, dtype=np.bool_)
    _descend(order, place, waiting, legs, v, change, stops, nearest, spare)
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
        gain = _gain(order, s, m, e, False, legs, v, change, stops)
        ends = (order[s - 1], order[s], order[m], order[m + 1], order[e], order[e + 1])
        _put(order, place, s, m, e, False, spare)
        for p in ends:
            if p >= 0:
                waiting[p] = True
        gain += _descend(order, place, waiting, legs, v, change, stops, nearest, spare)
        if gain > 1e-9:
            kept[:] = order
        else:
            order[:] = kept
            for q in range(1, order.size - 1):
                place[order[q]] = q

"""The fewest views that see enough: greedy, then better, and a proved bound below which no choice of them goes.

A choice S of the candidates sees enough if the area of the units that some view of S sees is at least the goal. With
x_v = 1 for a view that is taken and m_u the share of unit u (area a_u) that is let go, B the area that may be missed:

    minimise Σ x_v   subject to   Σ_{v sees u} x_v + m_u ≥ 1 for every unit u,   Σ a_u m_u ≤ B,   0 ≤ m_u ≤ 1.

Program and relaxation are solved by HiGHS (Huangfu & Hall 2018) as SciPy has it, by counted work. The bound of the
relaxation is recomputed here from the solver's prices π_u ≥ 0 and λ ≥ 0 alone, by the Lagrangian, which is a bound
whatever the prices are (`price_value`). That of an exact solution is the solver's.
"""

import heapq
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.optimize import Bounds, linprog, milp

from keepout.apps.inspection.seeing.patches import Areas
from keepout.core.progress import Progress, silent

_ROUNDING = 1e-6
"""What a bound on a number of views loses before it is rounded up: far above the rounding of its sums."""
_FIRST_ROWS, _ROWS_AT_ONCE = 3000, 1500
"""Units that the relaxation asks for at first, and those that are added each time."""
_STEPS, _SHAKES, _NODES = 60_000, 600, 200
"""Of the simplex in all relaxations, of the shaking, and of the exact search, at most and usually."""
_LARGEST = 20_000
"""Entries of a program that is solved exactly, at most: a larger one takes long before its first node."""
_TAKEN_OUT = (2, 7)
"""How many views a shake takes out, from and below."""
_AMONG = 4000
"""Views that `shortlist` keeps unless told otherwise."""
_NO_VIEWS = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Cover:
    """A choice of views.

    Attributes:
        chosen: (k,) rows of the matrix, in the order of what each adds.
        fewest: proved: no fewer of the matrix's rows reach the goal.
        greedy: how many the greedy choice took.

    """

    chosen: Int[np.ndarray, " k"]
    fewest: int
    greedy: int


def fewest_views(
    sees: sparse.csr_array,
    areas: Areas,
    goal: float,
    *,
    effort: float = 1.0,
    seed: int = 0,
    progress: Progress = silent,
) -> Cover:
    """Choose few views that see at least `goal` of the area, and bound how few could.

    All work is counted and no clock is read, so that the answer is the same however fast or busy the machine is.

    Args:
        sees: (views, units) non-zero where a view sees a unit.
        areas: (units,) m²; 0 for what nobody asks to see.
        goal: m² to be seen; what all the views see together if that is less.
        effort: of the usual numbers of simplex steps, shakes and nodes, how much is spent.
        seed: of the shaking.
        progress: told the best number and the bound.

    """
    sees, areas = merged_units(sees, np.asarray(areas, dtype=np.float64))
    goal = min(float(goal), float(areas.sum())) * (1.0 - 1e-12)
    if goal <= 0.0:
        return Cover(np.zeros(0, dtype=np.int64), 0, 0)
    covering = Covering(sees, areas, goal)
    first = covering.completed(_NO_VIEWS)
    progress(0.02, f"{len(first)} views by greed")
    bound, reduced = covering.greedy_bound(first), np.ones(len(sees.indptr) - 1)
    best = covering.pruned(first)
    # The units that the fewest views see say most about how many are needed; then those that an answer misses.
    rows = np.argsort(np.asarray(sees.sum(axis=0)).ravel(), kind="stable")[:_FIRST_ROWS]
    steps = round(effort * _STEPS)
    while len(best) > bound and len(rows):
        answer = covering.relaxed(rows, steps)
        if answer is None:
            break
        steps -= answer.steps
        value, costs = covering.price_value(answer.prices, answer.area_price)
        if _rounded_up(value) >= bound:
            # With a view of reduced cost c, no choice has fewer views than the value and c.
            bound, reduced = _rounded_up(value), value + costs
        best = min(best, covering.pruned(covering.completed(np.flatnonzero(answer.taken > 0.5))), key=len)
        progress(0.3, f"{len(best)} views, at least {bound}")
        missed = np.maximum(1.0 - sees.T @ answer.taken, 0.0)
        missed[rows] = 0.0
        fresh = np.flatnonzero(missed > 1e-6)
        if not len(fresh) or steps <= 0:
            break
        rows = np.concatenate([rows, fresh[np.argsort(-(areas * missed)[fresh], kind="stable")[:_ROWS_AT_ONCE]]])
    best = covering.shaken(best, bound, most=round(effort * _SHAKES), seed=seed)
    progress(0.7, f"{len(best)} views, at least {bound}")
    # A choice with fewer views than the best has none but these.
    fit = np.flatnonzero(reduced <= len(best) - 1 + _ROUNDING)
    if len(best) > bound and sees[fit].nnz <= _LARGEST:
        taken, least = Covering(sees[fit], areas, goal).exact(round(effort * _NODES))
        bound = max(bound, min(least, len(best)))
        if taken is not None and covering.seen(chosen := fit[taken > 0.5]) >= goal:
            best = min(best, covering.pruned(chosen), key=len)
    progress(1.0, f"{len(best)} views, at least {min(bound, len(best))}")
    order = Covering(sees[best], areas, np.inf).completed(_NO_VIEWS)
    order = np.concatenate([order, np.setdiff1d(np.arange(len(best)), order)]).astype(np.int64)
    return Cover(best[order], min(bound, len(best)), len(first))


def greedy_cover(sees: sparse.csr_array, areas: Areas, goal: float) -> Int[np.ndarray, " k"]:
    """Take the view that adds most, again and again, until the goal is seen."""
    return Covering(sees, areas, goal).completed(_NO_VIEWS)


class Relaxed(NamedTuple):
    """A solution of the relaxation.

    Attributes:
        taken: 0 to 1.
        prices: 0 for units without a row.
        area_price: of the area let go, 1/m².
        steps: that the simplex took.

    """

    taken: Float[np.ndarray, " views"]
    prices: Float[np.ndarray, " units"]
    area_price: float
    steps: int


@dataclass(frozen=True, eq=False)
class Covering:
    """Views of which some are to see enough.

    Attributes:
        sees: (views, units) 1 where a view sees a unit.
        areas: (units,) m².
        goal: m² to be seen.

    """

    sees: sparse.csr_array
    areas: Areas
    goal: float

    @property
    def _spare(self) -> float:
        """That may be let go, m²."""
        return float(self.areas.sum()) - self.goal

    def units(self, view: int | np.integer) -> Int[np.ndarray, " k"]:
        """Give what a view sees."""
        return self.sees.indices[self.sees.indptr[view] : self.sees.indptr[view + 1]]

    def seen(self, chosen: Int[np.ndarray, " m"]) -> float:
        """Give the area that some views see, m²."""
        return float(self.areas[np.asarray(self.sees[chosen].sum(axis=0)).ravel() > 0.0].sum())

    def completed(
        self, kept: Int[np.ndarray, " m"], weights: Float[np.ndarray, " units"] | None = None, most: int | None = None
    ) -> Int[np.ndarray, " k"]:
        """Add views by greed until the goal is seen, nothing adds, or there are `most`.

        A view's gain is computed anew only when it comes to the top.
        """
        open_worth, open_area = (self.areas if weights is None else weights).copy(), self.areas.copy()
        taken = [int(view) for view in kept]
        for view in taken:
            open_worth[self.units(view)] = open_area[self.units(view)] = 0.0
        missing = self.goal - float(self.areas.sum() - open_area.sum())
        queue = [(-gain, view) for view, gain in enumerate(map(float, self.sees @ open_worth)) if gain > 0.0]
        heapq.heapify(queue)
        while missing > 0.0 and queue and (most is None or len(taken) < most):
            _, view = queue[0]
            units = self.units(view)
            gain = float(open_worth[units].sum())
            if gain <= 0.0:
                heapq.heappop(queue)
                continue
            heapq.heapreplace(queue, (-gain, view))
            if queue[0][1] != view:
                continue
            heapq.heappop(queue)
            missing -= float(open_area[units].sum())
            open_worth[units] = open_area[units] = 0.0
            taken.append(view)
        return np.array(taken, dtype=np.int64)

    def pruned(self, chosen: Int[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
        """Leave out views, the least missed first, while the rest see the goal."""
        chosen = np.unique(chosen)
        times = np.asarray(self.sees[chosen].sum(axis=0)).ravel()
        seen = float(self.areas[times > 0].sum())
        while len(chosen) > 1:
            alone = self.sees[chosen] @ np.where(times == 1, self.areas, 0.0)
            least = int(np.argmin(alone))
            if seen - alone[least] < self.goal:
                break
            seen -= float(alone[least])
            times[self.units(chosen[least])] -= 1
            chosen = np.delete(chosen, least)
        return chosen

    def shaken(self, chosen: Int[np.ndarray, " m"], fewest: int, *, most: int, seed: int = 0) -> Int[np.ndarray, " k"]:
        """Take some views out and fill up by greed, again and again; keep what is fewer, or as many and sees more.

        It ends with `fewest` views, or after `most` times.
        """
        generator = np.random.default_rng(seed)
        best, score = chosen, (-len(chosen), self.seen(chosen))
        for _ in range(most):
            if len(best) <= max(fewest, 1):
                break
            out = int(generator.integers(*_TAKEN_OUT))
            # Half the time views that see the same as one of them: neighbours are what one view may replace.
            if generator.random() < 0.5:
                kept = generator.permutation(best)[min(out, len(best) - 1) :]
            else:
                shared = self.sees[best] @ (self.sees[best[[generator.integers(len(best))]]].T @ np.ones(1))
                kept = best[np.argsort(shared + generator.random(len(best)))[: max(len(best) - out, 1)]]
            weights = self.areas * generator.uniform(0.8, 1.2, len(self.areas))
            fresh = self.pruned(self.completed(kept, weights, len(best)))
            seen = self.seen(fresh)
            if seen >= self.goal and (-len(fresh), seen) > score:
                best, score = fresh, (-len(fresh), seen)
        return best

    def greedy_bound(self, order: Int[np.ndarray, " k"]) -> int:
        """Bound from below how many views see the goal, by diminishing returns along a greedy order.

        After the views of a prefix of `order`, m more add at most the sum of the m greatest gains; so m views in all
        see at most the prefix's area plus that sum (Nemhauser, Wolsey & Fisher 1978, before their simplification).
        """
        uncovered, seen, bound = self.areas.copy(), 0.0, 1
        for step in range(len(order) + 1):
            gains = np.sort(self.sees @ uncovered)[::-1]
            reached = seen + np.cumsum(gains)
            enough = int(np.searchsorted(reached, self.goal * (1.0 - 1e-9))) + 1
            bound = max(bound, enough if seen < self.goal else 1)
            if step < len(order):
                units = self.units(order[step])
                seen += float(uncovered[units].sum())
                uncovered[units] = 0.0
        return bound

    def price_value(
        self, unit_prices: Float[np.ndarray, " units"], area_price: float
    ) -> tuple[float, Float[np.ndarray, " views"]]:
        """Bound from below how many views see the goal, by any prices.

        With π ≥ 0 and λ ≥ 0 the Lagrangian's least value over 0 ≤ x, m ≤ 1 is
        Σ π_u − λ B + Σ_v min(0, 1 − Σ_{u seen by v} π_u) + Σ_u min(0, λ a_u − π_u), which is at most the number of
        views.

        Returns:
            That value, and by how much it is greater at least for choices that have a view, the view's reduced cost:
            max(0, 1 − Σ_{u seen by v} π_u).

        """
        prices, area_price = np.maximum(unit_prices, 0.0), max(area_price, 0.0)
        costs = 1.0 - self.sees @ prices
        value = prices.sum() - area_price * self._spare
        value += np.minimum(0.0, costs).sum() + np.minimum(0.0, area_price * self.areas - prices).sum()
        return float(value), np.maximum(costs, 0.0)

    def relaxed(self, rows: Int[np.ndarray, " k"], iterations: int) -> Relaxed | None:
        """Solve the program for some units with x_v between 0 and 1, in so many steps of the dual simplex at most.

        None if these do not suffice.
        """
        costs, matrix, limits, scale = self._written(rows)
        options = {"maxiter": iterations}
        found = linprog(costs, A_ub=matrix, b_ub=limits, bounds=(0.0, 1.0), method="highs-ds", options=options)
        if found.status != 0:
            return None
        prices, dual = np.zeros(len(self.areas)), -np.asarray(found.ineqlin.marginals)
        prices[rows] = dual[: len(rows)]
        area_price = float(dual[-1]) / scale if self._spare > 0.0 else 0.0
        return Relaxed(np.asarray(found.x)[: len(self.sees.indptr) - 1], prices, area_price, int(found.nit))

    def exact(self, nodes: int) -> tuple[Float[np.ndarray, " views"] | None, int]:
        """Solve it with x_v 0 or 1, in so many nodes of the search; give the choice found, if any, and HiGHS's bound.

        A choice that does not exist has an infinite bound, given as one more than there are views.
        """
        costs, matrix, limits, _ = self._written(np.arange(len(self.areas)))
        bounds, rows, views = Bounds(0.0, 1.0), (matrix, -np.inf, limits), len(self.sees.indptr) - 1
        found = milp(costs, integrality=costs, bounds=bounds, constraints=rows, options={"node_limit": nodes})
        if found.status == 2:
            return None, views + 1
        bound = found.mip_dual_bound
        bound = math.ceil(bound - 1e-6) if bound is not None and math.isfinite(bound) else 0
        return (None if found.x is None else np.round(np.asarray(found.x)[:views])), bound

    def _written(
        self, rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " variables"], sparse.csr_array, Float[np.ndarray, " rows"], float]:
        """Give what each of (x, m) costs, 1 or 0, a matrix, what its product with them must not exceed, and a scale.

        Areas count as shares of that, the largest, so that the row's numbers stay near 1. Without spare area there is
        no m.
        """
        by_unit, views, count = sparse.csr_array(self.sees.T)[rows], len(self.sees.indptr) - 1, len(rows)
        least, scale = -np.ones(count), float(self.areas.max())
        if not self._spare > 0.0:
            return np.ones(views), -by_unit, least, scale
        let_go = sparse.csr_array((self.areas[rows] / scale)[None])
        matrix = [
            sparse.hstack([-by_unit, -sparse.eye_array(count)]),
            sparse.hstack([sparse.csr_array((1, views)), let_go]),
        ]
        costs = np.append(np.ones(views), np.zeros(count))
        return costs, sparse.csr_array(sparse.vstack(matrix)), np.append(least, self._spare / scale), scale


def shortlist(sees: sparse.csr_array, areas: Areas, most: int = _AMONG) -> Int[np.ndarray, " k"]:
    """Give the views, at most about `most`, that a good choice comes from: greedy covers, each without those before.

    What all see together they see together too: the first cover is complete.
    """
    left = np.arange(len(sees.indptr) - 1)
    kept: list[Int[np.ndarray, " _"]] = []
    found = 0
    while len(left) and found < most:
        part = sees[left]
        reachable = float(areas[np.asarray(part.sum(axis=0)).ravel() > 0].sum())
        if reachable <= 0.0:
            break
        order = greedy_cover(part, areas, reachable * (1.0 - 1e-12))
        if found:
            order = order[: most - found]
        kept.append(left[order])
        found += len(order)
        left = np.delete(left, order)
    return np.sort(np.concatenate(kept)) if kept else left


def merged_units(sees: sparse.csr_array, areas: Areas) -> tuple[sparse.csr_array, Float[np.ndarray, " classes"]]:
    """Join units that exactly the same views see, adding their areas; leave out those without area or view."""
    columns = sparse.csc_array(sees)[:, areas > 0.0]
    areas = areas[areas > 0.0]
    counts = np.diff(columns.indptr)
    columns, areas = columns[:, counts > 0], areas[counts > 0]
    if columns.shape[1] == 0:
        return sparse.csr_array(columns), areas
    columns.sort_indices()
    marks = np.random.default_rng(0).integers(1, 2**63, columns.shape[0], dtype=np.uint64)
    sums = np.add.reduceat(marks[columns.indices], columns.indptr[:-1])
    order = np.argsort(sums, kind="stable")
    first = np.ones(len(order), dtype=bool)
    for place in np.flatnonzero(sums[order][1:] == sums[order][:-1]) + 1:
        one, other = order[place - 1], order[place]
        a = columns.indices[columns.indptr[one] : columns.indptr[one + 1]]
        b = columns.indices[columns.indptr[other] : columns.indptr[other + 1]]
        first[place] = not np.array_equal(a, b)
    starts = np.flatnonzero(first)
    joined = sparse.csr_array(columns[:, order[starts]], dtype=np.float64)
    joined.data[:] = 1.0
    return joined, np.add.reduceat(areas[order], starts)


def _rounded_up(value: float) -> int:
    return math.ceil(value - _ROUNDING)

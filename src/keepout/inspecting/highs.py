"""The covering program in HiGHS (Huangfu & Hall 2018), whose rows of units are added as they are needed."""

import math
from dataclasses import dataclass

import highspy
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse


@dataclass(frozen=True, eq=False)
class CoverAnswer:
    """What a solution says.

    Attributes:
        taken: (views,) 0 to 1.
        prices: of the units, 0 for those without a row, and of the area let go; all 0 after an exact solution.
        fewest: the solver's own bound, rounded up, after an exact solution; else 0.

    """

    taken: Float[np.ndarray, " views"]
    prices: tuple[Float[np.ndarray, " units"], float]
    fewest: int


class CoverProgram:
    """Minimise Σ x_v, Σ_{v sees u} x_v + m_u ≥ 1 for the units that have a row, Σ a_u m_u ≤ spare.

    Args:
        sees: (views, units).
        areas: (units,) m².
        spare: that may be let go, m².

    """

    def __init__(self, sees: sparse.csr_array, areas: Float[np.ndarray, " units"], spare: float) -> None:
        self._by_unit = sparse.csr_array(sees.T)
        self._areas = areas
        # Shares of the spare area, so that the row's numbers stay near 1.
        self._scale = float(areas.max())
        self._views = len(sees.indptr) - 1
        self.has = np.zeros(len(areas), dtype=bool)
        self._rows: list[Int[np.ndarray, " _"]] = []
        self._solver = highspy.Highs()
        self._solver.setOptionValue("output_flag", False)
        self._solver.setOptionValue("threads", 1)
        self._solver.addVars(self._views, np.zeros(self._views), np.ones(self._views))
        self._solver.changeColsCost(self._views, np.arange(self._views, dtype=np.int32), np.ones(self._views))
        self._solver.addRow(-highspy.kHighsInf, spare / self._scale, 0, np.zeros(0, dtype=np.int32), np.zeros(0))
        self._lets_go = spare > 0.0

    def add(self, units: Int[np.ndarray, " k"]) -> None:
        """Add the rows of units that have none yet."""
        units = units[~self.has[units]]
        if len(units) == 0:
            return
        self.has[units] = True
        first = self._views + sum(len(rows) for rows in self._rows)
        most = self._areas[units] / self._scale
        count = len(units)
        self._solver.addCols(
            count,
            np.zeros(count),
            np.zeros(count),
            np.full(count, 1.0 if self._lets_go else 0.0),
            count,
            np.arange(count, dtype=np.int32),
            np.zeros(count, dtype=np.int32),
            most,
        )
        rows = self._by_unit[units]
        starts = (rows.indptr[:-1] + np.arange(count)).astype(np.int32)
        index = np.insert(rows.indices, rows.indptr[1:], np.arange(first, first + count)).astype(np.int32)
        self._solver.addRows(
            count, np.ones(count), np.full(count, highspy.kHighsInf), len(index), starts, index, np.ones(len(index))
        )
        self._rows.append(units)

    def solve(self, seconds: float, *, exact: bool) -> CoverAnswer | None:
        """Solve it with x_v between 0 and 1, or, if `exact`, 0 or 1; None if the time gives no solution."""
        solver = self._solver
        kind = highspy.HighsVarType.kInteger if exact else highspy.HighsVarType.kContinuous
        kinds = np.full(self._views, int(kind), dtype=np.uint8)
        index = np.arange(self._views, dtype=np.int32)
        solver.changeColsIntegrality(self._views, index, kinds)
        solver.setOptionValue("time_limit", max(seconds, 0.1))
        solver.run()
        solution = solver.getSolution()
        prices = np.zeros(len(self._areas))
        if exact:
            found = solver.getInfo().primal_solution_status == 2
            if not found:
                return None
            taken = np.round(np.array(solution.col_value[: self._views]))
            bound = solver.getInfo().mip_dual_bound  # infinite where the time ended before there was one
            return CoverAnswer(taken, (prices, 0.0), math.ceil(bound - 1e-6) if math.isfinite(bound) else 0)
        if solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return None
        dual = np.array(solution.row_dual)
        prices[np.concatenate(self._rows)] = dual[1:]
        return CoverAnswer(np.array(solution.col_value[: self._views]), (prices, -float(dual[0]) / self._scale), 0)

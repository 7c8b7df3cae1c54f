"""The covering program and its relaxation, solved by HiGHS (Huangfu & Hall 2018) as SciPy has it, by counted work."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.optimize import Bounds, linprog, milp


@dataclass(frozen=True, eq=False)
class Relaxed:
    """A solution of the relaxation.

    Attributes:
        taken: (views,) 0 to 1.
        prices: of the units, 0 for those without a row.
        area_price: of the area let go, 1/m².
        steps: that the simplex took.

    """

    taken: Float[np.ndarray, " views"]
    prices: Float[np.ndarray, " units"]
    area_price: float
    steps: int


@dataclass(frozen=True, eq=False)
class CoverProgram:
    """Minimise Σ x_v, Σ_{v sees u} x_v + m_u ≥ 1 for some units u, Σ a_u m_u ≤ spare, 0 ≤ m_u ≤ 1.

    Attributes:
        sees: (views, units).
        areas: (units,) m².
        spare: that may be let go, m².
        rows: (k,) units that are asked for.

    """

    sees: sparse.csr_array
    areas: Float[np.ndarray, " units"]
    spare: float
    rows: Int[np.ndarray, " k"]

    def relaxed(self, iterations: int) -> Relaxed | None:
        """Solve it with x_v between 0 and 1, in so many steps of the dual simplex; None if these do not suffice."""
        costs, matrix, limits = self._written()
        found = linprog(
            costs,
            A_ub=matrix,
            b_ub=limits,
            bounds=(0.0, 1.0),
            method="highs-ds",
            options={"maxiter": iterations},
        )
        if found.status != 0:
            return None
        prices = np.zeros(len(self.areas))
        dual = -np.asarray(found.ineqlin.marginals)
        prices[self.rows] = dual[: len(self.rows)]
        area_price = float(dual[-1]) / self._scale if self.spare > 0.0 else 0.0
        return Relaxed(np.asarray(found.x)[: self._views], prices, area_price, int(found.nit))

    def exact(self, nodes: int) -> tuple[Float[np.ndarray, " views"] | None, int]:
        """Solve it with x_v 0 or 1, in so many nodes of the search; give the choice found, if any, and HiGHS's bound.

        A choice that does not exist has an infinite bound, given as one more than there are views.
        """
        costs, matrix, limits = self._written()
        found = milp(
            costs,
            integrality=costs,
            bounds=Bounds(0.0, 1.0),
            constraints=(matrix, -np.inf, limits),
            options={"node_limit": nodes},
        )
        if found.status == 2:
            return None, self._views + 1
        bound = found.mip_dual_bound
        bound = math.ceil(bound - 1e-6) if bound is not None and math.isfinite(bound) else 0
        return (None if found.x is None else np.round(np.asarray(found.x)[: self._views])), bound

    @property
    def _views(self) -> int:
        return len(self.sees.indptr) - 1

    @property
    def _scale(self) -> float:
        """Areas count as shares of the largest, so that the row's numbers stay near 1."""
        return float(self.areas.max())

    def _written(
        self,
    ) -> tuple[Float[np.ndarray, " variables"], sparse.csr_array, Float[np.ndarray, " rows"]]:
        """Give what each of (x, m) costs, 1 or 0, a matrix, and what its product with them must not exceed.

        Without spare area there is no m.
        """
        by_unit = sparse.csr_array(self.sees.T)[self.rows]
        least = -np.ones(len(self.rows))
        if not self.spare > 0.0:
            return np.ones(self._views), -by_unit, least
        count = len(self.rows)
        let_go = sparse.csr_array((self.areas[self.rows] / self._scale)[None])
        rows = [
            sparse.hstack([-by_unit, -sparse.eye_array(count)]),
            sparse.hstack([sparse.csr_array((1, self._views)), let_go]),
        ]
        costs = np.append(np.ones(self._views), np.zeros(count))
        return costs, sparse.csr_array(sparse.vstack(rows)), np.append(least, self.spare / self._scale)

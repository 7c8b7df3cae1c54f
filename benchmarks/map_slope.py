"""The slope of any map's field, proved: ‖∇f‖ ≤ L for the cubic B-spline of any 1-Lipschitz node data.

What is proved and why it is enough is in docs/mapping.md, "Its slope". In short, in units of h:

- By reflection a cell's gradients are those of its corner [0, ½]³. There ∇f = Σ c_i ∇w_i is a polynomial, and lies in
  the convex hull of its 64 Bernstein control vectors G_k = Σ c_i g_ik. By permutation those with k₁ ≤ k₂ ≤ k₃ stand for
  all.
- For a unit vector u, u·G_k = Σ_i a_i c_i with Σ a_i = 0. Over all c with |c_i − c_j| ≤ ‖x_i − x_j‖ it is at most what
  it costs to carry the positive a to the negative ones; any plan of transport is a bound, the cheapest one the least.
- That bound, as a function of u, is convex and grows in proportion to ‖u‖. So over a spherical triangle it is at most
  its largest value at the corners, divided by the distance of the corners' plane from the origin.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog
from scipy.sparse import csr_array

from keepout.core.errors import FieldError
from keepout.core.progress import Progress, silent

_NODES = np.array(list(itertools.product(range(4), repeat=3)))
_FARTHEST = 3.0 * math.sqrt(3.0)
"""Between two of the 64 nodes."""
_ROUNDING = 1e-9
"""Far more than float64 loses in sums of 64 numbers below 10."""
_VALUE = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0
_SLOPE = np.array([[-1, 2, -1, 0], [0, -4, 3, 0], [1, 2, -3, 0], [0, 0, 1, 0]]) / 2.0
"""Each of the four weights at t in [0, 1] of the middle cell, and its derivative, by powers of t."""


def control_vectors() -> Iterator[Float[np.ndarray, "3 64"]]:
    """Give G_k for k₁ ≤ k₂ ≤ k₃, each as the matrix that takes the 64 node values to it."""
    value, slope = _bernstein(_VALUE), _bernstein(_SLOPE)
    for k in itertools.combinations_with_replacement(range(4), 3):
        rows = []
        for axis in range(3):
            x, y, z = ((slope if other == axis else value)[:, k[other]] for other in range(3))
            rows.append(np.einsum("i,j,k->ijk", x, y, z).ravel())
        yield np.array(rows)


def _bernstein(powers: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Give polynomials in powers of t in Bernstein's form of degree 3 over [0, ½]."""
    to = np.array([[math.comb(i, m) / math.comb(3, m) * 0.5**m for m in range(4)] for i in range(4)])
    return powers @ to.T


class Transport:
    """Plans of transport between the 64 nodes, over arcs of at most one node along each axis, one after another."""

    def __init__(self) -> None:
        """Gather the arcs."""
        difference = _NODES[:, None] - _NODES[None]
        near = np.abs(difference).max(axis=-1) == 1
        self._start, self._end = np.nonzero(near)
        self._length = np.linalg.norm(difference[near], axis=-1)
        arcs = np.arange(len(self._length))
        signs = np.concatenate([np.ones(len(arcs)), -np.ones(len(arcs))])
        places = np.concatenate([self._start, self._end]), np.concatenate([arcs, arcs])
        self._balance = csr_array((signs, places), shape=(len(_NODES), len(arcs)))

    def cost(self, amounts: Float[np.ndarray, "64"]) -> float:
        """Bound Σ a_i c_i over all 1-Lipschitz c, for amounts a that sum to zero.

        The solver's plan need not be the cheapest, nor balance the amounts: what it leaves over is carried the longest
        way, so that its tolerances cannot make the bound too low.

        Raises:
            FieldError: the solver gave no plan.

        """
        found = linprog(self._length, A_eq=self._balance, b_eq=amounts, bounds=(0.0, None), method="highs")
        if found.x is None:
            raise FieldError(f"map slope: no plan of transport: {found.message}")
        plan = np.maximum(found.x, 0.0)
        left = np.abs(amounts - self._balance @ plan).sum()
        return float(self._length @ plan + _FARTHEST * left + _ROUNDING)


def prove_slope(limit: float, *, most: int = 100_000, progress: Progress = silent) -> float:
    """Prove that no map's field is steeper than a limit; return the bound proved, which is at most that.

    Args:
        limit: the L to prove.
        most: plans of transport to make before giving up.
        progress: called as the work goes on.

    Raises:
        FieldError: a gradient as steep as the limit is not excluded; the message says what is in the way.

    """
    transport, worst, made = Transport(), 0.0, 0
    vectors = list(control_vectors())
    for number, vector in enumerate(vectors):
        progress(number / len(vectors), "slope of the map's field")
        costs: dict[tuple[float, ...], float] = {}

        def cost(u: Float[np.ndarray, "3"], vector=vector, costs=costs) -> float:
            # The cost of −u is that of u: every plan can be turned round.
            first = u[np.nonzero(np.abs(u) > 1e-12)[0][0]]
            key = tuple(np.round(u * np.sign(first), 12))
            if key not in costs:
                costs[key] = transport.cost(u @ vector)
            return costs[key]

        waiting = [np.diag([1.0, y, z]) for y in (1.0, -1.0) for z in (1.0, -1.0)]
        while waiting:
            corners = waiting.pop()
            bound = max(cost(u) for u in corners) / _distance_of_plane(corners)
            if bound <= limit:
                worst = max(worst, bound)
                continue
            if max(cost(u) for u in corners) > limit or made + len(costs) > most:
                raise FieldError(
                    f"map slope: {bound:.4f} is not excluded by {made + len(costs)} plans; limit {limit:g}"
                )
            waiting.extend(_halves(corners))
        made += len(costs)
    progress(1.0, "slope of the map's field")
    return worst


def _distance_of_plane(corners: Float[np.ndarray, "3 3"]) -> float:
    """Give the distance from the origin of the plane through three points, less its rounding."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    return float(abs(normal @ corners[0]) / np.linalg.norm(normal)) * (1.0 - _ROUNDING)


def _halves(corners: Float[np.ndarray, "3 3"]) -> list[Float[np.ndarray, "3 3"]]:
    """Cut a spherical triangle in two across its longest side."""
    sides = [np.linalg.norm(corners[(i + 1) % 3] - corners[i]) for i in range(3)]
    i = int(np.argmax(sides))
    a, b, c = corners[i], corners[(i + 1) % 3], corners[(i + 2) % 3]
    middle = (a + b) / np.linalg.norm(a + b)
    return [np.array([a, middle, c]), np.array([middle, b, c])]

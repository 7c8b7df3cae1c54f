"""What force a layout can give, whole and with one thruster stuck: linear programs over mean on-times."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linprog

from keepout.core.motion.thrusters.layout import Layout

Stuck = Literal["off", "on"]

_CORNERS = np.array(np.meshgrid(*[[1.0, -1.0]] * 3)).reshape(3, -1).T


@dataclass(frozen=True)
class Capability:
    """The force boxes of a layout: the largest c for which every force of at most c an axis can be given, N.

    Attributes:
        whole: with all thrusters.
        stuck_off: with each thruster stuck off, one entry a thruster.
        stuck_on: with each stuck on; the others hold against it.

    """

    whole: float
    stuck_off: tuple[float, ...]
    stuck_on: tuple[float, ...]

    @classmethod
    def of(cls, layout: Layout, *, torque_free: bool = False) -> "Capability":
        """Work out all boxes of a layout, with whatever torque or without any."""

        def box(thruster: int | None = None, stuck: Stuck = "off") -> float:
            return force_box(layout, thruster, stuck, torque_free=torque_free)

        each = range(layout.count)
        return cls(box(), tuple(box(i, "off") for i in each), tuple(box(i, "on") for i in each))

    @property
    def after_failure(self) -> float:
        """What is left whichever thruster sticks, off or on, N."""
        return min(*self.stuck_off, *self.stuck_on)


def force_box(layout: Layout, thruster: int | None = None, stuck: Stuck = "off", *, torque_free: bool = False) -> float:
    """Give the largest c (N) for which every force of at most c an axis is a mean force of the layout; 0 for none.

    Forces that can be given are a convex set, so the box is in it where its eight corners are: one linear program with
    c and the on-times of each corner.

    Args:
        layout: the thrusters.
        thruster: the one that is stuck, or None.
        stuck: how.
        torque_free: whether the torques must cancel too.

    """
    if thruster is not None:
        layout.require(thruster)
    effects, count = layout.pushes(), layout.count
    if torque_free:
        effects = np.hstack([effects, layout.torques()])
    rows = effects.shape[1]
    lower, upper = np.zeros(count), np.ones(count)
    if thruster is not None:
        lower[thruster] = upper[thruster] = float(stuck == "on")
    size = len(_CORNERS) * count + 1
    matrix = np.zeros((len(_CORNERS) * rows, size))
    for k, corner in enumerate(_CORNERS):
        block = slice(k * rows, (k + 1) * rows)
        matrix[block, k * count : (k + 1) * count] = effects.T
        matrix[k * rows : k * rows + 3, -1] = -corner
    # In units of the strongest thruster, so that the solver's tolerances are relative.
    scale = float(layout.force.max())
    if scale == 0.0:
        return 0.0
    matrix[:, :-1] /= scale
    bounds = [*zip(np.tile(lower, len(_CORNERS)), np.tile(upper, len(_CORNERS)), strict=True), (0.0, None)]
    cost = np.zeros(size)
    cost[-1] = -1.0
    found = linprog(cost, A_eq=matrix, b_eq=np.zeros(len(matrix)), bounds=bounds, method="highs")
    return scale * float(found.x[-1]) if found.status == 0 and found.x[-1] > 1e-9 else 0.0

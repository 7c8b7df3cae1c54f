"""Which guidance a law is to have; the law makes it once its keep-out zone and speeds are known."""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from keepout.core.control.guidance.geodesic import BarrierGrid, geodesic_guidance
from keepout.core.control.guidance.guidance import ComponentwiseGuidance, Guidance, StraightGuidance
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field, values
from keepout.core.motion.arrays import as_float64
from keepout.core.progress import Progress, silent

Point = Float[np.ndarray, "3"]
Corners = tuple[Sequence[float] | Point, Sequence[float] | Point]


class GuidancePlan(abc.ABC):
    """Makes a `Guidance` for a law's keep-out zone {field ≤ offset}, its speed and its slowing length."""

    @abc.abstractmethod
    def guidance(
        self,
        field: Field,
        offset: float,
        goal: Point,
        *,
        speed: float,
        slowing_length: float,
        start: Point | None = None,
        progress: Progress = silent,
    ) -> Guidance:
        """Make the guidance.

        Args:
            field: the law's.
            offset: of the law's barrier h = field − offset, m.
            goal: (3,) m, body frame, outside the keep-out zone.
            speed: v_max, m/s.
            slowing_length: k_p, m.
            start: (3,) m, where given, must be connected to the goal.
            progress: called while it is made.

        Raises:
            ControlError: the goal cannot be led to.

        """


@dataclass(frozen=True)
class Straight(GuidancePlan):
    """Straight to the goal, whatever is between (`StraightGuidance`)."""

    def guidance(
        self,
        field: Field,
        offset: float,
        goal: Point,
        *,
        speed: float,
        slowing_length: float,
        start: Point | None = None,
        progress: Progress = silent,
    ) -> Guidance:
        """Make the guidance; the field is not asked."""
        return StraightGuidance(*_leading(goal, speed, slowing_length))


@dataclass(frozen=True)
class Componentwise(GuidancePlan):
    """The paper's: straight to the goal, component by component (`ComponentwiseGuidance`)."""

    def guidance(
        self,
        field: Field,
        offset: float,
        goal: Point,
        *,
        speed: float,
        slowing_length: float,
        start: Point | None = None,
        progress: Progress = silent,
    ) -> Guidance:
        """Make the guidance; the field is not asked."""
        return ComponentwiseGuidance(*_leading(goal, speed, slowing_length))


@dataclass(frozen=True)
class Geodesic(GuidancePlan):
    """Along the shortest free way round the keep-out zone (`GeodesicGuidance`).

    Attributes:
        spacing: of the grid of travel times, m; by default from the room and the zone's width.
        bounds: (lower, upper) corners of that grid, m; by default a box around target, goal and start.
        grid: a `BarrierGrid` to share between goals, instead of both; made for the same offset.
        beyond: travel seconds (at 1 m/s in free room) more than twice those from the start, from where on the guidance
            leads away from the obstacle only: a flight that stays about its way needs no more of the grid.

    """

    spacing: float | None = None
    bounds: Corners | None = None
    grid: BarrierGrid | None = None
    beyond: float = math.inf

    def guidance(
        self,
        field: Field,
        offset: float,
        goal: Point,
        *,
        speed: float,
        slowing_length: float,
        start: Point | None = None,
        progress: Progress = silent,
    ) -> Guidance:
        """Make the guidance: seconds for the grid, where it is not given."""
        grid = self.grid
        if grid is None:
            lower, upper = room_around(field, offset, goal, start) if self.bounds is None else self.bounds
            grid = BarrierGrid.build(field, offset, lower, upper, spacing=self.spacing, progress=progress)
        motion = {"speed": speed, "slowing_length": slowing_length}
        return geodesic_guidance(grid, field, offset, goal, **motion, start=start, beyond=self.beyond)


def _leading(goal: Point, speed: float, slowing_length: float):
    return jnp.asarray(goal), as_float64(speed), as_float64(slowing_length)


def room_around(field: Field, offset: float, goal: Point, start: Point | None) -> tuple[Point, Point]:
    """Find a box around goal, start and all where the barrier is below 1.5 m, by growing until its faces are clear.

    A distance is 1-Lipschitz, so a face is clear where its samples exceed 1.5 m by half their spacing.

    Raises:
        ControlError: the keep-out zone has no end near the target.

    """
    points = np.stack([goal, np.zeros(3)] + ([] if start is None else [start]))
    lower, upper = points.min(axis=0) - 2.0, points.max(axis=0) + 2.0
    fractions = np.linspace(0.0, 1.0, 33)
    for _ in range(60):
        grown = False
        for axis in range(3):
            others = [a for a in range(3) if a != axis]
            u, v = np.meshgrid(fractions, fractions, indexing="ij")
            face = np.empty((u.size, 3))
            for other, fraction in zip(others, (u, v), strict=True):
                face[:, other] = lower[other] + fraction.ravel() * (upper[other] - lower[other])
            for side, edge in ((-1.0, lower), (1.0, upper)):
                face[:, axis] = edge[axis]
                gap = float(np.min(values(field, face))) - offset
                spread = 0.5 * float(np.hypot(*(upper[o] - lower[o] for o in others))) / 32.0
                if gap < 1.5 + spread:
                    edge[axis] += side * max(1.0, 1.5 + spread - gap)
                    grown = True
        if not grown:
            return lower, upper
    raise ControlError(
        "guidance bounds: the keep-out zone has no end near the target; give bounds=(lower, upper) in metres"
    )

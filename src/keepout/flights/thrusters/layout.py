"""Where each thruster sits, which way it pushes and how well: a layout, three that come with Keepout, and their force.

The chaser's attitude is not simulated. Its axes are assumed parallel to the target's body axes, so that a thruster's
direction is one of the axes that forces are commanded in.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linprog

from keepout.core.errors import ScenarioError

STANDARD_GRAVITY = 9.80665
"""m/s², by which a specific impulse in seconds is turned into an exhaust velocity."""
MOST = 32
"""Thrusters of a layout."""
_SAME = 1e-9
"""Within which two unit directions are one."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Thrusters of one chaser.

    Attributes:
        position: of each from the chaser's centre of mass, m, body axes.
        direction: of the force that each puts on the chaser, made unit here.
        force: of each while it is on, N; 0 for one that has failed.
        least_on_time: the shortest pulse, s.
        specific_impulse: s.
        rise_delay: by which a pulse begins and ends after its command, s.
        misalignment: largest angle between a thruster's force and its direction, rad.
        scale_error: largest relative error of a thruster's force.

    Raises:
        ScenarioError: a number outside its range, or directions that do not span three axes.

    """

    position: Float[np.ndarray, "thrusters 3"]
    direction: Float[np.ndarray, "thrusters 3"]
    force: Float[np.ndarray, " thrusters"]
    least_on_time: float = 0.02
    specific_impulse: float = 70.0
    rise_delay: float = 0.0
    misalignment: float = 0.0
    scale_error: float = 0.0

    def __post_init__(self) -> None:
        """Check each number against its range, and make the directions unit."""
        position, direction = (np.asarray(value, float) for value in (self.position, self.direction))
        force = np.asarray(self.force, float)
        count = len(force)
        if position.shape != (count, 3) or direction.shape != (count, 3) or not 1 <= count <= MOST:
            raise ScenarioError(
                f"thrusters: {position.shape} positions, {direction.shape} directions and {force.shape} forces; there "
                f"must be one of each for each of 1 to {MOST} thrusters"
            )
        length = np.linalg.norm(direction, axis=1)
        if not (np.isfinite(position).all() and np.isfinite(length).all() and (length > 0.0).all()):
            raise ScenarioError("thrusters: a position or direction is not finite, or a direction has no length")
        if not (np.isfinite(force).all() and (force >= 0.0).all()):
            raise ScenarioError(f"thrusters: forces {force.tolist()} N; they must be finite and not negative")
        for name, least, unit in (("least_on_time", 0.0, "s"), ("rise_delay", 0.0, "s"), ("scale_error", 0.0, "")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise ScenarioError(f"thrusters: {name} is {value} {unit}; it must be finite and at least {least:g}")
        if not (math.isfinite(self.specific_impulse) and self.specific_impulse > 0.0):
            raise ScenarioError(f"thrusters: specific_impulse is {self.specific_impulse} s; it must be positive")
        if not 0.0 <= self.misalignment <= 0.5 * math.pi:
            raise ScenarioError(f"thrusters: misalignment is {self.misalignment} rad; it must be from 0 to π/2")
        if not self.scale_error < 1.0:
            raise ScenarioError(f"thrusters: scale_error is {self.scale_error}; it must be below 1")
        direction = direction / length[:, None]
        least = float(np.linalg.svd(direction, compute_uv=False)[-1]) if count >= 3 else 0.0
        if least < 1e-6:
            raise ScenarioError(
                f"thrusters: the {count} directions do not span three axes (least singular value {least:.3g}); "
                "some force is out of reach whatever fires"
            )
        for name, value in (("position", position), ("direction", direction), ("force", force)):
            object.__setattr__(self, name, value)

    @property
    def count(self) -> int:
        """How many thrusters there are."""
        return len(self.force)

    def without(self, thruster: int) -> "Layout":
        """Give the same layout with one thruster that never fires.

        Raises:
            ScenarioError: there is no such thruster.

        """
        self.require(thruster)
        force = self.force.copy()
        force[thruster] = 0.0
        return replace(self, force=force)

    def require(self, thruster: int) -> None:
        """Refuse a number that is none of a thruster."""
        if not 0 <= thruster < self.count:
            raise ScenarioError(f"faults.thruster: {thruster}; this layout's thrusters are 0 to {self.count - 1}")

    def pushes(self) -> Float[np.ndarray, "thrusters 3"]:
        """Give the force of each while it is on, N."""
        return self.force[:, None] * self.direction

    def torques(self) -> Float[np.ndarray, "thrusters 3"]:
        """Give the torque of each about the centre of mass while it is on, N m."""
        return np.cross(self.position, self.pushes())

    def groups(self) -> tuple[Int[np.ndarray, " thrusters"], Float[np.ndarray, "groups 3"]]:
        """Give the number of the group of each thruster, and the direction that each group pushes in."""
        directions: list[np.ndarray] = []
        numbers = np.zeros(self.count, int)
        for thruster, direction in enumerate(self.direction):
            near = [k for k, other in enumerate(directions) if np.linalg.norm(direction - other) < _SAME]
            if not near:
                directions.append(direction)
            numbers[thruster] = near[0] if near else len(directions) - 1
        return numbers, np.array(directions)


PRESETS = ("six", "12", "24")
"""Names of the layouts that come with Keepout."""


def preset(name: str, *, force: float, arm: float, **numbers: float) -> Layout:
    """Make a layout by name: one, two or four thrusters for each direction of each axis.

    A thruster that pushes along +x sits on the −x side, at the distance `arm` from the centre of mass. `six` has it in
    the middle; `12` has two, half an arm to either side along the next axis; `24` has four, at the corners of a square
    with the side `arm`. All thrusters of a direction together give no torque. They are counted direction by direction,
    in the order +x, −x, +y, −y, +z, −z.

    Args:
        name: one of `PRESETS`.
        force: of each thruster, N.
        arm: m.
        **numbers: further entries of `Layout`.

    """
    half = 0.5 * arm
    shifts = {"six": ((0.0, 0.0),), "12": ((half, 0.0), (-half, 0.0))}
    shifts["24"] = ((half, half), (half, -half), (-half, half), (-half, -half))
    positions, directions = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            direction = sign * np.eye(3)[axis]
            for along, across in shifts[name]:
                side = along * np.eye(3)[(axis + 1) % 3] + across * np.eye(3)[(axis + 2) % 3]
                positions.append(side - arm * direction)
                directions.append(direction)
    return Layout(np.array(positions), np.array(directions), np.full(len(positions), force), **numbers)


def share(name: str) -> int:
    """Give how many thrusters of a preset push along each direction."""
    return {"six": 1, "12": 2, "24": 4}[name]


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

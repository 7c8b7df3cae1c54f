"""Which thrusters fire, and how long, for a force: the linear program of least propellant, solved beforehand.

Thrusters of one direction form a group. The groups' forces a solve

    minimise Σ a_g   subject to   Σ a_g d_g = u,   0 ≤ a_g ≤ F_g,

whose dual is to maximise λ·u − Σ F_g max(0, λ·d_g − 1) over λ in three dimensions: a concave function, linear between
the planes λ·d_g = 1, so that its largest value is at a point where three of them meet. Those points do not depend on u.
They are listed when a flight is built, each with the three groups that are neither off nor full there and with a as an
affine function of u; in flight the best point is looked up. With one thruster pair an axis that is the closed form of
each axis.

Within a group thrusters fire alike as far as their torques cancel, and only then those whose torque is left over.
"""

from itertools import combinations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import linprog

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.rotation import Vector
from keepout.core.motion.thrusters.layout import Layout

_FLAT = 1e-9
"""Below this determinant three unit directions lie in a plane."""
_LANES = 64
"""Values that are compared at once."""
_APART = 1e-7
"""Relative differences of the groups' costs, so that no four planes meet in a point."""


class Allocation(eqx.Module):
    """The list of points and what fires at each; build with `Allocation.of`.

    Attributes:
        price: λ of each point, one row a component.
        fee: Σ F_g max(0, λ·d_g − 1) of each point, N.
        slope: of the groups' forces by u.
        offset: the groups' forces at u = 0, N.
        largest: F_g, N.
        group: of each thruster.
        paired: share of its on-time that a thruster gets for each newton of its group up to `balanced`, 1/N.
        alone: the same beyond it.
        balanced: force of each group that comes without torque, N.

    """

    price: Float[Array, "3 points"]
    fee: Float[Array, " points"]
    slope: Float[Array, "points groups 3"]
    offset: Float[Array, "points groups"]
    largest: Float[Array, " groups"]
    group: Int[Array, " thrusters"]
    paired: Float[Array, " thrusters"]
    alone: Float[Array, " thrusters"]
    balanced: Float[Array, " groups"]

    @classmethod
    def of(cls, layout: Layout) -> "Allocation":
        """List the points of a layout.

        Raises:
            ScenarioError: the thrusters that work do not span three axes.

        """
        group, directions = layout.groups()
        largest = np.array([layout.force[group == g].sum() for g in range(len(directions))])
        points = [_point(directions, largest, chosen) for chosen in _triples(directions, largest)]
        if not points:
            raise ScenarioError("thrusters: those that work do not span three axes")
        weight = np.concatenate([_balanced(layout, np.flatnonzero(group == g)) for g in range(len(directions))])
        free = np.zeros(layout.count)
        free[np.argsort(group, kind="stable")] = weight
        balanced = np.array([(free * layout.force)[group == g].sum() for g in range(len(directions))])
        rest = largest - balanced
        on = layout.force > 0.0
        paired = np.where(on & (balanced[group] > 0.0), free / np.maximum(balanced[group], 1e-300), 0.0)
        alone = np.where(on & (rest[group] > 0.0), (1.0 - free) / np.maximum(rest[group], 1e-300), 0.0)
        price, fee, slope, offset = (np.stack(part) for part in zip(*points, strict=True))
        return cls(
            price=as_float64(price.T.copy()),
            fee=as_float64(fee),
            slope=as_float64(slope),
            offset=as_float64(offset),
            largest=as_float64(largest),
            group=jnp.asarray(group),
            paired=as_float64(paired),
            alone=as_float64(alone),
            balanced=as_float64(balanced),
        )

    def shares(self, force: Vector) -> Float[Array, " thrusters"]:
        """Give the share of the period, 0 to 1, for which each thruster is to be on for a mean force (N, body axes).

        Of a force out of reach as much is given as the groups chosen for it can.
        """
        best = _largest(self.price[0] * force[0] + self.price[1] * force[1] + self.price[2] * force[2] - self.fee)
        wanted = jnp.clip(self.slope[best] @ force + self.offset[best], 0.0, self.largest)
        balanced = jnp.minimum(wanted, self.balanced)
        rest = wanted - balanced
        return jnp.minimum(self.paired * balanced[self.group] + self.alone * rest[self.group], 1.0)

    def active(self) -> Bool[np.ndarray, "points groups"]:
        """Say of each point which groups can be on there, partly or fully."""
        return np.any(np.asarray(self.slope) != 0.0, axis=2) | (np.asarray(self.offset) > 0.0)


def _largest(values: Float[Array, " n"]) -> Int[Array, ""]:
    """Give the first place of the largest value, in lanes: several times as fast as `argmax` in XLA on a CPU."""
    count = values.shape[0]
    lanes = jnp.pad(values, (0, -count % _LANES), constant_values=-jnp.inf).reshape(-1, _LANES)
    best = jnp.max(jnp.max(lanes, axis=0))
    places = jnp.arange(lanes.size).reshape(lanes.shape)
    return jnp.min(jnp.min(jnp.where(lanes >= best, places, count - 1), axis=0))


def _triples(directions: Float[np.ndarray, "groups 3"], largest: Float[np.ndarray, " groups"]):
    """Yield the triples of groups that work and do not lie in a plane."""
    for chosen in combinations(np.flatnonzero(largest > 0.0), 3):
        if abs(np.linalg.det(directions[list(chosen)])) > _FLAT:
            yield [int(g) for g in chosen]


def _point(directions: np.ndarray, largest: np.ndarray, chosen: list[int]) -> tuple[np.ndarray, ...]:
    """Give λ, the fee, and slope and offset of the groups' forces, where the planes of three groups meet."""
    cost = 1.0 + _APART * np.modf(np.sqrt(2.0) * np.arange(1, len(directions) + 1))[0]
    price = np.linalg.solve(directions[chosen], cost[chosen])
    excess = directions @ price - cost
    excess[chosen] = 0.0
    full = np.where(excess > 0.0, largest, 0.0)
    inverse = np.linalg.inv(directions[chosen].T)
    slope = np.zeros((len(directions), 3))
    slope[chosen] = inverse
    offset = full.copy()
    offset[chosen] = -inverse @ (directions.T @ full)
    return price, np.asarray(full @ np.maximum(excess, 0.0)), slope, offset


def _balanced(layout: Layout, members: np.ndarray) -> np.ndarray:
    """Give the largest shares, 0 to 1, with which thrusters of one direction fire without torque together."""
    force, torque = layout.force[members], layout.torques()[members]
    scale = float(np.abs(torque).max(initial=0.0))
    if scale <= 1e-12 * max(float(force.max()), 1e-300):
        return np.ones(len(members))
    found = linprog(-force, A_eq=torque.T / scale, b_eq=np.zeros(3), bounds=(0.0, 1.0), method="highs")
    return np.where(found.x > 1e-9, np.minimum(found.x, 1.0), 0.0)

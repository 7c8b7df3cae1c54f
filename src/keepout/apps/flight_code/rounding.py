"""How far the rounding of double can move what the flight code computes: bounds, by the mission's own numbers.

What is computed is followed with two numbers each: a size that neither it nor the exact number exceeds, and an error
that lies between them. An operation adds to the error of its operands at most u = 2⁻⁵³ of its result's size, and a
function of `sources/keepout_math.c` at most `ELEMENTARY` u. Tests hold exp and log to less, and acos to twice that, as
counted here. The network is bounded by `core/proof/bounds.py`, which allows for any order of its sums.

A rounded place is an exact one nearby, so that only the field's slope turns it into an error of the value. For a spline
that slope is the largest of any of its cells. Where cells of two spacings meet, values may jump, with rounding and
without: the guard's `evaluation_error` counts the jumps (`core/guard/guard.py`).
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.grid import STORED, GridField
from keepout.core.fields.neural import NeuralField
from keepout.core.guard.braking import BrakingDesign
from keepout.core.guard.guard import Guard, GuardAssumptions
from keepout.core.proof.bounds import ELEMENTARY, UNIT64, Network, boxes, upper_bounds
from keepout.flights.thrusters.on_off import Allocation, OnOffThrusters

_BOXES = 12
"""Along each axis, into which a learned field's domain is cut."""
_MOST_ROUNDINGS = 12
"""From one step's state to the next one's, of a position or a velocity: those of `keepout_step_ahead` (4), of the
observer (6), of the difference to the plan. Counted by hand in the sources."""


@dataclasses.dataclass(frozen=True)
class Followed:
    """A number that is computed: no more than `size`, and within `error` of the exact one."""

    size: float
    error: float = 0.0

    def __add__(self, other: "Followed") -> "Followed":
        """Follow a sum, or a difference: the sizes are those of both."""
        size = self.size + other.size
        return _rounded(size, self.error + other.error)

    def __mul__(self, other: "Followed") -> "Followed":
        """Follow a product."""
        return _rounded(self.size * other.size, self.size * other.error + self.error * other.size)

    def over(self, divisor: "Followed", least: float) -> "Followed":
        """Follow a quotient by a number that is at least `least`."""
        size = self.size / least
        return _rounded(size, (self.error + size * divisor.error) / (least - divisor.error))

    def within(self, size: float) -> "Followed":
        """Take another bound of the size, where one is known."""
        return Followed(min(self.size, size), self.error)


def _rounded(size: float, error: float, units: float = 1.0) -> Followed:
    """Round a result once: a little is added for what these bounds round themselves."""
    return Followed((size + error) * (1.0 + 1e-12), (error + units * UNIT64 * (size + error)) * (1.0 + 1e-12))


def _exact(number: float) -> Followed:
    return Followed(abs(number))


def _root(square: Followed, least: float) -> Followed:
    """Follow the square root of a number that is at least `least`²."""
    return _rounded(math.sqrt(square.size), square.error / (2.0 * math.sqrt(least**2 - square.error)))


class Rounding(NamedTuple):
    """What rounding can do to a mission's flight code.

    Attributes:
        guard_field: to a value of the guard's field, as its tests compare it, m.
        law_field: to a value of the law's field, within its domain, m.
        force: to the force of a step, or to the motion that it is planned to lead to, as a force, N; with a layout to
            the mean force of its pulses besides.

    """

    guard_field: float
    law_field: float
    force: float


def of_spline(field: GridField, reach: float) -> float:
    """Bound the rounding of a value of a spline, m.

    Args:
        field: whose coefficients are those of the code's tables.
        reach: largest distance of a place from the body frame's origin, m.

    """
    cont = field.continuation
    coefficients = np.abs(np.asarray(field.coefficients, np.float64))
    weights = _weights()
    error_of_weights = 4.0 * max(weight.error for weight in weights)
    # Weights are not negative and their sum is 1, so that no sum of a row exceeds the largest coefficient.
    row = Followed(float(coefficients.max()))
    for _ in range(3):
        # Four products and three sums (the first is to nothing), each of no more than this size.
        row = Followed(row.size, row.error + row.size * (error_of_weights + 5.0 * UNIT64 * (1.0 + error_of_weights)))
    low = np.asarray(field.origin, np.float64)
    span = float(np.abs(low).max() + _learned_radius(cont) + np.abs(np.asarray(cont.centre)).max())
    # The place: in the domain (`keepout_into_domain`), then less the origin and over the spacing; all else is exact.
    moved = math.sqrt(3.0) * (_asked(cont) + 3.0 * UNIT64 * span)
    return _continued(cont, row, reach).error + _steepest(field) * moved


def _steepest(field: GridField) -> float:
    """Bound the slope of every cell: along an axis it is a mean of differences of neighbours over the spacing."""
    blocks = np.asarray(field.coefficients, np.float64).reshape(-1, STORED, STORED, STORED)
    most = 0.0
    for level, table in enumerate(field.tables):
        own = blocks[np.unique(np.asarray(table)[np.asarray(table) >= 0])]
        differences = [np.abs(np.diff(own, axis=axis)).max(initial=0.0) for axis in (1, 2, 3)]
        most = max(most, float(np.linalg.norm(differences)) / (float(field.spacing) * 2.0**level))
    return most


def _weights() -> list[Followed]:
    """Follow the four weights of `weights_of` (sources/keepout_spline.c)."""
    t = _exact(1.0)
    s = (_exact(1.0) + t).within(1.0)
    found = []
    for place in (s, t):
        outer = (place * place * place).over(_exact(6.0), 6.0)
        square = place * place
        inner = _exact(3.0) * (square * place) + _exact(6.0) * square + _exact(4.0)
        found += [outer, inner.over(_exact(6.0), 6.0)]
    return found


def of_network(field: NeuralField, reach: float) -> float:
    """Bound the rounding of a value of a learned field in double, m; see `of_spline`.

    No slope of the softplus exceeds 1, so that none of the network exceeds the product of its matrices' norms.
    """
    cont = field.continuation
    scale = float(field.scale)
    radius = _learned_radius(cont) / scale
    edges = np.linspace(-radius, radius, _BOXES + 1)
    half = radius / _BOXES
    centres = np.stack(np.meshgrid(*[edges[:-1] + half] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest = np.maximum(np.abs(centres) - half, 0.0)
    centres = centres[(nearest**2).sum(axis=1) <= radius**2]
    found = upper_bounds(Network.of(field.layers, field.beta), boxes(centres, np.full_like(centres, half)))
    own = float(found.evaluation_error.max())
    slope = math.prod(float(np.linalg.norm(np.asarray(W, np.float64), 2)) for W in field.layers.weights)
    largest = float(np.abs(found.upper).max()) + 2.0 * radius * slope
    value = _rounded(scale * largest, scale * own)
    moved = math.sqrt(3.0) * (_asked(cont) + 3.0 * UNIT64 * _learned_radius(cont))
    return _continued(cont, value, reach).error + slope * moved


def of_guard(guard: Guard, field_rounding: float) -> float:
    """Bound the rounding of the guard's tests, as one of the field's values, m.

    Args:
        guard: of which the numbers are.
        field_rounding: of a value, m.

    """
    reach, slope = reach_of(guard), guard.lipschitz
    # Of a value, and of what a test takes from it: L times the distance of two corners, each of which is rounded.
    corner = _MOST_ROUNDINGS * UNIT64 * reach * (guard.delay + 3)
    distance = Followed(2.0 * reach, 2.0 * math.sqrt(3.0) * corner + 6.0 * UNIT64 * 2.0 * reach)
    value = Followed(guard.threshold + 4.0 * slope * reach, field_rounding + slope * math.sqrt(3.0) * corner)
    test = value + value + _exact(slope) * distance + value
    return test.error


def of_force(guard: Guard) -> float:
    """Bound the rounding of a step's force, and of the motion planned under it, as a force, N.

    A motion that ends a period later (δ_r, δ_v) beside the planned one is one under an acceleration that is at most
    4 δ_r/T² + 3 δ_v/T larger: δ_v/T all the time, and for the rest of δ_r forth in one half of the period, and back.
    """
    a, design = guard.assumptions, guard.braking
    reach, authority = reach_of(guard), float(a.authority)
    speed = float(a.speed_limit + a.velocity_error) + a.period * authority
    place = math.sqrt(3.0) * _MOST_ROUNDINGS * UNIT64 * reach
    pace = math.sqrt(3.0) * _MOST_ROUNDINGS * UNIT64 * speed
    planned = 4.0 * place / a.period**2 + 3.0 * pace / a.period
    feedback = design.position_gain * place + design.velocity_gain * pace
    # Mass, clip and product: the command is divided by the mass, and the force is the product with it.
    given = 4.0 * UNIT64 * math.sqrt(3.0) * authority
    return float(a.mass * (planned + feedback + given))


def of_pulses(thrusters: OnOffThrusters) -> float:
    """Bound what rounding does to the mean force that pulses are commanded to give for a force within reach, N.

    The numbers of the tables are rounded too: what they miss of giving the force asked for is counted.

    Near the least on-time rounding decides whether a pulse is fired. Both answers are wrong by no more than the half of
    it that `thruster_errors` counts, and by what the on-time is rounded.
    """
    allocation, push = thrusters.allocation, np.asarray(thrusters.push)
    limit, group = float(thrusters.force_limit.max()), np.asarray(allocation.group)
    slope, offset, largest = (np.asarray(part) for part in (allocation.slope, allocation.offset, allocation.largest))
    force = np.linalg.norm(push, axis=1)
    directions = (push / force[:, None])[np.unique(group, return_index=True)[1]]
    # Each part of a group's force: the product, two sums and the offset.
    asked = np.abs(slope).sum(axis=2) * limit + np.abs(offset)
    groups = 4.0 * UNIT64 * float(asked.sum(axis=1).max())
    # A thruster's on-time, of no more than 1.5 periods with what is owed: what is left beside the balanced part, two
    # products, a sum, the product with the period, the sum with what is owed, and that. Numbers of the table: one each.
    on_times = 9.0 * 1.5 * UNIT64 * float(force.sum())
    shares = [np.bincount(group, part * force) for part in np.asarray([allocation.paired, allocation.alone])]
    used = [np.asarray(allocation.balanced), largest - np.asarray(allocation.balanced)]
    missed = [float((np.abs(share - 1.0) * size).sum()) for share, size in zip(shares, used, strict=True)]
    aside = float((np.linalg.norm(push - force[:, None] * directions[group], axis=1)).sum())
    # What the groups' forces at a point are together beside the force asked for.
    lost = np.abs(np.einsum("gi,pgj->pij", directions, slope) - np.eye(3)).sum(axis=2) * limit
    lost += np.abs(offset @ directions)
    tables = float(np.linalg.norm(lost, axis=1).max()) + sum(missed) + aside
    return (groups + on_times + tables + _of_choice(allocation, directions, limit)) * (1.0 + 1e-6)


def _of_choice(allocation: Allocation, directions: Float[np.ndarray, "groups 3"], limit: float) -> float:
    """Bound the force that is cut off because rounding takes another point for the best one, N.

    At a point whose value is the largest no group's force is beyond its limits: along the edge on which that group
    leaves its plane there would be a larger one, by the force beyond times the edge's length. A point that rounding
    takes is lower by at most twice what a value is rounded. An edge that meets no further plane is of forces out of
    reach.
    """
    price, fee = np.asarray(allocation.price).T, np.asarray(allocation.fee)
    slope, offset, largest = (np.asarray(part) for part in (allocation.slope, allocation.offset, allocation.largest))
    # The product, two sums and the fee, of either of two values.
    rounded = 2.0 * 4.0 * UNIT64 * float((np.abs(price).sum(axis=1) * limit + np.abs(fee)).max())
    basic = np.any(slope != 0.0, axis=2)
    height = price @ directions.T
    height -= np.take_along_axis(height, np.argmax(basic, axis=0)[None], axis=0)
    most = 0.0
    for point, chosen in enumerate(basic):
        cut, steps, dearer = 0.0, price - price[point], fee - fee[point]
        for group in np.flatnonzero(chosen):
            row, away = slope[point, group], offset[point, group]
            for side, beyond in ((-1.0, -away), (1.0, away - largest[group])):
                climb = side * (directions @ row)
                if not np.any((climb * height[point] < 0.0) & (np.abs(climb) > 1e-12) & ~chosen):
                    continue
                length = side * (steps @ row) / (row @ row)
                # The gain on the way to another point is the length times the force beyond, but for this.
                apart = np.abs(steps - side * length[:, None] * row).sum(axis=1) * limit
                apart += np.abs(dearer + length * beyond)
                ahead = length > 0.0
                cut += float(((rounded + apart[ahead]) / length[ahead]).min())
        most = max(most, cut)
    return most


def with_rounding(guard: Guard, pulses: float) -> tuple[Guard, float, float]:
    """Count rounding in a guard by a spline: the guard, and what was added to its field (m) and force (N).

    Args:
        guard: before.
        pulses: what rounding does to the force that thrusters give for the guard's, N.

    """
    assert isinstance(guard.field, GridField)
    own = of_spline(guard.field, reach_of(guard))
    field, force = of_guard(guard, own), of_force(guard) + pulses
    a = guard.assumptions
    assumptions: GuardAssumptions = dataclasses.replace(a, force_error=a.force_error + force)
    error = guard.evaluation_error + field
    return Guard(guard.field, guard.threshold, guard.lipschitz, assumptions, error), field, force


def reach_of(guard: Guard) -> float:
    """Give the largest size of a place that the guard's tests look at with an answer that may be yes, m.

    A path of corners beyond the range limit is not free, whatever its values; what is told may be off by its error.
    """
    a, design = guard.assumptions, guard.braking
    return float(a.range_limit + a.position_error + _stop(a, design)) + 1.0


def _stop(a: GuardAssumptions, design: BrakingDesign) -> float:
    speed = float(a.speed_limit + a.velocity_error)
    return float(speed**2 / (2.0 * design.deceleration) + speed * a.period)


def _learned_radius(cont: RadialContinuation) -> float:
    return 0.5 * float(cont.domain_radius + cont.outer_radius)


def _psi(cont: RadialContinuation) -> Followed:
    """Follow ψ(r); beyond ρ_1 it is a constant."""
    inner, outer = float(cont.domain_radius), float(cont.outer_radius)
    width = _exact(outer - inner)
    # The norm: three products, two sums and a root of what a difference each has rounded.
    r = Followed(outer, 4.0 * UNIT64 * outer)
    t = (r + _exact(inner)).over(width, width.size).within(1.0)
    square = t * t
    bent = (t + square * t) + _exact(0.5) * (square * square)
    return (_exact(inner) + width * bent).within(_learned_radius(cont))


def _asked(cont: RadialContinuation) -> float:
    """Bound the rounding of a coordinate of the place in the domain, m (`keepout_into_domain`)."""
    radius, psi = _learned_radius(cont), _psi(cont)
    # q = c + y (ψ/r): y rounds once, r four times, the quotient, the product and the sum once each.
    return psi.error + 8.0 * UNIT64 * (radius + float(np.abs(np.asarray(cont.centre)).max()))


def _continued(cont: RadialContinuation, value: Followed, reach: float) -> Followed:
    """Follow `keepout_continued`, of a value in the domain."""
    target, inner = float(cont.target_radius), float(cont.domain_radius)
    far = max(reach, float(cont.outer_radius)) + float(np.linalg.norm(np.asarray(cont.centre)))
    risen = _rise(target, inner, Followed(far, 4.0 * UNIT64 * far)) + _rise(target, inner, _psi(cont))
    width = _exact(inner - target)
    r = Followed(inner, 4.0 * UNIT64 * inner)
    t = (r + _exact(target)).over(width, width.size).within(1.0)
    square = t * t
    bell = _exact(10.0) + _exact(15.0) * t + _exact(6.0) * square
    lowered = (_exact(float(cont.allowance)) * (square * t)) * bell
    return (value + risen) + lowered


def _rise(target: float, least: float, s: Followed) -> Followed:
    """Follow F(s) of s ≥ `least` > ρ_T."""
    radius = _exact(target)
    # s² − ρ_T² is at least (1 − (ρ_T/least)²) s²: a share of s² comes out of the root as the same share of s.
    share = 1.0 - (target / least) ** 2
    square = s * s + radius * radius
    root = Followed(s.size, square.error / (2.0 * math.sqrt(share) * s.size) + UNIT64 * s.size)
    ratio = radius.over(s, least).within(1.0)
    # The arc cosine: two roots, an arc tangent, doubled; its slope is at most 1/√share.
    angle = _rounded(0.5 * math.pi, ratio.error / math.sqrt(share), 2.0 * ELEMENTARY)
    return root + radius * angle

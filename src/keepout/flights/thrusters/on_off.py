"""Thrusters that are on or off: a commanded force becomes pulses, one a thruster and control period.

Which thrusters fire for a force, and how long, is the linear program of least propellant, solved beforehand. Thrusters
of one direction form a group. The groups' forces a solve

    minimise Σ a_g   subject to   Σ a_g d_g = u,   0 ≤ a_g ≤ F_g,

whose dual is to maximise λ·u − Σ F_g max(0, λ·d_g − 1) over λ in three dimensions: a concave function, linear between
the planes λ·d_g = 1, so that its largest value is at a point where three of them meet. Those points do not depend on u.
They are listed when a flight is built, each with the three groups that are neither off nor full there and with a as an
affine function of u; in flight the best point is looked up. With one thruster pair an axis that is the closed form of
each axis. Within a group thrusters fire alike as far as their torques cancel, and only then those whose torque is left
over.

How far pulses can be from the force asked for, and from the motion under it, is bounded (`thruster_errors`):
docs/motion.md. A layout's forces are bounded by N = max (‖Σ F_g |d_g|‖ + ε Σ F_g) over the groups that fire together
(`Allocation.active`), where each pushes along d_g but for a vector ε_g of at most ε: whatever share k_g of each is left
out or too much, |k_g| ≤ k, ‖Σ k_g F_g (d_g + ε_g)‖ ≤ k N.

Of a scenario follow the layout, whether it gives the force that law and guard use, and what it does wrong.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.optimize import linprog

from keepout.core.errors import ScenarioError
from keepout.core.mission.entries import ThrustersEntry
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import ThrusterErrors
from keepout.core.motion.arrays import Vector, as_float64
from keepout.core.motion.chaser import Firing, Pulses, ThrusterModel
from keepout.flights.thrusters.layout import STANDARD_GRAVITY, Capability, Layout, Stuck, force_box, preset, share

Scalar = Float[Array, ""]

_FLAT = 1e-9
"""Below this determinant three unit directions lie in a plane."""
_LANES = 64
"""Values that are compared at once."""
_APART = 1e-7
"""Relative differences of the groups' costs, so that no four planes meet in a point."""
_PRIMES = tuple(n for n in range(2, 132) if all(n % k for k in range(2, n)))
"""One for each of the groups that there may be. Their square roots are in no rational relation, so that none of the
directions (four corners of a cube's face, say) makes four of the costs meet all the same."""


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
    cost = 1.0 + _APART * np.modf(np.sqrt(_PRIMES[: len(directions)]))[0]
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


class Failure(eqx.Module):
    """A thruster that sticks in flight, and when that becomes known.

    Attributes:
        thruster: its number.
        on: 1 if it is stuck on, 0 if stuck off.
        begins: control period from which on it is stuck.
        known: control period from which on the others are fired in the knowledge of it.
        push: what it then gives, as the others are told, N.
        others: which thrusters fire for a force that the stuck one leaves to them.

    """

    thruster: Int[Array, ""]
    on: Scalar
    begins: Int[Array, ""]
    known: Int[Array, ""]
    push: Vector
    others: Allocation


class ThrusterMemory(eqx.Module):
    """What thrusters carry from period to period.

    Attributes:
        periods: flown so far.
        push: of each thruster while it is on, as it truly is, N.
        owed: on-time that was asked for and not given, s (0 with pulse-width modulation).
        tail: for which a thruster is still on in the coming period because it closes late, s.

    """

    periods: Int[Array, ""]
    push: Float[Array, "thrusters 3"]
    owed: Float[Array, " thrusters"]
    tail: Float[Array, " thrusters"]


class OnOffThrusters(ThrusterModel):
    """Thrusters of a layout, each fired once a control period, in its middle; build with `OnOffThrusters.of`.

    Attributes:
        push: of each thruster while it is on, as it should be, N.
        allocation: which fire for a force.
        force_limit: per body axis, at which commands are cut off, N.
        period: s.
        least_on_time: s. A shorter pulse is given as one of this length, or not at all if less than half of it.
        rise_delay: by which a pulse is late, s.
        flow: propellant burnt for each newton and second, kg.
        misalignment: largest angle of a thruster's force to its direction, drawn once a flight, rad.
        scale_error: largest relative error of its size, likewise.
        failure: of one thruster, or None.
        delta_sigma: whether what a pulse gives too much or too little is made up for later.

    """

    push: Float[Array, "thrusters 3"]
    allocation: Allocation
    force_limit: Float[Array, "3"]
    period: Scalar = eqx.field(converter=as_float64)
    least_on_time: Scalar = eqx.field(converter=as_float64)
    rise_delay: Scalar = eqx.field(converter=as_float64)
    flow: Scalar = eqx.field(converter=as_float64)
    misalignment: Scalar = eqx.field(converter=as_float64)
    scale_error: Scalar = eqx.field(converter=as_float64)
    failure: Failure | None = None
    delta_sigma: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls,
        layout: Layout,
        *,
        force_limit: float,
        period: float,
        delta_sigma: bool = False,
        stuck: tuple[int, Stuck] | None = None,
        stuck_from: float = 0.0,
        detection_time: float = math.inf,
    ) -> "OnOffThrusters":
        """Build the thrusters of a layout.

        Args:
            layout: the thrusters.
            force_limit: per body axis, at which commands are cut off, N.
            period: between control steps, s.
            delta_sigma: whether what a pulse gives too much or too little is made up for later.
            stuck: number of a thruster, and how it sticks; None for none.
            stuck_from: when it sticks, s after the start: from the first control step then or later.
            detection_time: after which it is known, s: from the first control step then or later.

        Raises:
            ScenarioError: a least on-time or rise delay that does not fit into a period, or no such thruster.

        """
        require_periods(layout, period)
        return cls(
            push=as_float64(layout.pushes()),
            allocation=Allocation.of(layout),
            force_limit=as_float64(np.full(3, force_limit)),
            period=period,
            least_on_time=layout.least_on_time,
            rise_delay=layout.rise_delay,
            flow=1.0 / (layout.specific_impulse * STANDARD_GRAVITY),
            misalignment=layout.misalignment,
            scale_error=layout.scale_error,
            failure=None if stuck is None else _failure(layout, stuck, stuck_from, detection_time, period),
            delta_sigma=delta_sigma,
        )

    def apply(self, command: Vector) -> Vector:
        """Cut the command off at the limit in each axis, N: what pulses aim at."""
        return jnp.clip(command, -self.force_limit, self.force_limit)

    def saturated(self, command: Vector) -> Bool[Array, ""]:
        """Whether the command reaches the limit in any axis."""
        return jnp.any(jnp.abs(command) >= self.force_limit * (1 - 1e-9))

    def initial_state(self, key: PRNGKeyArray) -> ThrusterMemory:
        """Draw each thruster's force and direction within their bounds."""
        size, tilt, turn = (jax.random.fold_in(key, number) for number in (11, 12, 13))
        count = self.push.shape[0]
        scale = 1.0 + self.scale_error * jax.random.uniform(size, (count, 1), minval=-1.0, maxval=1.0)
        across = jnp.cross(self.push, jax.random.normal(turn, (count, 3)))
        across = across / jnp.maximum(jnp.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        angle = self.misalignment * jax.random.uniform(tilt, (count, 1))
        length = jnp.linalg.norm(self.push, axis=1, keepdims=True)
        push = scale * (jnp.cos(angle) * self.push + jnp.sin(angle) * length * across)
        return ThrusterMemory(jnp.zeros((), jnp.int32), push, jnp.zeros(count), jnp.zeros(count))

    def fire(self, state: ThrusterMemory, command: Vector) -> tuple[ThrusterMemory, Firing]:
        """Give the pulses of the coming period for a commanded force (N, body axes), and their mean force."""
        wanted = self.period * self._shares(state.periods, self.apply(command)) + state.owed
        half = 0.5 * self.least_on_time
        given = jnp.where(wanted <= half, 0.0, jnp.clip(wanted, self.least_on_time, self.period))
        owed = wanted - given if self.delta_sigma else state.owed
        begin, tail = 0.5 * (self.period - given) + self.rise_delay, state.tail
        if self.failure is not None:
            works = 1.0 - self._is_stuck(state.periods)
            given = works * given + (1.0 - works) * self.failure.on * self.period
            begin, tail = works * begin, works * tail
        end = begin + given
        late = jnp.maximum(end - self.period, 0.0)
        still = jnp.zeros_like(begin)
        pulses = Pulses(
            begin=jnp.concatenate([still, jnp.minimum(begin, self.period)]),
            end=jnp.concatenate([tail, jnp.minimum(end, self.period)]),
            force=jnp.concatenate([state.push, state.push]),
            period=self.period,
        )
        on_time = tail + jnp.minimum(end, self.period) - jnp.minimum(begin, self.period)
        propellant = self.flow * on_time @ jnp.linalg.norm(state.push, axis=1)
        memory = ThrusterMemory(state.periods + 1, state.push, owed, late)
        return memory, Firing(pulses.mean, pulses, on_time, propellant)

    def _shares(self, periods: Int[Array, ""], force: Vector) -> Float[Array, " thrusters"]:
        shares = self.allocation.shares(force)
        if self.failure is None:
            return shares
        known = periods >= self.failure.known
        return jnp.where(known, self.failure.others.shares(force - self.failure.push), shares)

    def _is_stuck(self, periods: Int[Array, ""]) -> Float[Array, " thrusters"]:
        assert self.failure is not None
        mine = jnp.arange(self.push.shape[0]) == self.failure.thruster
        return (mine & (periods >= self.failure.begins)).astype(jnp.float64)


def require_periods(layout: Layout, period: float) -> None:
    """Refuse a least on-time longer than a control period, and a rise delay longer than half of one.

    Raises:
        ScenarioError: it is.

    """
    if layout.least_on_time > period:
        raise ScenarioError(
            f"thrusters.least_on_time: {layout.least_on_time:g} s is longer than the control period, {period:g} s; "
            "no pulse fits in"
        )
    if layout.rise_delay > 0.5 * period:
        raise ScenarioError(
            f"thrusters.rise_delay: {layout.rise_delay:g} s is more than half of the control period, {period:g} s"
        )


def _failure(
    layout: Layout, stuck: tuple[int, Stuck], stuck_from: float, detection_time: float, period: float
) -> Failure:
    thruster, how = stuck
    others = layout.without(thruster)
    begins = math.ceil(stuck_from / period - 1e-9)
    known = min(begins + math.ceil(detection_time / period - 1e-9), 2**31 - 1) if detection_time < 1e9 else 2**31 - 1
    return Failure(
        thruster=jnp.asarray(thruster),
        on=as_float64(float(how == "on")),
        begins=jnp.asarray(begins, jnp.int32),
        known=jnp.asarray(known, jnp.int32),
        push=as_float64(layout.pushes()[thruster] * (how == "on")),
        others=Allocation.of(others),
    )


def thruster_errors(
    layout: Layout,
    *,
    force_limit: float,
    mass: float,
    period: float,
    delta_sigma: bool,
    detection_time: float | None = None,
) -> ThrusterErrors:
    """Bound the errors of a layout's pulses.

    With T the period, τ the least on-time, ρ the rise delay and ε a bound on the relative error of a thruster's force
    as a vector, all times N: a pulse is wrong by at most τ/2, or τ where it makes up for earlier ones. A centred pulse
    that is on for the share p leaves the mean's motion by p(1−p) T/2 ≤ T/8 times its force over the mass in velocity,
    and by p(1−p) T²/8 ≤ T²/32 in position. A delay moves what is on by up to ρ at either end of the period: 2ρ and 2ρT
    more, a mean wrong by 2ρ/T, and an end that is off by up to 1.5ρT in position, which is what a force of 4 · 1.5ρ/T
    that changes its sign in the middle of the period does.

    Args:
        layout: the thrusters.
        force_limit: per body axis, N.
        mass: least mass of the chaser, kg.
        period: between control steps, s.
        delta_sigma: whether what a pulse gives too much or too little is made up for later.
        detection_time: after which a stuck thruster is known, s, where the guard is to cover one; else None.

    """
    allocations = [Allocation.of(layout)]
    if detection_time is not None:
        allocations += [Allocation.of(layout.without(i)) for i in range(layout.count)]
    directions = layout.groups()[1]
    tilt = vector_error(layout)
    size = max(_together(allocation.active(), allocation, directions, tilt) for allocation in allocations)
    late = layout.rise_delay
    quantum = layout.least_on_time * (1.0 if delta_sigma else 0.5) / period
    every = np.ones((1, len(directions)))
    owed = _together(every, allocations[0], directions, tilt) * 0.5 * layout.least_on_time
    return ThrusterErrors(
        force_error=size * (quantum + 8.0 * late / period),
        running_error=owed + 2.0 * size * late if delta_sigma else math.inf,
        excursion=size / mass * (period**2 / 32.0 + 3.5 * late * period),
        velocity_excursion=size / mass * (period / 8.0 + 2.0 * late),
        gain_error=tilt * _spent(allocations, force_limit, layout) / (math.sqrt(3.0) * force_limit),
        fault_force=0.0 if detection_time is None else (1.0 + layout.scale_error) * float(layout.force.max()),
        fault_steps=0 if detection_time is None else math.ceil(detection_time / period - 1e-9),
    )


def vector_error(layout: Layout) -> float:
    """Bound ‖g − f d‖/f: how far a thruster's force is from what it should be, as a vector, relative to its size."""
    scale = layout.scale_error
    return math.sqrt(scale**2 + 2.0 * (1.0 + scale) * (1.0 - math.cos(layout.misalignment)))


def _together(active: np.ndarray, allocation: Allocation, directions: np.ndarray, tilt: float) -> float:
    """N of one allocation, with the groups that are on at each of its points; `tilt` is ε."""
    largest = np.asarray(allocation.largest)
    along = np.linalg.norm(active.astype(float) @ (np.abs(directions) * largest[:, None]), axis=1)
    return float((along + tilt * (active @ largest)).max())


def _spent(allocations: Sequence[Allocation], force_limit: float, layout: Layout) -> float:
    """Bound Σ a_g, the thrust that is on for a force of the box, with a thruster stuck on and held against.

    It is convex in the force (the dual's largest value), so that it is largest at a corner of the box.
    """
    corners = force_limit * np.array(np.meshgrid(*[[1.0, -1.0]] * 3)).reshape(3, -1).T
    most = 0.0
    for number, allocation in enumerate(allocations):
        stuck = np.zeros((1, 3)) if number == 0 else np.stack([np.zeros(3), layout.pushes()[number - 1]])
        asked = (corners[:, None] - stuck[None]).reshape(-1, 3)
        value = np.max(asked @ np.asarray(allocation.price) - np.asarray(allocation.fee), axis=1)
        most = max(most, float(value.max()) + (0.0 if number == 0 else float(layout.force[number - 1])))
    return most


_ROUNDING = 1.0 - 1e-6
"""A force box may be short of chaser.force_limit by so much: what a linear program's solver leaves open."""


def layout_of(scenario: Scenario) -> Layout | None:
    """Give the scenario's layout; None where the thrusters are ideal.

    Raises:
        ScenarioError: its directions do not span three axes.

    """
    entry, chaser = scenario.thrusters, scenario.chaser
    return _made(entry, chaser.force_limit, chaser.radius)  # pyright: ignore[reportArgumentType]: it has a hash


@lru_cache(maxsize=64)
def _made(entry: ThrustersEntry, force_limit: float, radius: float) -> Layout | None:
    """Give one layout for all scenarios of the same thrusters, so that what it can give is worked out once."""
    names = ("least_on_time", "specific_impulse", "rise_delay", "misalignment", "scale_error")
    numbers = {name: getattr(entry, name) for name in names}
    if entry.layout == "ideal":
        return None
    if entry.layout == "own":
        force = np.array([entry.force if own.force is None else own.force for own in entry.own], float)
        positions, directions = (
            np.array([getattr(own, key) for own in entry.own]) for key in ("position", "direction")
        )
        return Layout(positions, directions, force, **numbers)
    force = force_limit / share(entry.layout) if entry.force is None else entry.force
    return preset(entry.layout, force=force, arm=max(radius, 0.1), **numbers)


_whole, _able = lru_cache(maxsize=64)(force_box), lru_cache(maxsize=64)(Capability.of)


def thrusters_of(scenario: Scenario) -> OnOffThrusters:
    """Build the thrusters of a scenario's layout, with the one that its faults stick.

    Raises:
        ScenarioError: a layout that cannot be flown (`require_layout`), or a fault of a thruster that is not there.

    """
    flown, entry, faults = layout_of(scenario), scenario.thrusters, scenario.faults
    require_layout(scenario)
    assert flown is not None
    return OnOffThrusters.of(
        flown,
        force_limit=scenario.chaser.force_limit,
        period=scenario.control.period,
        delta_sigma=entry.modulation == "delta-sigma",
        stuck=None if faults.thruster is None else (faults.thruster, faults.thruster_stuck),
        stuck_from=faults.stuck_from,
        detection_time=entry.detection_time,
    )


def require_layout(scenario: Scenario) -> None:
    """Refuse a layout that does not give chaser.force_limit along every axis, whole or with one thruster stuck.

    Raises:
        ScenarioError: it does not, its thrusters do not span three axes, or its pulses do not fit into a period.

    """
    flown = layout_of(scenario)
    if flown is None:
        return
    require_periods(flown, scenario.control.period)
    if scenario.faults.thruster is not None:
        flown.require(scenario.faults.thruster)
    asked = scenario.chaser.force_limit
    whole = _whole(flown)
    if whole == 0.0:
        raise ScenarioError(
            f"thrusters.layout: its {flown.count} thrusters cannot push every way: the largest force that they give "
            "in all directions is 0 N"
        )
    if whole < asked * _ROUNDING:
        raise ScenarioError(
            f"chaser.force_limit: {asked:g} N, and the thrusters give {whole:.4g} N along every axis; lower it to "
            "that, or give stronger thrusters"
        )
    if not scenario.thrusters.survive_failure:
        return
    able = _able(flown)
    left = able.after_failure
    if left < asked * _ROUNDING:
        how: Stuck = "off" if min(able.stuck_off) <= left else "on"
        worst = int(np.argmin(able.stuck_off if how == "off" else able.stuck_on))
        raise ScenarioError(
            f"thrusters.survive_failure: with thruster {worst} stuck {how} the others give {left:.4g} N along every "
            f"axis, and chaser.force_limit is {asked:g} N; "
            + (
                f"lower it to that, or raise thrusters.force {asked / left:.3g} times"
                if left > 0.0
                else "no force limit helps: take a layout with more thrusters"
            )
        )


def errors_of(scenario: Scenario) -> ThrusterErrors:
    """Bound what a layout's thrusters do beyond holding the force asked for: what guard and audit must assume."""
    flown, entry = layout_of(scenario), scenario.thrusters
    assert flown is not None
    return thruster_errors(
        flown,
        force_limit=scenario.chaser.force_limit,
        mass=scenario.chaser.mass * (1.0 - scenario.guard.mass_error),
        period=scenario.control.period,
        delta_sigma=entry.modulation == "delta-sigma",
        detection_time=entry.detection_time if entry.survive_failure else None,
    )

"""An operator's limits on a flight: hold points, no thrust towards parts of the target, passive safety.

Hold points and drifts are judged on a flight's record. Legs that ask for it are flown no faster than lets a chaser
without thrust drift past the target, wherever its thrust stops (`drift_safe`). A law that spares a part fires no
thruster whose plume would reach it (`sparing`). A plume is a cone: its apex the place of a thruster, its axis opposite
to its force, cut off at a range. Each thruster that fires has one. What of the target stands between is not looked at:
the answer errs towards "reached".

A cone K about d of half angle α ≤ 90°, cut at a range ρ, is convex. The point of it nearest to w, both from the apex,
is the nearest one of the whole cone, cut back to ρ. A ball is reached where its centre's distance from K is at most its
radius. For a box, projections on box and cone in turn lead to the nearest pair; the difference n of the pair is the
normal of a plane, and what that plane proves is the lower bound that decides: n̂·y over the box, less n̂·z over K.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from keepout.apps.inspection.passive import Distance, PassiveSafety, drift_speed, passive_safety, states_of_record
from keepout.apps.inspection.ways import way_length
from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.control.controller import Controller
from keepout.core.control.guidance import Guidance
from keepout.core.control.law import Command, Law, LawOfAnother
from keepout.core.control.legs import LegGuidance
from keepout.core.errors import ControlError, ScenarioError
from keepout.core.flight.record import FlightRecord
from keepout.core.flight.setup import Faults
from keepout.core.geometry.distance import Point
from keepout.core.mission.approach import released
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.task_entries import HoldPointEntry
from keepout.core.mission.zones import named
from keepout.core.motion.arrays import Vector, as_float64, norm
from keepout.core.motion.chaser import ThrusterModel
from keepout.core.motion.relative import MotionState
from keepout.core.progress import Progress, silent
from keepout.flights.thrusters.on_off import Allocation, errors_of, layout_of

_SILENT = 1e-9
"""Newtons: a thruster that gives less has no plume."""
_DIVISIONS = 3
"""Times that a force is divided anew without the thrusters that are barred, before nothing is left of it."""
_FAR = 1e4
"""Metres that a plume without a range reaches."""
_ROUNDS = 100
"""Projections in turn: what they leave open counts as reached."""
_ROUNDING = 1e-7
"""Metres: more than float64 loses at that range."""
_JUDGED_EVERY = 10.0
"""Seconds from one state of a flight that is judged to the next."""
_STEP = 0.1
"""Metres from one corner of a course to the next."""
_DETOUR = 4.0
"""A course is followed for so many times the straight way, and `_MORE` m."""
_MORE = 20.0


class Nozzles(eqx.Module):
    """The thrusters as plumes see them; ideal ones by default, in the order +x, +y, +z, −x, −y, −z.

    Ideal thrusters are a pair an axis at the chaser's centre. Those of a layout sit where it says and push as it says;
    its chaser's axes are parallel to the body's (`flights/thrusters/layout.py`).

    Attributes:
        position: of each from the chaser's centre, m, body axes.
        direction: of the force that each puts on the chaser, unit vectors; its plume goes the other way.
        force: of each while it is on, N; 1 for ideal ones, which give any.
        wide: by how much a thruster's direction may be wrong, rad.
        excursion: by how much pulses lead the chaser away from the path under their mean force, m.
        limit: at which a commanded force is cut off in each axis, N.
        allocation: which fire for a force; None for ideal ones.

    """

    position: Float[Array, "n 3"] = eqx.field(default_factory=lambda: jnp.zeros((6, 3)))
    direction: Float[Array, "n 3"] = eqx.field(default_factory=lambda: jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
    force: Float[Array, " n"] = eqx.field(default_factory=lambda: jnp.ones(6))
    wide: float = 0.0
    excursion: float = 0.0
    limit: float = 0.0
    allocation: Allocation | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> "Nozzles":
        """Take them from a scenario."""
        whole = layout_of(scenario)
        if whole is None:
            return cls()
        placed = jnp.asarray(whole.position), jnp.asarray(whole.direction), jnp.asarray(whole.force)
        wrong = whole.misalignment, errors_of(scenario).excursion
        return cls(*placed, *wrong, scenario.chaser.force_limit, Allocation.of(whole))

    def gives(self, force: Float[Array, "3"]) -> Float[Array, " n"]:
        """Say how much of a force (N, body axes) each gives, N."""
        if self.allocation is None:
            return jnp.maximum(self.direction @ force, 0.0)
        return self.force * self.allocation.shares(jnp.clip(force, -self.limit, self.limit))

    def without(self, force: Float[Array, "3"], barred: Bool[Array, " n"]) -> Float[Array, "3"]:
        """Give what is left of a force without some thrusters: none of them fires for it.

        Thrusters of one direction fire together, so with one of them all are left out.
        """
        if self.allocation is None:
            return jnp.where(barred, 0.0, self.gives(force)) @ self.direction
        group, count = self.allocation.group, self.allocation.largest.shape[0]
        barred = jnp.zeros(count, bool).at[group].max(barred)[group]

        def fires_barred(left: Float[Array, "3"]) -> Bool[Array, ""]:
            return jnp.any(barred & (self.gives(left) > _SILENT))

        left = force
        for _ in range(_DIVISIONS):
            kept = jnp.where(barred, 0.0, self.gives(left)) @ self.direction
            left = jnp.where(fires_barred(left), kept, left)
        return jnp.where(fires_barred(left), 0.0, left)

    def fired(self, record: FlightRecord, scenario: Scenario) -> Bool[np.ndarray, "steps n"]:
        """Say which fired in each step of a flight.

        Ideal ones by the force that was given. Those of a layout as they were told to: the record holds the mean force
        of their pulses alone, so the commands are run through the scenario's faults and thrusters again.
        """
        if self.allocation is None:
            return (record.force[:-1] @ np.asarray(self.direction).T) > _SILENT
        around, told = Surroundings(scenario), (jnp.asarray(record.guarded_force), jnp.asarray(record.time))
        on_time = _on_times(around.faults, around.thrusters, *told, jax.random.key(scenario.seed))
        return np.asarray(on_time)[:-1] > 0.0


@kept_jit
def _on_times(
    faults: Faults, thrusters: ThrusterModel, commands: Float[Array, "rows 3"], times: Float[Array, " rows"], key: Array
) -> Float[Array, "rows n"]:
    """Give the on-time of each thruster in each period, s; what is drawn of their forces changes none."""

    def period(state, told):
        broken, memory = state
        broken, arrived = faults.command(broken, *told)
        memory, firing = thrusters.fire(memory, arrived)
        assert firing.on_time is not None
        return (broken, memory), firing.on_time

    begun = faults.initial_state(key), thrusters.initial_state(key)
    return jax.lax.scan(period, begun, (commands, times))[1]


class Protected(eqx.Module):
    """Parts of the target that no plume may reach, body frame, m: boxes, each grown by a radius. A ball is a point.

    Attributes:
        lower: (parts, 3) lower corners.
        upper: (parts, 3) upper corners.
        radius: (parts,) by which each is grown.
        half_angle: of a plume, rad.
        reach: of a plume, m.
        nozzles: where plumes come from.

    """

    lower: Float[Array, "parts 3"] = eqx.field(converter=as_float64)
    upper: Float[Array, "parts 3"] = eqx.field(converter=as_float64)
    radius: Float[Array, " parts"] = eqx.field(converter=as_float64)
    half_angle: Float[Array, ""] = eqx.field(converter=as_float64)
    reach: Float[Array, ""] = eqx.field(converter=as_float64)
    nozzles: Nozzles = eqx.field(default_factory=Nozzles)

    @classmethod
    def of(cls, scenario: Scenario) -> "Protected | None":
        """Take them from a scenario; None where nothing is protected."""
        entry = scenario.inspect
        if not entry.no_thrust_towards:
            return None
        lower = [part.lower if part.centre is None else part.centre for part in entry.no_thrust_towards]
        upper = [part.upper if part.centre is None else part.centre for part in entry.no_thrust_towards]
        radius = [part.radius or 0.0 for part in entry.no_thrust_towards]
        reach = _FAR if entry.plume_range is None else entry.plume_range
        nozzles = Nozzles.of(scenario)
        half_angle = min(entry.plume_half_angle + nozzles.wide, 0.5 * math.pi)
        return cls(lower, upper, radius, half_angle, reach, nozzles)

    def reached(self, position: Float[Array, "3"], moved: float | Float[Array, ""] = 0.0) -> Bool[Array, " n"]:
        """Say of each thruster if its plume reaches a part.

        Args:
            position: of the chaser's centre, m.
            moved: by which it may be elsewhere while the thruster fires, m.

        """

        def of_thruster(place: Float[Array, "3"], push: Float[Array, "3"]) -> Bool[Array, ""]:
            apart = jax.vmap(lambda low, high: self._apart(position + place, -push, low, high))(self.lower, self.upper)
            return jnp.any(apart <= self.radius + moved + _ROUNDING)

        return jax.vmap(of_thruster)(self.nozzles.position, self.nozzles.direction)

    def _apart(
        self, apex: Float[Array, "3"], axis: Float[Array, "3"], low: Float[Array, "3"], high: Float[Array, "3"]
    ) -> Float[Array, ""]:
        """Bound the distance of a plume from a box from below, m."""
        lower, upper = low - apex, high - apex

        def once(_: Any, point: Float[Array, "3"]) -> Float[Array, "3"]:
            return jnp.clip(self._nearest(axis, point), lower, upper)

        point = jax.lax.fori_loop(0, _ROUNDS, once, jnp.clip(jnp.zeros(3), lower, upper))
        normal = point - self._nearest(axis, point)
        length = jnp.linalg.norm(normal)
        normal = normal / jnp.maximum(length, 1e-300)
        of_box = jnp.sum(jnp.where(normal > 0.0, lower, upper) * normal)
        angle = jnp.arccos(jnp.clip(normal @ axis, -1.0, 1.0))
        of_plume = self.reach * jnp.maximum(jnp.cos(jnp.maximum(angle - self.half_angle, 0.0)), 0.0)
        return jnp.where(length > 0.0, of_box - of_plume, 0.0)

    def _nearest(self, axis: Float[Array, "3"], point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Give the point of the plume nearest to a point, both from the apex."""
        cosine, sine = jnp.cos(self.half_angle), jnp.sin(self.half_angle)
        along = point @ axis
        across = point - along * axis
        off = jnp.linalg.norm(across)
        outwards = across / jnp.maximum(off, 1e-300)
        side = along * cosine + off * sine
        on_side = jnp.maximum(side, 0.0) * (cosine * axis + sine * outwards)
        found = jnp.where(off * cosine <= along * sine, point, on_side)
        return found * jnp.minimum(1.0, self.reach / jnp.maximum(jnp.linalg.norm(found), 1e-300))


def plume_violations(record: FlightRecord, protected: Protected, scenario: Scenario) -> Bool[np.ndarray, " steps"]:
    """Say of each step of a flight whether a plume of a thruster that fired can have reached a protected part.

    The chaser moves while it fires: by at most the step's chord, and half its change of velocity times its length.

    Args:
        record: true positions, velocities and forces.
        protected: parts, plume and thrusters.
        scenario: as it was flown.

    """
    step = np.diff(record.time)
    chord = np.linalg.norm(np.diff(record.position, axis=0), axis=1)
    bent = 0.5 * np.linalg.norm(np.diff(record.velocity, axis=0), axis=1) * step
    moved = jnp.asarray(chord + bent + protected.nozzles.excursion)
    reached = np.asarray(_reached(protected, jnp.asarray(record.position[:-1]), moved))
    return np.any(reached & protected.nozzles.fired(record, scenario), axis=1)


@kept_jit
def _reached(
    protected: Protected, positions: Float[Array, "n 3"], moved: Float[Array, " n"]
) -> Bool[Array, "n thrusters"]:
    return jax.vmap(protected.reached)(positions, moved)


class SparingLaw(LawOfAnother):
    """A law whose force fires no thruster whose plume would reach a protected part.

    The guard comes after it and may still fire any thruster: not to touch goes before not to blow.

    Attributes:
        law: that leads.
        protected: parts and plume.
        moved: that the chaser flies while a force is held, m.

    """

    protected: Protected
    moved: float

    def begun_with(self, state: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Give the memory of the law that leads."""
        return self.law.begun_with(state, under_way)

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Give the law's force without the thrusters that are forbidden here."""
        state, command = self.law.step(state, estimate)
        reached = self.protected.reached(estimate.position, self.moved)
        force = self.protected.nozzles.without(command.force, reached)
        return self.law.with_applied_force(state, force), eqx.tree_at(lambda c: c.force, command, force)


def sparing(law: Law, scenario: Scenario) -> Law:
    """Give a law that spares a scenario's protected parts; the law itself where there are none."""
    protected = Protected.of(scenario)
    if protected is None:
        return law
    moved = scenario.chaser.speed_limit * scenario.control.period + protected.nozzles.excursion
    return SparingLaw(law, protected, moved)


@dataclass(frozen=True)
class Hold:
    """What became of a hold point.

    Attributes:
        position: (3,) m, body frame.
        asked: seconds for which the chaser is to be held there.
        begun: when the longest stay began that comes after the holds before it, s; nan without one.
        lasted: how long it was, s.

    """

    position: tuple[float, float, float]
    asked: float
    begun: float
    lasted: float

    @property
    def kept(self) -> bool:
        """Whether it lasted as long as asked."""
        return self.lasted >= self.asked - 1e-9


def holds(record: FlightRecord, points: tuple[HoldPointEntry, ...], tolerance: float) -> tuple[Hold, ...]:
    """Judge whether a flight was held at each point, one after the other.

    A stay is an unbroken run of samples within `tolerance` m of the point. The first stay that is long enough counts;
    the next point is looked for after it. Where none is long enough the longest is told.

    Args:
        record: true positions.
        points: in their order.
        tolerance: m.

    """
    found, since = [], 0
    for point in points:
        near = np.linalg.norm(record.position - np.asarray(point.position), axis=1) <= tolerance
        near[:since] = False
        edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]])))
        begins, ends = edges[::2], edges[1::2] - 1
        lasted = record.time[ends] - record.time[begins]
        if not lasted.size:
            found.append(Hold(point.position, point.seconds, math.nan, 0.0))
            continue
        enough = np.flatnonzero(lasted >= point.seconds - 1e-9)
        best = int(enough[0]) if enough.size else int(np.argmax(lasted))
        found.append(Hold(point.position, point.seconds, float(record.time[begins[best]]), float(lasted[best])))
        if enough.size:
            since = int(np.searchsorted(record.time, record.time[begins[best]] + point.seconds - 1e-9))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class LimitsKept:
    """How a flight kept an operator's limits.

    Attributes:
        holds: at each hold point.
        plume_steps: steps in which a plume can have reached a protected part; None where none is declared.
        steps: of the flight.
        passive: of drifts from the samples, with no push beyond the motion; None where not asked.
        passive_pushed: likewise, with the disturbance's bound as a push that never turns round.

    """

    holds: tuple[Hold, ...]
    plume_steps: int | None
    steps: int
    passive: PassiveSafety | None
    passive_pushed: PassiveSafety | None

    @property
    def kept(self) -> bool:
        """Whether all limits were kept: drifts are judged without the push."""
        held = all(hold.kept for hold in self.holds)
        return held and not self.plume_steps and (self.passive is None or bool(self.passive.safe.all()))

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON; without those that were not asked for."""
        told: dict[str, Any] = {"limits_kept": self.kept}
        if self.holds:
            told["holds_kept"] = sum(hold.kept for hold in self.holds)
            told["holds"] = len(self.holds)
        if self.plume_steps is not None:
            told["plume_steps"] = self.plume_steps
        for name, passive in (("passive", self.passive), ("passive_pushed", self.passive_pushed)):
            if passive is not None:
                least = float(passive.clearance.min())
                told[f"{name}_safe_share"] = float(passive.safe.mean())
                told[f"{name}_clearance_m"] = least if math.isfinite(least) else None
                told[f"{name}_spread_m"] = passive.spread
        return told


def limits_kept(scenario: Scenario, record: FlightRecord, distance: Distance, *, every: int = 1) -> LimitsKept:
    """Judge a flight by a scenario's hold points, protected parts and passive safety.

    Args:
        scenario: as it was flown.
        record: of the flight.
        distance: exact and unsigned, to the target's mesh, m.
        every: samples from one drift to the next.

    """
    inspect, protected = scenario.inspect, Protected.of(scenario)
    passive = pushed = None
    if inspect.passive_safety > 0.0:
        states = states_of_record(record, every)
        passive, pushed = (
            passive_safety(scenario, distance, states, inspect.passive_safety, push=push, enough=1.0)
            for push in (0.0, None)
        )
    held = holds(record, inspect.hold_points, scenario.goal.tolerance)
    blown = None if protected is None else int(plume_violations(record, protected, scenario).sum())
    return LimitsKept(held, blown, record.steps, passive, pushed)


def drifts_flown(flight: Flight) -> list[dict[str, Any]]:
    """Judge drifts without thrust for `approach.abort_time` from states along a flight, leg by leg.

    Returns:
        For each leg that was flown, or for the flight where it has none: `name`, how many states were `judged`, and
        from how many of them the drift is `proved_free` of contact with the mesh, and of zones, where nothing pushes,
        and where the disturbance does, whatever it is within its bound (`pushed_proved_free`).

    """
    scenario, record = flight.scenario, flight.record
    every = max(round(_JUDGED_EVERY / scenario.control.period), 1)
    states, seconds = states_of_record(record, every), scenario.approach.abort_time or 0.0
    distance = flight.target.distance.distance
    free, pushed = (
        passive_safety(scenario, distance, states, seconds, push=push, enough=0.0).safe for push in (0.0, None)
    )
    legs = np.zeros(len(free), int) if record.leg is None else record.leg[::every]
    names = ["flight"] if record.leg is None else [named("leg", leg, k) for k, leg in enumerate(scenario.leg)]
    return [
        {
            "name": name,
            "judged": int(np.sum(legs == number)),
            "proved_free": int(np.sum(free[legs == number])),
            "pushed_proved_free": int(np.sum(pushed[legs == number])),
        }
        for number, name in enumerate(names)
        if np.any(legs == number)
    ]


def drift_safe(around: Surroundings, law: Controller, progress: Progress = silent) -> Scenario:
    """Give a scenario whose legs that ask for it have the greatest safe speed among those tried as their limit.

    Safe is a speed up to which, at all speeds tried and from all along the leg's course, the drift without thrust or
    push is proved to touch no mesh and enter no zone for `approach.abort_time`. The course is the one that the guidance
    leads along, and target and zones are where they would be if the leg were flown at its limit. What is flown wanders
    from both, and is judged after the flight (`drifts` of its summary). No leg asks for it any more.

    Args:
        around: the scenario's surroundings, with its target.
        law: of the scenario.
        progress: called leg by leg.

    Raises:
        ScenarioError: at none of the speeds tried is every drift from a leg safe.

    """
    scenario, guidance = around.scenario, law.velocity.guidance
    assert around.target is not None
    if not isinstance(guidance, LegGuidance):
        asking = [named("leg", leg, number) for number, leg in enumerate(scenario.leg) if leg.drift_safe]
        raise ScenarioError(f"{', '.join(asking)}: drift_safe, and the guidance given has no legs")
    place, time, legs = np.asarray(scenario.start.position, dtype=float), 0.0, []
    for number, (leg, release) in enumerate(zip(scenario.leg, released(scenario), strict=True)):
        progress(number / len(scenario.leg), named("leg", leg, number))
        limit, goal, told = leg.speed_limit or scenario.chaser.speed_limit, np.asarray(leg.position, dtype=float), {}
        if leg.drift_safe:
            way = replace(guidance, leg=jnp.asarray(number, guidance.leg.dtype)).way
            course = course_of(way, place, goal, named("leg", leg, number))
            times = time, time + way_length(course) / limit
            asked: dict[str, Any] = {"seconds": scenario.approach.abort_time, "limit": limit}
            speed, slowest = drift_speed(scenario, around.target.distance.distance, course, times, **asked)
            if not speed:
                raise ScenarioError(
                    f"{named('leg', leg, number)}: drift_safe, but at no speed down to {slowest:.3g} m/s every drift "
                    f"from it is proved clear for {scenario.approach.abort_time:g} s; make approach.abort_time "
                    "shorter, or leave the leg to the retreat"
                )
            limit, told = speed, {"speed_limit": speed, "drift_safe": False}
        time = max(time + float(np.linalg.norm(goal - place)) / limit + leg.dwell, release)
        legs.append(leg.model_dump() | told)
        place = goal
    return scenario.replace(leg=legs)


def course_of(way: Guidance, start: Point, goal: Point, name: str) -> Float[np.ndarray, "_ 3"]:
    """Follow a guidance from a place to its goal; the corners of its course, m. `name` is the leg's, in refusals.

    Raises:
        ControlError: it does not lead there.

    """
    steps = int(np.ceil((_DETOUR * float(np.linalg.norm(goal - start)) + _MORE) / _STEP))
    places, arrived = _followed(way, jnp.asarray(start), jnp.asarray(goal), steps)
    if not bool(arrived[-1]):
        raise ControlError(f"{name}: drift_safe, and no course leads from {start.tolist()} m to {goal.tolist()} m")
    return np.concatenate([start[None], np.asarray(places)[~np.asarray(arrived)], goal[None]])


@eqx.filter_jit
def _followed(
    way: Guidance, start: Vector, goal: Vector, steps: int
) -> tuple[Float[Array, "steps 3"], Bool[Array, "steps"]]:
    def step(place: Vector, _: None) -> tuple[Vector, tuple[Vector, Array]]:
        wanted = way.desired_velocity(place)
        after = place + _STEP * wanted / jnp.maximum(norm(wanted), 1e-12)
        there = norm(place - goal) <= 1.5 * _STEP
        after = jnp.where(there, place, after)
        return after, (after, norm(after - goal) <= 1.5 * _STEP)

    return jax.lax.scan(step, start, length=steps)[1]

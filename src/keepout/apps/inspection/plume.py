"""No thrust towards declared parts of the target: where a plume goes, and whether it reaches them.

A plume is a cone: its apex the place of a thruster, its axis opposite to its force, cut off at a range. Each thruster
that fires has one (`nozzles`). What of the target stands between is not looked at: the answer errs towards "reached".

A cone K about d of half angle α ≤ 90°, cut at a range ρ, is convex. The point of it nearest to w, both from the apex,
is the nearest one of the whole cone, cut back to ρ. A ball is reached where its centre's distance from K is at most its
radius. For a box, projections on box and cone in turn lead to the nearest pair; the difference n of the pair is the
normal of a plane, and what that plane proves is the lower bound that decides: n̂·y over the box, less n̂·z over K.
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from keepout.apps.inspection.nozzles import Nozzles
from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.control.law import Command, Condition, Law
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.relative import MotionState

_FAR = 1e4
"""Metres that a plume without a range reaches."""
_ROUNDS = 100
"""Projections in turn: what they leave open counts as reached."""
_ROUNDING = 1e-7
"""Metres: more than float64 loses at that range."""


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

    lower: Float[Array, "parts 3"]
    upper: Float[Array, "parts 3"]
    radius: Float[Array, " parts"]
    half_angle: Float[Array, ""]
    reach: Float[Array, ""]
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
        return cls(
            jnp.asarray(lower, jnp.float64),
            jnp.asarray(upper, jnp.float64),
            jnp.asarray(radius, jnp.float64),
            jnp.asarray(min(entry.plume_half_angle + nozzles.wide, 0.5 * math.pi), jnp.float64),
            jnp.asarray(reach, jnp.float64),
            nozzles,
        )

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


class SparingLaw(Law):
    """A law whose force fires no thruster whose plume would reach a protected part.

    The guard comes after it and may still fire any thruster: not to touch goes before not to blow.

    Attributes:
        law: that leads.
        protected: parts and plume.
        moved: that the chaser flies while a force is held, m.

    """

    law: Law
    protected: Protected
    moved: float

    @property
    def goal(self) -> Float[Array, "3"]:
        """Where the law leads, m."""
        return self.law.goal

    def flown(self) -> Law:
        """Give the same about its law without what flying does not need."""
        return dataclasses.replace(self, law=self.law.flown())

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Those of the law that leads."""
        return self.law.conditions

    def initial_state(self, state: MotionState) -> PyTree:
        """Give the memory of the law that leads."""
        return self.law.initial_state(state)

    def begun_with(self, state: MotionState, under_way: Float[Array, "steps 3"]) -> PyTree:
        """Give the memory of the law that leads."""
        return self.law.begun_with(state, under_way)

    def step(self, state: PyTree, estimate: MotionState) -> tuple[PyTree, Command]:
        """Give the law's force without the thrusters that are forbidden here."""
        state, command = self.law.step(state, estimate)
        reached = self.protected.reached(estimate.position, self.moved)
        force = self.protected.nozzles.without(command.force, reached)
        return self.law.with_applied_force(state, force), eqx.tree_at(lambda c: c.force, command, force)

    def with_applied_force(self, state: PyTree, force: Float[Array, "3"]) -> PyTree:
        """Tell the law that leads."""
        return self.law.with_applied_force(state, force)


def sparing(law: Law, scenario: Scenario) -> Law:
    """Give a law that spares a scenario's protected parts; the law itself where there are none."""
    protected = Protected.of(scenario)
    if protected is None:
        return law
    moved = scenario.chaser.speed_limit * scenario.control.period + protected.nozzles.excursion
    return SparingLaw(law, protected, moved)

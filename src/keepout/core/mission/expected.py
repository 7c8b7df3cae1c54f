"""What a flight will take, estimated from the way that its law leads: no flight, and no bound."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from keepout.core.control.controller import Controller
from keepout.core.control.law import AheadOfDelay
from keepout.core.control.legs import LegLaw
from keepout.core.flight.faults import BrokenLaw
from keepout.core.flight.setup import FlightSetup
from keepout.core.mission.build import Mission
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState

_LONGEST = 4
"""Times a scenario's own duration after which a way is given up."""
_LEAST_STEPS = 5000


@dataclass(frozen=True)
class Expected:
    """Estimates, each of what the working law does without faults.

    Attributes:
        way: along which the law leads to the goal, m; None where it does not.
        least_duration: that way at the speed limit, s.
        duration: with the law's own speeds along it, s.
        disturbance_delta_v: to hold against the disturbance for the whole flight, ∫‖d‖/m dt, m/s.
        drift_delta_v: to hold against the drift (gravity's difference, the frame's turning), likewise, m/s.
        speed_delta_v: to start and to stop, twice the largest speed on the way, m/s.

    """

    way: float | None
    least_duration: float | None
    duration: float | None
    disturbance_delta_v: float
    drift_delta_v: float
    speed_delta_v: float

    @property
    def delta_v(self) -> float:
        """The sum, m/s: an estimate, as what pushes the right way need not be held against."""
        return self.disturbance_delta_v + self.drift_delta_v + self.speed_delta_v

    def summary(self) -> dict[str, Any]:
        """Give the estimates as plain numbers for JSON, named with their units."""
        named = asdict(self)
        units = {"way": "m", "least_duration": "s", "duration": "s"}
        figures = {f"{key}_{units.get(key, 'mps')}": value for key, value in named.items()}
        return {**figures, "delta_v_mps": self.delta_v, "kind": "estimate"}


class _Way(eqx.Module):
    """The flight without inertia, so far."""

    at: MotionState
    memory: Float[Array, "3"]
    length: Float[Array, ""]
    fastest: Float[Array, ""]
    disturbance: Float[Array, ""]
    drift: Float[Array, ""]
    arrived: Float[Array, ""]


def expected(mission: Mission) -> Expected:
    """Estimate what a mission takes, by following its law's safe velocity from the start without inertia."""
    law = mission.setup.controller
    while isinstance(law, AheadOfDelay | BrokenLaw):
        law = law.law
    most, ends = max(_LONGEST * mission.steps, _LEAST_STEPS), []
    if isinstance(law, LegLaw):
        ends = _leg_by_leg(mission, law, most)
    else:
        assert isinstance(law, Controller)
        ends = [_followed(mission.setup, law, mission.initial, as_float64(mission.steps), as_float64(most))]
    end, way = ends[-1], sum(float(end.length) for end in ends)
    arrived = float(end.arrived)
    reached = math.isfinite(arrived)
    return Expected(
        way=way if reached else None,
        least_duration=way / mission.scenario.chaser.speed_limit if reached else None,
        duration=arrived if reached else None,
        disturbance_delta_v=sum(float(end.disturbance) for end in ends),
        drift_delta_v=sum(float(end.drift) for end in ends),
        speed_delta_v=2.0 * sum(float(end.fastest) for end in ends),
    )


def _leg_by_leg(mission: Mission, law: LegLaw, most: int) -> list[_Way]:
    """Follow one leg after the other, each from where the one before ends, once it was held and is released.

    Raises nothing: a leg that does not lead to its place is the last, with an infinite time of arrival.
    """
    ends, at, begun = [], mission.initial, float(mission.initial.time)
    for number, leg in enumerate(mission.scenario.leg):
        setup = replace(mission.setup, goal=as_float64(leg.position), tolerance=as_float64(leg.tolerance))
        last = number + 1 == len(mission.scenario.leg)
        steps = max(mission.steps - begun / float(setup.period), 0.0) if last else 0.0
        way = _followed(setup, law.at_leg(jnp.asarray(number, jnp.int32)), at, as_float64(steps), as_float64(most))
        arrived = begun + float(way.arrived)
        ends.append(replace(way, arrived=as_float64(arrived)))
        if not math.isfinite(arrived):
            break
        begun = max(arrived + float(law.legs.dwell[number]), float(law.legs.release[number]))
        at = replace(way.at, time=as_float64(begun))
    return ends


@eqx.filter_jit
def _followed(
    setup: FlightSetup, law: Controller, initial: MotionState, steps: Float[Array, ""], most: Float[Array, ""]
) -> _Way:
    """Follow the safe velocity until the goal is reached and the flight's `steps` are over, or `most` are."""
    zero = jnp.zeros(())
    period, mass = setup.period, setup.mass
    nothing, still = NoDisturbance(), jnp.zeros(3)

    def going(way: _Way) -> Bool[Array, ""]:
        count = jnp.round((way.at.time - initial.time) / period)
        return (count < steps) | (jnp.isinf(way.arrived) & (count < most))

    def step(way: _Way) -> _Way:
        at = way.at
        point, memory = law.velocity.at_time(at.time)(at.position, at.velocity, way.memory)
        held = at.time - initial.time < steps * period
        speed = jnp.linalg.norm(point.velocity)
        near = jnp.linalg.norm(at.position - setup.goal) < setup.tolerance
        arrived = jnp.where(jnp.isinf(way.arrived) & near, at.time - initial.time, way.arrived)
        # Only what turns the frame is stepped; the chaser goes where its velocity points.
        turned = setup.motion.step(at, still, nothing, period, mass)
        moved = eqx.tree_at(
            lambda state: (state.position, state.velocity),
            turned,
            (at.position + period * point.velocity, point.velocity),
        )
        push = jnp.linalg.norm(setup.disturbance.force(at.time)) / mass
        drift = jnp.linalg.norm(setup.motion.drift_acceleration(at))
        return _Way(
            at=moved,
            memory=memory,
            length=way.length + jnp.where(jnp.isinf(arrived), speed * period, 0.0),
            fastest=jnp.maximum(way.fastest, speed),
            disturbance=way.disturbance + jnp.where(held, push * period, 0.0),
            drift=way.drift + jnp.where(held, drift * period, 0.0),
            arrived=arrived,
        )

    at_rest = eqx.tree_at(lambda state: state.velocity, initial, jnp.zeros(3))
    begin = _Way(at_rest, jnp.zeros(3), zero, zero, zero, zero, jnp.full((), jnp.inf))
    return jax.lax.while_loop(going, step, begin)

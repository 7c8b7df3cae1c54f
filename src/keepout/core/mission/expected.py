"""What a flight will take, estimated from the way that its law leads: no flight, and no bound."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from keepout.core.control.controller import Controller
from keepout.core.control.law import AheadOfDelay
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
    assert isinstance(law, Controller)
    most = max(_LONGEST * mission.steps, _LEAST_STEPS)
    end = _followed(mission.setup, law, mission.initial, as_float64(mission.steps), as_float64(most))
    way, arrived = float(end.length), float(end.arrived)
    reached = math.isfinite(arrived)
    return Expected(
        way=way if reached else None,
        least_duration=way / mission.scenario.chaser.speed_limit if reached else None,
        duration=arrived if reached else None,
        disturbance_delta_v=float(end.disturbance),
        drift_delta_v=float(end.drift),
        speed_delta_v=2.0 * float(end.fastest),
    )


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
        point, memory = law.velocity(at.position, at.velocity, way.memory)
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

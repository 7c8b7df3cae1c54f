"""What became of a flight, in a few numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from keepout.core.flight.loop import FlightLog
from keepout.core.flight.setup import FlightSetup, Scalar
from keepout.core.guard.safety_layer import mode
from keepout.core.motion.rotation import Vector

STATUSES = 16
"""Status values 0 to 15 are counted apart; a status beyond counts as the last."""


class FlightOutcome(eqx.Module):
    """Summary of one flight (leading axes: of many).

    Attributes:
        minimum_barrier: the least h, m.
        final_error: ‖r − goal‖ at the end, m.
        reached: whether the chaser was closer to the goal than the tolerance from some time until the end, and the
            flight is finite.
        time_to_reach: that time, s after the start; infinite if not reached.
        delta_v: Σ ‖F‖ T/m over the steps flown, m/s.
        saturated_fraction: of the steps flown, those in which a thruster reached its limit.
        guard_interventions: steps in which the guard replaced the command.
        control_status_counts: steps by status value.
        guard_status_counts: likewise, without the guard's flags.
        guard_flags: every flag that the guard raised, as bits.
        finite: whether every position, velocity and force is a number.
        propellant: burnt over the steps flown, kg; None where the thrusters do not tell it.

    """

    minimum_barrier: Float[Array, "*flights"]
    final_error: Float[Array, "*flights"]
    reached: Bool[Array, "*flights"]
    time_to_reach: Float[Array, "*flights"]
    delta_v: Float[Array, "*flights"]
    saturated_fraction: Float[Array, "*flights"]
    guard_interventions: Int[Array, "*flights"]
    control_status_counts: Int[Array, "*flights 16"]
    guard_status_counts: Int[Array, "*flights 16"]
    guard_flags: Int[Array, "*flights"]
    finite: Bool[Array, "*flights"]
    propellant: Float[Array, "*flights"] | None = None


def outcome(setup: FlightSetup, log: FlightLog) -> FlightOutcome:
    """Summarise one flight's log (`steps` + 1 rows; what was done in the last row was not flown)."""
    return _summary(log, setup.goal, setup.tolerance, setup.period, setup.mass)


@jax.jit  # of the numbers alone, so that flights of one length share a program whatever steers them
def _summary(log: FlightLog, goal: Vector, tolerance: Scalar, period: Scalar, mass: Scalar) -> FlightOutcome:
    error = jnp.linalg.norm(log.position - goal, axis=-1)
    near = error < tolerance  # false where the error is not a number
    away = jnp.where(near, -1, jnp.arange(near.shape[0]))
    arrival = jnp.max(away) + 1
    finite = jnp.all(jnp.isfinite(log.position)) & jnp.all(jnp.isfinite(log.velocity))
    finite = finite & jnp.all(jnp.isfinite(log.force[:-1]))
    reached = near[-1] & finite
    guard_status = log.guard_status[:-1]
    guard_mode = mode(guard_status)
    arrival_time = log.time[jnp.minimum(arrival, near.shape[0] - 1)] - log.time[0]
    return FlightOutcome(
        minimum_barrier=jnp.min(log.barrier),
        final_error=error[-1],
        reached=reached,
        time_to_reach=jnp.where(reached, arrival_time, jnp.inf),
        delta_v=jnp.sum(jnp.linalg.norm(log.force[:-1], axis=-1)) * period / mass,
        saturated_fraction=jnp.mean(log.saturated[:-1].astype(jnp.float64)),
        guard_interventions=jnp.sum(guard_mode != 0),
        control_status_counts=_count(log.control_status[:-1]),
        guard_status_counts=_count(guard_mode),
        guard_flags=jnp.bitwise_or.reduce(guard_status - guard_mode),
        finite=finite,
        propellant=None if log.propellant is None else jnp.sum(log.propellant[:-1]),
    )


def _count(status: Int[Array, "steps"]) -> Int[Array, "16"]:
    known = jnp.clip(status, 0, STATUSES - 1)
    return jnp.sum(known[:, None] == jnp.arange(STATUSES), axis=0)

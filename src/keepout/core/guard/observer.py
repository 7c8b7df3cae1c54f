"""The guard's observer in flight: x̂ = x̄ + H (told − x̄), and when its error's bound begins anew (docs/guard.md, 2).

The radii of `braking.observed_radii` hold for an observer that began with an error within (ε_r, ε_v), was told no
estimate with a larger one since, and was driven by no acceleration beyond D. Where that is not known – after a step
without a certified plan, or without an estimate that good – the observer is moved into the ball about the next good
estimate in which its error is within (ε_r, ε_v), and begins again.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.guard import watch
from keepout.core.guard.braking import BrakingDesign, GuardAssumptions, ObserverGain
from keepout.core.motion.arrays import Flag, Scalar, Vector, norm
from keepout.core.motion.relative import MotionState


class ObserverState(eqx.Module):
    """What the observer remembers from one step to the next.

    Attributes:
        expected_position: x̄ of the next step, m.
        expected_velocity: likewise, m/s.
        steady: whether every step since one that accepted a candidate left a certified plan, and was told an estimate
            within the bounds assumed.
        doubts: errors that `watch` allows for.

    """

    expected_position: Vector
    expected_velocity: Vector
    steady: Flag
    doubts: watch.Doubts


def begin(estimate: MotionState, assumptions: GuardAssumptions, windows: tuple[int, ...]) -> ObserverState:
    """Give the memory before the first step, from the estimate that the first plan is made for."""
    errors = caps(assumptions)
    doubts = watch.Doubts(errors, jnp.broadcast_to(errors[1], (len(windows),)))
    return ObserverState(estimate.position, estimate.velocity, jnp.asarray(True), doubts)


def caps(assumptions: GuardAssumptions) -> Float[Array, "2"]:
    """Bounds ε_r (m) and ε_v (m/s) that every estimate keeps."""
    return jnp.asarray(assumptions.estimate_errors)


def beyond(
    assumptions: GuardAssumptions,
    gain: ObserverGain,
    off_position: Vector,
    off_velocity: Vector,
    errors: Float[Array, "2"],
) -> Flag:
    """Whether what is told is further from x̄ (m, m/s) than its errors, those of x̂ a step ago, D and a fault explain."""
    T, D = assumptions.period, assumptions.disturbance + assumptions.fault_push
    further = errors[0] + gain.error_radius + T * gain.velocity_error_radius + 0.5 * T**2 * D
    faster = errors[1] + gain.velocity_error_radius + T * D
    return (norm(off_position) > watch.loosened(further)) | (norm(off_velocity) > watch.loosened(faster))


def correct(
    assumptions: GuardAssumptions,
    braking: BrakingDesign,
    state: ObserverState,
    position: Vector,
    velocity: Vector,
    errors: Float[Array, "2"],
    first: Flag,
    beyond: Flag,
) -> tuple[Vector, Vector]:
    """Give x̂, from the position (m) and velocity (m/s) told and the bounds of their errors.

    An estimate with larger errors than assumed counts as much less as they are larger; one of which nothing is known
    not at all. The `first` step leaves x̄, the estimate that the flight's first plan was made for. Where what is told is
    `beyond` explanation, and within its bounds, the observer begins again from it.
    """
    gain, T, most = braking.observer, assumptions.period, caps(assumptions)
    assert gain is not None
    within = errors <= most
    share = jnp.min(jnp.where(within, 1.0, most / jnp.where(errors > most, errors, jnp.inf)))
    share = jnp.where(first, 0.0, share)
    off_r, off_v = position - state.expected_position, velocity - state.expected_velocity
    seen_r = state.expected_position + share * (gain.position * off_r + (1.0 - gain.position) * T * off_v)
    seen_v = state.expected_velocity + share * (gain.velocity * off_v)
    again = (~state.steady | beyond) & jnp.all(within)
    return _moved(seen_r, position, most[0] - errors[0], again), _moved(seen_v, velocity, most[1] - errors[1], again)


def _moved(seen: Vector, told: Vector, room: Scalar, wanted: Flag) -> Vector:
    """Move `seen` into the ball of radius `room` about what is told, where that is wanted."""
    away, room = seen - told, jnp.maximum(room, 0.0)
    return jnp.where(wanted, told + away * jnp.minimum(1.0, room / jnp.maximum(norm(away), 1e-300)), seen)


def advance(
    assumptions: GuardAssumptions,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
    steady: Flag,
    doubts: watch.Doubts,
) -> ObserverState:
    """Give the memory for the next step, from x̂ and the commanded acceleration that acts until then, m/s²."""
    T = assumptions.period
    return ObserverState(
        expected_position=position + T * velocity + 0.5 * T**2 * acceleration,
        expected_velocity=velocity + T * acceleration,
        steady=steady,
        doubts=doubts,
    )

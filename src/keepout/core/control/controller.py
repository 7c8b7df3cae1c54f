"""The control law: tracking of the safe velocity (paper, section V-B), and one step of observer, velocity and it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.control.law import Command, Condition, ControlStatus, Law
from keepout.core.control.observer import Observer
from keepout.core.control.velocity import SafeVelocity, VelocityPoint
from keepout.core.control.velocity_program import ConeStatus
from keepout.core.motion.arrays import Flag, Scalar, Vector, as_float64, norm
from keepout.core.motion.relative import MotionState, RelativeMotion

_NO_GRADIENT = 1e-24


def safety_gain(a: Scalar, b: Scalar, sharpness: Scalar) -> Scalar:
    """Return Λ(a, b) = ln(1 + exp(−ε a/b))/ε, and 0 where b = 0 (paper Eq. SmoothSafetyFiltersParam).

    Free of overflow for any a and b ≥ 0, with finite derivatives on both branches.
    """
    usable = b > _NO_GRADIENT
    ratio = -sharpness * a / jnp.where(usable, b, 1.0)
    return jnp.where(usable, jnp.logaddexp(0.0, ratio) / sharpness, 0.0)


class TrackingPoint(eqx.Module):
    """The tracking layer at one state.

    `reference` u_ref and `control` u in N (both before the disturbance is compensated), `backstepping_barrier` h₁ in
    m and `lyapunov` V₁ in m², both with the unknown estimation error e_d taken as zero.
    """

    reference: Vector
    control: Vector
    backstepping_barrier: Scalar
    lyapunov: Scalar


class Tracking(eqx.Module):
    """u_ref, Λ, h₁ and V₁ (paper Eqs. composite_controller to SmoothSafetyFiltersParam), with the sign of g corrected.

    `gain` λ (1/s), `position_weight` H₀ (3, 3), `lyapunov_ratio` μ_v (1/s²), `barrier_ratio` μ_h (m/s²),
    `estimation_weight` β (m/N²), `estimation_rate` β_e and `barrier_rate` β_c (1/s), `sharpness` ε, `gradient_error`
    e_∇h. `acceleration_limit` (m/s²), where given, limits the norm of the velocity and position feedback; its
    direction stays.
    """

    gain: Scalar = eqx.field(converter=as_float64)
    position_weight: Float[Array, "3 3"] = eqx.field(converter=as_float64)
    lyapunov_ratio: Scalar = eqx.field(converter=as_float64)
    barrier_ratio: Scalar = eqx.field(converter=as_float64)
    estimation_weight: Scalar = eqx.field(converter=as_float64)
    estimation_rate: Scalar = eqx.field(converter=as_float64)
    barrier_rate: Scalar = eqx.field(converter=as_float64)
    sharpness: Scalar = eqx.field(converter=as_float64)
    gradient_error: Scalar = eqx.field(converter=as_float64)
    acceleration_limit: Scalar | None = None

    def __call__(
        self, point: VelocityPoint, position_error: Vector, velocity: Vector, drift: Vector, mass: Scalar
    ) -> TrackingPoint:
        """Return the tracking layer for r_e (m), v (m/s), the drift acceleration (m/s²) and a mass in kg."""
        error = velocity - point.velocity
        square = jnp.sum(error * error)
        pull = self.position_weight @ position_error
        feedback = -self.lyapunov_ratio * pull - 0.5 * self.gain * error
        if self.acceleration_limit is not None:
            size = jnp.sqrt(jnp.sum(feedback * feedback) + 1e-300)
            feedback = feedback * jnp.minimum(1.0, self.acceleration_limit / size)
        feedforward = -drift + point.jacobian @ velocity
        reference = mass * (feedforward + feedback)

        # With u_ref put in, P·u_ref cancels against (v − v_s)·(−drift + J v)/μ_h; the feedback is what remains.
        gradient = -error / (mass * self.barrier_ratio)
        b = jnp.sum(gradient * gradient)
        speed = norm(velocity)
        barrier = point.barrier - square / (2.0 * self.barrier_ratio)
        a = (
            -jnp.sum(error * feedback) / self.barrier_ratio
            + jnp.sum(point.normal * velocity)
            - self.gradient_error * speed
            + self.barrier_rate * barrier
            - b / (2.0 * self.estimation_weight * (2.0 * self.estimation_rate - self.barrier_rate))
        )
        control = reference + safety_gain(a, b, self.sharpness) * gradient
        lyapunov = 0.5 * jnp.sum(position_error * pull) + square / (2.0 * self.lyapunov_ratio)
        return TrackingPoint(reference, control, barrier, lyapunov)


class ControllerState(eqx.Module):
    """What the law carries from step to step: the previous sample, the force held since, and its layers' memories.

    Attributes:
        velocity: of the previous sample, m/s.
        drift: acceleration without force and disturbance at the previous sample, m/s².
        force: held since then, N.
        observer: the disturbance observer's memory.
        circulation: the circulation's memory.
        started: whether there was a previous sample that was finite.

    """

    velocity: Vector
    drift: Vector
    force: Vector
    observer: Float[Array, " q"]
    circulation: Vector
    started: Flag


class Controller(Law):
    """The law as one pytree: it can be closed over, passed through `jit`, and batched with `vmap` (say over goals).

    Attributes:
        velocity: the layer that gives the safe velocity.
        tracking: the layer that follows it.
        observer: of the disturbance, for estimates that come without one.
        motion: the model behind the drift compensation.
        mass: kg.
        force_limit: of each body axis, N.
        nominal_offset: the part of the velocity layer's offset that is the law's own, m.
        checked: what `conditions.conditions` found at construction.

    """

    velocity: SafeVelocity
    tracking: Tracking
    observer: Observer
    motion: RelativeMotion
    mass: Scalar
    force_limit: Vector
    nominal_offset: Scalar
    checked: tuple[Condition, ...] = eqx.field(static=True, default=())

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The design conditions, checked at construction."""
        return self.checked

    def flown(self) -> Law:
        """Give the law without what was found of its conditions."""
        return dataclasses.replace(self, checked=())

    @property
    def goal(self) -> Vector:
        """Where the law leads, m."""
        return self.velocity.guidance.goal

    def initial_state(self, state: MotionState) -> ControllerState:
        """Return the law's state before its first step."""
        return ControllerState(
            velocity=state.velocity,
            drift=self.motion.drift_acceleration(state),
            force=jnp.zeros(3),
            observer=self.observer.initial_state(state.velocity),
            circulation=jnp.zeros(3),
            started=jnp.asarray(False),
        )

    def with_applied_force(self, state: ControllerState, force: Vector) -> ControllerState:
        """Return the state told that `force` (N) is held from now on instead of the one commanded.

        Without this the observer takes the difference for a disturbance.
        """
        return eqx.tree_at(lambda s: s.force, state, force)

    def step(self, state: ControllerState, estimate: MotionState) -> tuple[ControllerState, Command]:
        """Run one control step on an estimate of the motion; call it once a period.

        Where the estimate comes with a disturbance the law cancels that one, and its observer rests.
        """
        drift = self.motion.drift_acceleration(estimate)
        velocity = estimate.velocity
        if estimate.disturbance is None:
            updated = self.observer.update(
                state.observer, state.velocity, velocity, 0.5 * (state.drift + drift), state.force
            )
            memory = jnp.where(state.started, updated, state.observer)
            push, push_ahead = self.observer.estimate(memory, velocity), self.observer.mean_ahead(memory, velocity)
        else:  # a filter has estimated it together with the motion
            memory, push, push_ahead = state.observer, estimate.disturbance, estimate.disturbance
        at_time = self.velocity.at_time(estimate.time)
        point, circulation = at_time(estimate.position, velocity, state.circulation)
        tracked = self.tracking(point, estimate.position - self.goal, velocity, drift, self.mass)
        wanted = tracked.control - push_ahead
        finite = jnp.all(jnp.isfinite(wanted)) & (point.status != ConeStatus.NOT_FINITE)
        force = jnp.where(finite, jnp.clip(wanted, -self.force_limit, self.force_limit), 0.0)

        status = jnp.where(jnp.any(jnp.abs(wanted) > self.force_limit), ControlStatus.SATURATED, ControlStatus.NOMINAL)
        status = jnp.where(point.status == ConeStatus.INFEASIBLE, ControlStatus.OUTSIDE_SAFE_SET, status)
        status = jnp.where(point.status == ConeStatus.STALLED, ControlStatus.SOLVER_STALLED, status)
        status = jnp.where(point.status == ConeStatus.NO_WAY_OUT, ControlStatus.NO_WAY_OUT, status)
        status = jnp.where(finite, status, ControlStatus.NOT_FINITE).astype(jnp.int32)
        command = Command(
            force=force,
            desired_velocity=point.desired,
            safe_velocity=point.velocity,
            disturbance_estimate=push,
            barrier=point.barrier + self.nominal_offset,
            backstepping_barrier=tracked.backstepping_barrier,
            lyapunov=tracked.lyapunov,
            status=status,
        )
        # A sample that is not a number must not stay in the memory.
        clean = ControllerState(velocity, drift, force, memory, circulation, jnp.asarray(True))
        whole = finite & jnp.all(jnp.isfinite(velocity)) & jnp.all(jnp.isfinite(drift)) & jnp.all(jnp.isfinite(memory))
        kept = eqx.tree_at(lambda s: (s.force, s.started), state, (force, jnp.asarray(False)))
        return jax.tree.map(lambda a, b: jnp.where(whole, a, b), clean, kept), command

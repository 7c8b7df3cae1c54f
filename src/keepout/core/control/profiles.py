"""The two named laws, `paper` with the printed constants and `default`, the recommended one; and what each has to meet.

A law is designed for an operation. The default law's gains come from what the chaser can do: mass, thrust, sampling,
disturbance and the speed wished for. Each design condition has its number, its limit and whether it holds.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.compiled.tried import THREE_NUMBERS, Asked, described, is_own
from keepout.core.control.barrier_grid import require_free
from keepout.core.control.controller import Controller, Tracking
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.guidance import Componentwise, ComponentwiseGuidance, Guidance, GuidancePlan, Point, Travel
from keepout.core.control.law import Condition
from keepout.core.control.observer import (
    ContinuousObserver,
    Observer,
    SampledObserver,
    harmonic_observer,
    printed_observer,
)
from keepout.core.control.velocity import (
    CirculationLaw,
    ClassK,
    ConstantCirculation,
    NoCirculation,
    SafeVelocity,
    SpeedCone,
    VelocityPoint,
    printed_circulation,
)
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.motion.arrays import Scalar, Vector, as_float64
from keepout.core.motion.chaser import Chaser
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.progress import Progress, silent

_STOPPING_DISTANCE = 3.0
"""Within which a chaser must be able to stop from its speed limit, m."""


@dataclass(frozen=True)
class Operation:
    """What a law is designed for, beside the field and the goal.

    Attributes:
        chaser: the body to steer.
        motion: the model behind the drift compensation.
        error_bound: e_h of the field, certified for the chaser's radius, m.
        margin: the operator's own, m.
        period: between control steps, s.
        disturbance_bound: largest norm of the force that nobody commanded, N.

    """

    chaser: Chaser
    motion: RelativeMotion
    error_bound: float
    disturbance_bound: float
    margin: float = 0.1
    period: float = 1.0

    @property
    def keep_out(self) -> float:
        """Value of the field, m, down to which the chaser may come: error bound, radius and margin together."""
        return self.error_bound + self.chaser.radius + self.margin


@dataclass(frozen=True)
class Tuning:
    """Gains of the default law.

    authority a_b (m/s²): acceleration left after disturbance and drift. braking a_c (m/s²): deceleration that the
    class-K function asks for. class_k_rate α₀, tracking_gain λ, estimation_rate β_e, barrier_rate β_c: 1/s.
    barrier_ratio μ_h: m/s². lyapunov_ratio μ_v: 1/s². estimation_weight β: m/N². slowing_length k_p, speed_reserve,
    nominal_offset: m. honoured_speed (m/s) is the largest one from which the thrusters can stop within the stopping
    distance.
    """

    authority: float
    braking: float
    class_k_rate: float
    tracking_gain: float
    estimation_rate: float
    barrier_rate: float
    barrier_ratio: float
    lyapunov_ratio: float
    estimation_weight: float
    slowing_length: float
    speed_reserve: float
    nominal_offset: float
    sharpness: float
    honoured_speed: float


def least_offset(speed_limit: float, period: float) -> float:
    """Give what the default law keeps beyond the keep-out zone, m: room for sampling, 1.2 periods of flight."""
    return max(0.12, 1.2 * speed_limit * period)


def tune(operation: Operation, *, drift_bound: float = 0.0) -> Tuning:
    """Compute the default law's gains, and say which speed the thrusters can honour.

    Args:
        operation: the chaser, the control period and the disturbance bound.
        drift_bound: largest drift acceleration on the way, m/s².

    For the paper's case (20 kg, 0.1 N, 1 Hz, 0.1 m/s) λ = 1/s, a_b = 4 mm/s², a_c = 2 mm/s², α₀ = 0.08/s.

    Raises:
        ControlError: a period that is not positive, disturbance and drift leave no authority, or the speed limit
            cannot be honoured.

    """
    chaser, period, disturbance_bound = operation.chaser, operation.period, operation.disturbance_bound
    mass, force_limit, speed_limit = chaser.mass, chaser.force_limit, chaser.speed_limit
    if not (np.isfinite(period) and period > 0.0):
        raise ControlError(f"period: {period} s; it must be positive and finite")
    authority = (force_limit - disturbance_bound) / mass - drift_bound
    if not authority > 0.0:
        raise ControlError(
            f"chaser.force_limit: disturbance ({disturbance_bound:.3g} N) and drift ({mass * drift_bound:.3g} N) use "
            f"up the thrust of {force_limit:.3g} N; drift grows with the distance of start.position and goal.position "
            "from the target; a nearer place, a larger force_limit, a lower speed or a slower turn would leave some"
        )
    honoured = float(np.sqrt(2.0 * authority * _STOPPING_DISTANCE))
    if speed_limit > honoured:
        raise ControlError(
            f"speed_limit: {speed_limit:.3g} m/s cannot be stopped within {_STOPPING_DISTANCE:.3g} m with "
            f"{authority:.3g} m/s2; at most {honoured:.3g} m/s"
        )
    gain, observer_gain = 1.0 / period, 0.9
    return Tuning(
        authority=authority,
        braking=0.5 * authority,
        class_k_rate=min(0.08, 0.08 / period),
        tracking_gain=gain,
        estimation_rate=float(-np.log(1.0 - observer_gain)) / period,
        barrier_rate=0.5 * gain,
        barrier_ratio=2.0 * authority,
        lyapunov_ratio=1e-6,
        estimation_weight=10.0,
        slowing_length=max(1.5, 0.77 * speed_limit**2 / authority),
        speed_reserve=0.1,
        nominal_offset=least_offset(speed_limit, period),
        # At full velocity error and 0.1 m of barrier the filter's exponential is exp(-20): it acts only where it must.
        sharpness=20.0 * (speed_limit / (2.0 * mass * authority)) ** 2 / (0.05 * gain),
        honoured_speed=honoured,
    )


def drift_bound(motion: RelativeMotion, *, radius: float, speed: float) -> float:
    """Return the largest drift acceleration (m/s²) found within `radius` m at speeds up to `speed` m/s.

    Sampled over directions and over eight moments of one orbit: an estimate for tuning, no bound that a proof may use.
    """
    directions = np.random.default_rng(0).normal(size=(2, 256, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    orbit = motion.orbit
    axis = float(orbit.semi_major_axis)
    period = 2.0 * np.pi * float(np.sqrt(axis * axis * axis / float(orbit.gravitational_parameter)))
    positions, velocities = as_float64(radius * directions[0]), as_float64(speed * directions[1])

    times = np.linspace(0.0, period, 8, endpoint=False)
    return max(float(_largest_drift(motion, as_float64(time), positions, velocities)) for time in times)


@kept_jit
def _largest_drift(
    motion: RelativeMotion, time: Scalar, positions: Float[Array, "n 3"], velocities: Float[Array, "n 3"]
) -> Scalar:
    """Give the largest drift acceleration (m/s²) at a moment (s) over positions (m) and velocities (m/s)."""
    at = motion.initial_state(jnp.zeros(3), jnp.zeros(3), time)

    def single(r: Vector, v: Vector) -> Scalar:
        moved = MotionState(at.time, r, v, at.attitude, at.angular_velocity, at.target_orbit)
        return jnp.linalg.norm(motion.drift_acceleration(moved))

    return jnp.max(jax.vmap(single)(positions, velocities))


@kept_jit
def _at_rest(law: SafeVelocity, position: Vector) -> VelocityPoint:
    """Give the velocity layer at a position (m) before anything is remembered; compiled once a kind of law."""
    return law(position, jnp.zeros(3), jnp.zeros(3))[0]


@kept_jit
def _drift_at_rest(motion: RelativeMotion, position: Vector) -> Scalar:
    """Give the drift acceleration (m/s²) of a chaser at rest at a position (m) at the epoch."""
    return jnp.linalg.norm(motion.drift_acceleration(motion.initial_state(position, jnp.zeros(3))))


@kept_jit
def _error_matrix(observer: ContinuousObserver | SampledObserver) -> Float[Array, "q q"]:
    return observer.error_matrix()


def conditions(
    controller: Controller, operation: Operation, *, start: Float[np.ndarray, "3"] | None = None
) -> tuple[Condition, ...]:
    """Check every design condition of a law (docs/control.md) for the operation that it is to fly.

    `start` (3,) m, at rest, adds the condition h₁(0) ≥ 0. The controller's arrays must hold one law, not a batch.
    """
    found = [
        *_of_gains(controller.tracking, controller.velocity, operation.period),
        *_of_observer(controller.observer, operation.period),
        *_of_circulation(controller.velocity.circulation),
        *_of_thrust(controller, operation),
    ]
    if start is not None:
        found.append(_of_start(controller, operation, start))
    return tuple(found)


def _of_gains(tracking: Tracking, law: SafeVelocity, period: float) -> Iterator[Condition]:
    """Check the rates against each other and the sampling, and the weight of the position."""
    beta_c, beta_e = float(tracking.barrier_rate), float(tracking.estimation_rate)
    alpha = float(law.class_k.rate)
    yield Condition("observer outpaces filter", "2 beta_e > beta_c, 1/s", 2.0 * beta_e, beta_c, 2.0 * beta_e > beta_c)
    yield Condition("filter outpaces barrier", "beta_c >= alpha_0, 1/s", beta_c, alpha, beta_c >= alpha)
    decay = beta_c * period
    yield Condition("sampled barrier", "beta_c T_s <= 1", decay, 1.0, decay <= 1.0)
    sampling = float(tracking.gain) * period / 2.0
    yield Condition("sampled tracking", "lambda T_s / 2 < 1", sampling, 1.0, sampling < 1.0)
    weight = np.asarray(tracking.position_weight)
    smallest = float(np.linalg.eigvalsh(weight).min())
    yield Condition("position weight", "smallest eigenvalue of H_0 > 0", smallest, 0.0, smallest > 0.0)
    if isinstance(law.guidance, ComponentwiseGuidance):
        # tanh acts by component: without a diagonal H_0, r_e' H_0 tanh(r_e/k_p) may be negative, and V_1 rise.
        beside = float(np.abs(weight - np.diag(np.diag(weight))).max())
        yield Condition("position weight and tanh", "largest |H_0| off its diagonal = 0", beside, 0.0, beside <= 0.0)


def _of_observer(observer: Observer, period: float) -> Iterator[Condition]:
    """Check that the estimation error decays, also as it is sampled."""
    if isinstance(observer, ContinuousObserver):
        rates = np.linalg.eigvals(np.asarray(_error_matrix(observer)))
        rate, factor = float(np.real(rates).max()), float(np.abs(1.0 + period * rates).max())
        yield Condition("observer", "largest real part of A - L C/m < 0, 1/s", rate, 0.0, rate < 0.0)
        said = "Euler step of the observer: largest |eigenvalue| < 1"
        yield Condition("observer sampled", said, factor, 1.0, factor < 1.0)
        model = float(np.real(np.linalg.eigvals(np.asarray(observer.generator))).max())
        said = "largest real part of A <= 0, 1/s"
        yield Condition("disturbance model", said, model, 0.0, model <= 1e-12, required=False)
    elif isinstance(observer, SampledObserver):
        factor = float(np.abs(np.linalg.eigvals(np.asarray(_error_matrix(observer)))).max())
        yield Condition("observer sampled", "largest |eigenvalue| of Phi - K C < 1", factor, 1.0, factor < 1.0)


def _of_circulation(circulation: CirculationLaw | None) -> Iterator[Condition]:
    """Check that it turns the chaser at the surface, and along it."""
    if circulation is not None:
        level = float(circulation.level)
        yield Condition("circulation at the surface", "Upsilon(0) > 0, m/s", level, 0.0, level > 0.0)
    if isinstance(circulation, ConstantCirculation):
        omega = np.asarray(circulation.omega)
        symmetric = float(np.abs(omega + omega.T).max())
        yield Condition("circulation tangent", "Omega + Omega' = 0", symmetric, 0.0, symmetric <= 1e-12, required=False)


def _of_thrust(controller: Controller, operation: Operation) -> Iterator[Condition]:
    """Check that the thrusters give what the barrier may ask for, and what holds the chaser at the goal."""
    law, disturbance_bound = controller.velocity, operation.disturbance_bound
    mass, force = float(controller.mass), float(np.min(np.asarray(controller.force_limit)))
    left = (force - disturbance_bound) / mass
    if law.class_k.braking is None:
        cap = law.speed.limit if law.speed is not None else law.box
        assert cap is not None
        asked = float(law.class_k.rate) * float(cap)
        yield Condition("authority", "alpha_0 v_max <= (F_max - d_max)/m, m/s2", asked, left, asked <= left)
    else:
        braking = float(law.class_k.braking)
        yield Condition("authority", "a_c <= (F_max - d_max)/m, m/s2", braking, left, braking <= left)
    hold = mass * float(_drift_at_rest(controller.motion, controller.goal)) + disturbance_bound
    yield Condition("hold at the goal", "m |drift(goal)| + d_max <= F_max, N", hold, force, hold <= force)


def _of_start(controller: Controller, operation: Operation, start: Float[np.ndarray, "3"]) -> Condition:
    """Check that the law's safe set holds a start (m) at rest."""
    # Only v_s is needed here, and its Jacobian is most of the time to compile.
    plain, tracking = replace(controller.velocity, differentiate=False), controller.tracking
    point = _at_rest(plain, as_float64(start))
    square = float(np.sum(np.asarray(point.velocity) ** 2))
    h1 = float(point.barrier) - square / (2.0 * float(tracking.barrier_ratio))
    h1 -= 0.5 * float(tracking.estimation_weight) * operation.disturbance_bound**2
    return Condition("start in the safe set", "h_1(0) >= 0 at rest, m", h1, 0.0, h1 >= 0.0, required=False)


class ControlWarning(UserWarning):
    """A law that flies although a condition of its theory is violated."""


def _point(name: str, value: Any) -> Point:
    array = np.asarray(value, dtype=float)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise ControlError(f"{name}: {value}; three finite numbers in metres are needed")
    return array


def _leader(guidance: Guidance | GuidancePlan, field: Field, offset: float, goal: Point, travel: Travel) -> Guidance:
    """Make a plan's guidance; it must lead to the goal, with a velocity there."""
    # Before a grid is built, which takes seconds.
    if not (isinstance(guidance, GuidancePlan) and guidance.refuses):
        require_free(field, offset, goal, "goal")
    if travel.start is not None:
        require_free(field, offset, travel.start, "start")
    if isinstance(guidance, GuidancePlan):
        guidance = guidance.guidance(field, offset, goal, travel)
    if not isinstance(guidance, Guidance):
        raise ControlError(f"guidance: {described(guidance)}; it must be a keepout.Guidance or a keepout.GuidancePlan")
    if is_own(guidance):
        asked = Asked(f"guidance: {type(guidance).__name__}.desired_velocity", f"{THREE_NUMBERS}, m/s", ControlError)
        velocity = asked.computed(lambda part, place: part.desired_velocity(place), guidance, as_float64(goal))
        asked.require_numbers(velocity, (3,))
    if not np.array_equal(np.asarray(guidance.goal), goal):
        raise ControlError(f"guidance: leads to {np.asarray(guidance.goal).tolist()}, and the goal is {goal.tolist()}")
    return guidance


def default(
    field: Field,
    operation: Operation,
    goal: Any,
    *,
    guidance: Guidance | GuidancePlan | None = None,
    circulation: CirculationLaw | NoCirculation | None = None,
    observer: Observer | None = None,
    start: Any | None = None,
    feedforward: bool = False,
    reach: float | None = None,
    progress: Progress = silent,
    **gains: float,
) -> Controller:
    """Build the recommended law (docs/control.md).

    Norm cap and speed cone instead of the box, a class-K function that brakes no harder than the thrusters can,
    tracking feedback limited to the authority that disturbance and drift leave, exact barrier gradient (no e_∇h).

    Args:
        field: the learned distance.
        operation: chaser, motion, certified error, margin, period and disturbance bound.
        goal: (3,) m, body frame.
        guidance: where to go; by default `Geodesic()`.
        circulation: by default none.
        observer: of the disturbance; by default `harmonic_observer` at the paper's frequencies.
        start: (3,) m, where given, is checked to be free and connected to the goal.
        feedforward: whether to use ∂v_s/∂r v; only for fields of low curvature.
        reach: distance from the target within which the drift is bounded for tuning, m; by default that of goal
            and start.
        progress: called while the guidance is made.
        **gains: entries of `Tuning` to override.

    Raises:
        ControlError: goal or start is not free or not connected, or a required condition is violated; the message
            names it with its numbers.

    """
    chaser, goal = operation.chaser, _point("goal", goal)
    start = None if start is None else _point("start", start)
    if reach is None:
        reach = float(max(np.linalg.norm(goal), 0.0 if start is None else np.linalg.norm(start)))
    drift = drift_bound(operation.motion, radius=reach, speed=chaser.speed_limit)
    tuning = _with_gains(tune(operation, drift_bound=drift), gains)
    offset = operation.keep_out + tuning.nominal_offset
    plan = Geodesic() if guidance is None else guidance
    travel = Travel(chaser.speed_limit, tuning.slowing_length, start, progress)
    law = SafeVelocity(
        field=field,
        offset=as_float64(offset),
        guidance=_leader(plan, field, offset, goal, travel),
        class_k=ClassK(as_float64(tuning.class_k_rate), as_float64(tuning.braking)),
        circulation=None if isinstance(circulation, NoCirculation) else circulation,
        speed=SpeedCone(*map(as_float64, (chaser.speed_limit, tuning.authority, tuning.speed_reserve))),
        differentiate=feedforward,
    )
    tracking = Tracking(
        gain=tuning.tracking_gain,
        position_weight=np.eye(3),
        lyapunov_ratio=tuning.lyapunov_ratio,
        barrier_ratio=tuning.barrier_ratio,
        estimation_weight=tuning.estimation_weight,
        estimation_rate=tuning.estimation_rate,
        barrier_rate=tuning.barrier_rate,
        sharpness=tuning.sharpness,
        gradient_error=0.0,
        acceleration_limit=as_float64(tuning.authority),
    )
    if observer is None:
        observer = harmonic_observer(mass=chaser.mass, period=operation.period)
    made = _composed(law, tracking, observer, operation, tuning.nominal_offset, start)
    broken = [c for c in made.checked if c.required and not c.satisfied]
    if broken:
        raise ControlError("default law: " + "; ".join(str(c) for c in broken))
    return made


def _with_gains(tuning: Tuning, gains: dict[str, float]) -> Tuning:
    unknown = set(gains) - set(vars(tuning))
    if unknown:
        raise ControlError(f"gains: {', '.join(sorted(unknown))} not known; the law has {', '.join(vars(tuning))}")
    return replace(tuning, **gains)


def paper(
    field: Field,
    operation: Operation,
    goal: Any,
    *,
    guidance: Guidance | GuidancePlan | None = None,
    circulation: CirculationLaw | NoCirculation | None = None,
    observer: Observer | None = None,
    start: Any | None = None,
    gradient_error: float = 0.0,
    slowing_length: float = 1.5,
    sharpness: float = 1.0,
    position_weight: float = 1.0,
    progress: Progress = silent,
) -> Controller:
    """Build the law with the constants printed in section VI of the paper.

    The law flies although its constants violate conditions of its own theory, and says which in a `ControlWarning`.

    Args:
        field: the learned distance.
        operation: chaser, motion, certified error, margin, period and disturbance bound.
        goal: (3,) m, body frame.
        guidance: where to go; by default the paper's, `Componentwise()`.
        circulation: by default the paper's, `printed_circulation()`; `NoCirculation()` for none.
        observer: of the disturbance; by default the paper's, `printed_observer`.
        start: (3,) m, where given, is checked to be free.
        gradient_error: e_∇h, which the paper leaves open.
        slowing_length: k_p, m, likewise.
        sharpness: ε, likewise.
        position_weight: H₀ is this times the identity, likewise.
        progress: called while the guidance is made.

    Raises:
        ControlError: goal or start is not free, or an argument is out of range.

    """
    chaser, goal = operation.chaser, _point("goal", goal)
    start = None if start is None else _point("start", start)
    plan = Componentwise() if guidance is None else guidance
    travel = Travel(chaser.speed_limit, slowing_length, start, progress)
    turning = printed_circulation() if circulation is None else circulation
    law = SafeVelocity(
        field=field,
        offset=as_float64(operation.keep_out),
        guidance=_leader(plan, field, operation.keep_out, goal, travel),
        class_k=ClassK(as_float64(0.08)),
        circulation=None if isinstance(turning, NoCirculation) else turning,
        # Without e_∇h the barrier row is a half-space, and the program a quadratic one.
        gradient_error=None if gradient_error == 0.0 else as_float64(gradient_error),
        box=as_float64(chaser.speed_limit),
        row_per_zone=True,
    )
    tracking = Tracking(
        gain=15.0,
        position_weight=position_weight * np.eye(3),
        lyapunov_ratio=1e-4,
        barrier_ratio=2.0,
        estimation_weight=1.0,
        estimation_rate=0.1,
        barrier_rate=10.0,
        sharpness=sharpness,
        gradient_error=gradient_error,
    )
    if observer is None:
        observer = printed_observer(mass=chaser.mass, period=operation.period)
    made = _composed(law, tracking, observer, operation, 0.0, start)
    broken = "; ".join(str(c) for c in made.checked if not c.satisfied)
    if broken:
        said = f"paper law: it flies although its theory's conditions do not all hold: {broken}"
        warnings.warn(said, ControlWarning, stacklevel=2)
    return made


def _composed(
    law: SafeVelocity, tracking: Tracking, observer: Observer, operation: Operation, offset: float, start: Point | None
) -> Controller:
    """Put a law together that keeps an `offset` (m) beyond the keep-out zone, and check its conditions."""
    made = Controller(
        velocity=law,
        tracking=tracking,
        observer=observer,
        motion=operation.motion,
        mass=as_float64(operation.chaser.mass),
        force_limit=as_float64(np.full(3, operation.chaser.force_limit)),
        nominal_offset=as_float64(offset),
    )
    return replace(made, checked=conditions(made, operation, start=start))

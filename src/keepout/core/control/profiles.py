"""The two named laws: `paper`, with the printed constants, and `default`, the recommended one."""

import dataclasses
import warnings
from typing import Any

import numpy as np

from keepout.core.compiled.tried import THREE_NUMBERS, Asked, described, is_own
from keepout.core.control.barrier_grid import require_free
from keepout.core.control.controller import Controller, Tracking
from keepout.core.control.design import Operation, Tuning, conditions, drift_bound, tune
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.guidance import Componentwise, Guidance, GuidancePlan, Point
from keepout.core.control.observer import Observer, harmonic_observer, printed_observer
from keepout.core.control.velocity import (
    CirculationLaw,
    ClassK,
    NoCirculation,
    SafeVelocity,
    SpeedCone,
    printed_circulation,
)
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.motion.arrays import as_float64
from keepout.core.progress import Progress, silent


class ControlWarning(UserWarning):
    """A law that flies although a condition of its theory is violated."""


def _point(name: str, value: Any) -> Point:
    array = np.asarray(value, dtype=float)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise ControlError(f"{name}: {value}; three finite numbers in metres are needed")
    return array


def _leader(
    guidance: Guidance | GuidancePlan, field: Field, offset: float, goal: Point, start: Point | None, **led: Any
) -> Guidance:
    """Make a plan's guidance, `led` as `GuidancePlan.guidance` is; it must lead to the goal, with a velocity there."""
    # Before a grid is built, which takes seconds.
    if not (isinstance(guidance, GuidancePlan) and guidance.refuses):
        require_free(field, offset, goal, "goal")
    if start is not None:
        require_free(field, offset, start, "start")
    if isinstance(guidance, GuidancePlan):
        guidance = guidance.guidance(field, offset, goal, start=start, **led)
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
    stopping_distance: float = 3.0,
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
        stopping_distance: within which the chaser must be able to stop from its speed limit, m.
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
    tuning = _with_gains(tune(operation, drift_bound=drift, stopping_distance=stopping_distance), gains)
    offset = operation.keep_out + tuning.nominal_offset
    plan = Geodesic() if guidance is None else guidance
    led = {"speed": chaser.speed_limit, "slowing_length": tuning.slowing_length, "progress": progress}
    law = SafeVelocity(
        field=field,
        offset=as_float64(offset),
        guidance=_leader(plan, field, offset, goal, start, **led),
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
    made = _composed(law, tracking, observer, operation, nominal_offset=tuning.nominal_offset, start=start)
    broken = [c for c in made.checked if c.required and not c.satisfied]
    if broken:
        raise ControlError("default law: " + "; ".join(str(c) for c in broken))
    return made


def _with_gains(tuning: Tuning, gains: dict[str, float]) -> Tuning:
    unknown = set(gains) - set(vars(tuning))
    if unknown:
        names = ", ".join(vars(tuning))
        raise ControlError(f"gains: {', '.join(sorted(unknown))} not known; the law has {names}")
    return dataclasses.replace(tuning, **gains)


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
    led = {"speed": chaser.speed_limit, "slowing_length": slowing_length, "progress": progress}
    turning = printed_circulation() if circulation is None else circulation
    law = SafeVelocity(
        field=field,
        offset=as_float64(operation.keep_out),
        guidance=_leader(plan, field, operation.keep_out, goal, start, **led),
        class_k=ClassK(as_float64(0.08)),
        circulation=None if isinstance(turning, NoCirculation) else turning,
        # Without e_∇h the barrier row is a half-space, and the program a quadratic one.
        gradient_error=None if gradient_error == 0.0 else as_float64(gradient_error),
        box=as_float64(chaser.speed_limit),
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
    made = _composed(law, tracking, observer, operation, nominal_offset=0.0, start=start)
    broken = "; ".join(str(c) for c in made.checked if not c.satisfied)
    if broken:
        said = f"paper law: it flies although its theory's conditions do not all hold: {broken}"
        warnings.warn(said, ControlWarning, stacklevel=2)
    return made


def _composed(
    law: SafeVelocity,
    tracking: Tracking,
    observer: Observer,
    operation: Operation,
    *,
    nominal_offset: float,
    start: Point | None,
) -> Controller:
    """Put a law together, and check its conditions."""
    made = Controller(
        velocity=law,
        tracking=tracking,
        observer=observer,
        motion=operation.motion,
        mass=as_float64(operation.chaser.mass),
        force_limit=as_float64(np.full(3, operation.chaser.force_limit)),
        nominal_offset=as_float64(nominal_offset),
    )
    return dataclasses.replace(made, checked=conditions(made, operation, start=start))

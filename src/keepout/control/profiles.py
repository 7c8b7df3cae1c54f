"""The two named laws: `paper`, with the printed constants, and `default`, the recommended one."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.control.circulation import (
    PRINTED,
    CirculationLaw,
    ConstantCirculation,
    SwitchingCirculation,
    skew,
)
from keepout.control.conditions import Condition, conditions, drift_bound
from keepout.control.controller import Controller
from keepout.control.guidance.geodesic import BarrierGrid, geodesic_guidance, require_free
from keepout.control.guidance.guidance import ComponentwiseGuidance, Guidance, StraightGuidance
from keepout.control.observer import NoObserver, Observer, constant_observer, continuous, harmonic_observer
from keepout.control.tracking import Tracking
from keepout.control.tuning import Tuning, tune
from keepout.control.velocity import ClassK, SafeVelocity, SpeedCone
from keepout.errors import ControlError
from keepout.fields.evaluate import values
from keepout.fields.field import Field
from keepout.motion.relative import RelativeMotion
from keepout.progress import Progress, silent

__all__ = ["Condition", "ControlWarning", "Tuning", "conditions", "default", "drift_bound", "paper", "tune"]

PAPER_FREQUENCIES = (0.02, 0.01)
"""Of the paper's disturbance, rad/s."""


class ControlWarning(UserWarning):
    """A law that flies although a condition of its theory is violated."""


def _scalar(value: float | Array) -> Float[Array, ""]:
    return jnp.asarray(value, dtype=jnp.float64)


def _point(name: str, value: Any) -> Float[np.ndarray, "3"]:
    array = np.asarray(value, dtype=float)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise ControlError(f"{name}: {value}; three finite numbers in metres are needed")
    return array


def _circulation(
    kind: str, *, level: float, slope: float, weight: float, axis: Sequence[float]
) -> CirculationLaw | None:
    numbers = (_scalar(level), _scalar(slope), _scalar(weight))
    if kind == "none":
        return None
    if kind == "printed":
        return ConstantCirculation(jnp.asarray(PRINTED), *numbers)
    if kind == "skew":
        direction = np.asarray(axis, dtype=float)
        return ConstantCirculation(skew(jnp.asarray(direction / np.linalg.norm(direction))), *numbers)
    if kind == "switching":
        return SwitchingCirculation(*numbers, degenerate=_scalar(0.3))
    raise ControlError(f'circulation: "{kind}"; it must be "none", "printed", "skew" or "switching"')


def _observer(kind: str, *, mass: float, period: float, gain: float, frequencies: Sequence[float]) -> Observer:
    if kind == "off":
        return NoObserver()
    if kind == "constant":
        return constant_observer(mass=mass, period=period, gain=gain)
    if kind == "harmonic":
        return harmonic_observer(frequencies, mass=mass, period=period)
    raise ControlError(f'observer: "{kind}"; it must be "harmonic", "constant" or "off"')


def _bounds(field: Field, offset: float, goal: np.ndarray, start: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Find a box around goal, start and all where the barrier is below 1.5 m, by growing until its faces are clear.

    A distance is 1-Lipschitz, so a face is clear where its samples exceed 1.5 m by half their spacing.
    """
    points = np.stack([goal, np.zeros(3)] + ([] if start is None else [start]))
    lower, upper = points.min(axis=0) - 2.0, points.max(axis=0) + 2.0
    fractions = np.linspace(0.0, 1.0, 33)
    for _ in range(60):
        grown = False
        for axis in range(3):
            others = [a for a in range(3) if a != axis]
            u, v = np.meshgrid(fractions, fractions, indexing="ij")
            face = np.empty((u.size, 3))
            for other, fraction in zip(others, (u, v), strict=True):
                face[:, other] = lower[other] + fraction.ravel() * (upper[other] - lower[other])
            for side, edge in ((-1.0, lower), (1.0, upper)):
                face[:, axis] = edge[axis]
                gap = float(np.min(values(field, face))) - offset
                spread = 0.5 * float(np.hypot(*(upper[o] - lower[o] for o in others))) / 32.0
                if gap < 1.5 + spread:
                    edge[axis] += side * max(1.0, 1.5 + spread - gap)
                    grown = True
        if not grown:
            return lower, upper
    raise ControlError(
        "guidance bounds: the keep-out zone has no end near the target; give bounds=(lower, upper) in metres"
    )


def _guidance(
    kind: str,
    field: Field,
    offset: float,
    goal: np.ndarray,
    *,
    speed: float,
    slowing_length: float,
    start: np.ndarray | None,
    bounds: tuple[Any, Any] | None,
    grid: BarrierGrid | None,
    spacing: float | None,
    progress: Progress,
) -> Guidance:
    if kind not in ("geodesic", "straight"):
        raise ControlError(f'guidance: "{kind}"; it must be "geodesic" or "straight"')
    # Before the grid is built, which takes seconds.
    require_free(field, offset, goal, "goal")
    if start is not None:
        require_free(field, offset, start, "start")
    if kind == "geodesic":
        if grid is None:
            if bounds is None:
                lower, upper = _bounds(field, offset, goal, start)
            else:
                lower, upper = (_point("bounds", b) for b in bounds)
            grid = BarrierGrid.build(field, offset, lower, upper, spacing=spacing, progress=progress)
        return geodesic_guidance(grid, field, offset, goal, speed=speed, slowing_length=slowing_length, start=start)
    return StraightGuidance(jnp.asarray(goal), _scalar(speed), _scalar(slowing_length))


def default(
    field: Field,
    *,
    error_bound: float,
    chaser_radius: float,
    margin: float,
    goal: Any,
    motion: RelativeMotion,
    mass: float,
    force_limit: float,
    speed_limit: float,
    period: float,
    disturbance_bound: float,
    guidance: Literal["geodesic", "straight"] | str = "geodesic",
    circulation: Literal["none", "printed", "skew", "switching"] | str = "none",
    observer: Literal["harmonic", "constant", "off"] | str = "harmonic",
    bounds: tuple[Any, Any] | None = None,
    start: Any | None = None,
    grid: BarrierGrid | None = None,
    spacing: float | None = None,
    frequencies: Sequence[float] = PAPER_FREQUENCIES,
    feedforward: bool = False,
    circulation_axis: Sequence[float] = (1.0, 1.0, 1.0),
    reach: float | None = None,
    stopping_distance: float = 3.0,
    progress: Progress = silent,
    **gains: float,
) -> Controller:
    """Build the recommended law (design sections 2.6 to 2.8).

    Norm cap and speed cone instead of the box, a class-K function that brakes no harder than the thrusters can,
    tracking feedback limited to the authority that disturbance and drift leave, exact barrier gradient (no e_∇h).

    Args:
        field: the learned distance.
        error_bound: e_h for this chaser radius, m.
        chaser_radius: m.
        margin: the operator's, m.
        goal: (3,) m, body frame.
        motion: the model behind the drift compensation.
        mass: kg.
        force_limit: N per axis.
        speed_limit: m/s.
        period: control period, s.
        disturbance_bound: largest norm of the disturbance, N.
        guidance: "geodesic" or "straight".
        circulation: "none", "printed", "skew" or "switching".
        observer: "harmonic", "constant" or "off".
        bounds: (lower, upper) corners of the geodesic grid, m; by default a box around target, goal and start.
        start: (3,) m, where given, is checked to be free and connected to the goal.
        grid: a `BarrierGrid` to share between goals; it must have been built for the same offset.
        spacing: of the geodesic grid, m.
        frequencies: of the harmonic observer, rad/s.
        feedforward: whether to use ∂v_s/∂r v; only for fields of low curvature.
        circulation_axis: of the constant skew Ω.
        reach: distance from the target within which the drift is bounded for tuning, m; by default that of goal
            and start.
        stopping_distance: within which the chaser must be able to stop from its speed limit, m.
        progress: called while the grid is built.
        **gains: entries of `Tuning` to override.

    Raises:
        ControlError: goal or start is not free or not connected, or a required condition is violated; the message
        names it with
            its numbers.

    """
    goal = _point("goal", goal)
    start = None if start is None else _point("start", start)
    if reach is None:
        reach = float(max(np.linalg.norm(goal), 0.0 if start is None else np.linalg.norm(start)))
    tuning = tune(
        mass=mass,
        force_limit=force_limit,
        period=period,
        disturbance_bound=disturbance_bound,
        speed_limit=speed_limit,
        drift_bound=drift_bound(motion, radius=reach, speed=speed_limit),
        stopping_distance=stopping_distance,
    )
    unknown = set(gains) - {f.name for f in dataclasses.fields(Tuning)}
    if unknown:
        names = ", ".join(f.name for f in dataclasses.fields(Tuning))
        raise ControlError(f"gains: {', '.join(sorted(unknown))} not known; the law has {names}")
    tuning = dataclasses.replace(tuning, **gains)
    offset = error_bound + chaser_radius + margin + tuning.nominal_offset
    leader = _guidance(
        guidance,
        field,
        offset,
        goal,
        speed=speed_limit,
        slowing_length=tuning.slowing_length,
        start=start,
        bounds=bounds,
        grid=grid,
        spacing=spacing,
        progress=progress,
    )
    law = SafeVelocity(
        field=field,
        offset=_scalar(offset),
        guidance=leader,
        class_k=ClassK(_scalar(tuning.class_k_rate), _scalar(tuning.braking)),
        circulation=_circulation(circulation, level=0.1, slope=1.0, weight=1.0, axis=circulation_axis),
        speed=SpeedCone(_scalar(speed_limit), _scalar(tuning.authority), _scalar(tuning.speed_reserve)),
        differentiate=feedforward,
    )
    tracking = Tracking(
        gain=_scalar(tuning.tracking_gain),
        position_weight=jnp.eye(3),
        lyapunov_ratio=_scalar(tuning.lyapunov_ratio),
        barrier_ratio=_scalar(tuning.barrier_ratio),
        estimation_weight=_scalar(tuning.estimation_weight),
        estimation_rate=_scalar(tuning.estimation_rate),
        barrier_rate=_scalar(tuning.barrier_rate),
        sharpness=_scalar(tuning.sharpness),
        gradient_error=_scalar(0.0),
        acceleration_limit=_scalar(tuning.authority),
    )
    controller = Controller(
        velocity=law,
        tracking=tracking,
        observer=_observer(observer, mass=mass, period=period, gain=tuning.observer_gain, frequencies=frequencies),
        motion=motion,
        mass=_scalar(mass),
        force_limit=jnp.full(3, float(force_limit)),
        nominal_offset=_scalar(tuning.nominal_offset),
    )
    found = conditions(controller, period=period, disturbance_bound=disturbance_bound, start=start)
    broken = [c for c in found if c.required and not c.satisfied]
    if broken:
        raise ControlError("default law: " + "; ".join(str(c) for c in broken))
    return dataclasses.replace(controller, conditions=found)


def paper(
    field: Field,
    *,
    error_bound: float,
    chaser_radius: float,
    margin: float,
    goal: Any,
    motion: RelativeMotion,
    mass: float,
    force_limit: float,
    speed_limit: float,
    period: float,
    disturbance_bound: float,
    guidance: Literal["geodesic", "straight"] | str = "straight",
    circulation: Literal["none", "printed", "skew", "switching"] | str = "printed",
    observer: Literal["printed", "harmonic", "constant", "off"] | str = "printed",
    bounds: tuple[Any, Any] | None = None,
    start: Any | None = None,
    grid: BarrierGrid | None = None,
    spacing: float | None = None,
    frequencies: Sequence[float] = PAPER_FREQUENCIES,
    gradient_error: float = 0.0,
    slowing_length: float = 1.5,
    sharpness: float = 1.0,
    position_weight: float = 1.0,
    circulation_axis: Sequence[float] = (1.0, 1.0, 1.0),
    progress: Progress = silent,
) -> Controller:
    """Build the law with the constants printed in section VI of the paper.

    The arguments are those of `default`. What the paper leaves open has a name here: `gradient_error` e_∇h,
    `slowing_length` k_p (m), `sharpness` ε, `position_weight` (H₀ = this times the identity). The law flies although
    its constants violate conditions of its own theory, and says which in a `ControlWarning`.

    Raises:
        ControlError: goal or start is not free, or an argument is out of range.

    """
    goal = _point("goal", goal)
    start = None if start is None else _point("start", start)
    offset = error_bound + chaser_radius + margin
    if guidance == "straight":
        require_free(field, offset, goal, "goal")
        if start is not None:
            require_free(field, offset, start, "start")
        leader: Guidance = ComponentwiseGuidance(jnp.asarray(goal), _scalar(speed_limit), _scalar(slowing_length))
    else:
        leader = _guidance(
            guidance,
            field,
            offset,
            goal,
            speed=speed_limit,
            slowing_length=slowing_length,
            start=start,
            bounds=bounds,
            grid=grid,
            spacing=spacing,
            progress=progress,
        )
    law = SafeVelocity(
        field=field,
        offset=_scalar(offset),
        guidance=leader,
        class_k=ClassK(_scalar(0.08)),
        circulation=_circulation(circulation, level=0.1, slope=1.0, weight=1.0, axis=circulation_axis),
        # Without e_∇h the barrier row is a half-space, and the program a quadratic one.
        gradient_error=None if gradient_error == 0.0 else _scalar(gradient_error),
        box=_scalar(speed_limit),
    )
    tracking = Tracking(
        gain=_scalar(15.0),
        position_weight=position_weight * jnp.eye(3),
        lyapunov_ratio=_scalar(1e-4),
        barrier_ratio=_scalar(2.0),
        estimation_weight=_scalar(1.0),
        estimation_rate=_scalar(0.1),
        barrier_rate=_scalar(10.0),
        sharpness=_scalar(sharpness),
        gradient_error=_scalar(gradient_error),
    )
    if observer == "printed":
        one = np.eye(3)
        watcher: Observer = continuous(one, one, 50.0 * one, mass=mass, period=period)
    else:
        watcher = _observer(observer, mass=mass, period=period, gain=0.9, frequencies=frequencies)
    controller = Controller(
        velocity=law,
        tracking=tracking,
        observer=watcher,
        motion=motion,
        mass=_scalar(mass),
        force_limit=jnp.full(3, float(force_limit)),
        nominal_offset=_scalar(0.0),
    )
    found = conditions(controller, period=period, disturbance_bound=disturbance_bound, start=start)
    broken = [c for c in found if not c.satisfied]
    if broken:
        warnings.warn("paper law: " + "; ".join(str(c) for c in broken), ControlWarning, stacklevel=2)
    return dataclasses.replace(controller, conditions=found)

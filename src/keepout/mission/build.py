"""A scenario made flyable: load its target and field, build its law and its guard."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from keepout.control import profiles
from keepout.control.controller import Controller
from keepout.control.delay import AheadOfDelay
from keepout.errors import ControlError, FieldError, KeepOutZoneError, ScenarioError
from keepout.fields.evaluate import values
from keepout.fields.model import Certificate, FieldModel
from keepout.fields.shipped import load_shipped, shipped_names
from keepout.flight.faults import BrokenLaw
from keepout.flight.setup import FlightSetup
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.guard.field import guard_field
from keepout.guard.guard import Guard
from keepout.mission import environment
from keepout.mission.scenario import Scenario, TargetEntry
from keepout.motion import MotionState, RelativeMotion
from keepout.progress import Progress, silent

_MISSED_ROOM = 0.2
"""By so much (m) the field may say less than the mesh before a refusal mentions it: more than margins explain."""


@dataclass(frozen=True)
class Mission:
    """Everything a scenario needs to be flown: target, field with its certificate, setup and initial state.

    `start_certified`: whether the guard's theorem holds from the start; None without a guard.
    """

    scenario: Scenario
    target: Target
    model: FieldModel
    certificate: Certificate
    setup: FlightSetup
    initial: MotionState
    start_certified: bool | None

    @property
    def steps(self) -> int:
        """Control steps in the scenario's duration."""
        return round(self.scenario.duration / self.scenario.control.period)


def load_target(entry: TargetEntry) -> Target:
    """Load a scenario's target."""
    return Target.load(
        entry.source,
        units=entry.units,
        scale=entry.scale,
        drop_stray=entry.drop_stray,
        thickness=entry.thickness,
        rotation=None if entry.rotation is None else np.asarray(entry.rotation),
        origin=None if entry.origin is None else np.asarray(entry.origin),
        parameters=dict(entry.parameters) or None,
    )


def load_model(scenario: Scenario, target: Target) -> FieldModel:
    """Load a scenario's field, refusing one that was made for another mesh.

    Raises:
        FieldError: there is no such field, or it belongs to another target.

    """
    source = scenario.field.source
    if source != "shipped":
        return FieldModel.load(Path(source), target=target)
    if scenario.target.source not in shipped_names():
        raise FieldError(
            f'field.source: "shipped" is only for {", ".join(shipped_names())}, not for {scenario.target.source!r}; '
            "make one with `keepout fit` and `keepout certify` and name its file"
        )
    model = load_shipped(scenario.target.source)
    _require_same_target(model, target)
    return model


def prepare(
    scenario: Scenario,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
) -> Mission:
    """Build everything that flying a scenario needs.

    Args:
        scenario: what to fly.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        progress: called while guidance is built.

    Raises:
        KeepoutError: something in the scenario cannot be flown; the message names the entry.

    """
    target = load_target(scenario.target) if target is None else target
    model = load_model(scenario, target) if model is None else model
    _require_same_target(model, target)
    certificate = model.certificate(scenario.chaser.radius)
    _refuse_contact(scenario, target)
    motion = environment.relative_motion(scenario)
    try:
        controller = _controller(
            scenario, model, certificate, motion, lambda fraction, message: progress(0.6 * fraction, message)
        )
    except KeepOutZoneError as refusal:
        why = _missed_room(refusal.place, scenario, target, model, progress)
        raise KeepOutZoneError(f"{refusal}{why}", refusal.place) from None
    initial = motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
    guard, start_certified = None, None
    if scenario.guard.enabled:
        guard = _guard(scenario, target, model, lambda fraction, message: progress(0.6 + 0.4 * fraction, message))
        start_certified = guard.require(initial, jnp.asarray(scenario.goal.position))
    setup = FlightSetup(
        motion=motion,
        disturbance=environment.disturbance(scenario),
        thrusters=environment.thrusters(scenario),
        controller=_flown_law(scenario, controller, model, motion),
        goal=scenario.goal.position,
        mass=scenario.chaser.mass,
        period=scenario.control.period,
        guard=guard,
        faults=environment.faults(scenario),
        field=model.field,
        tolerance=scenario.goal.tolerance,
    )
    return Mission(scenario, target, model, certificate, setup, initial, start_certified)


def _require_same_target(model: FieldModel, target: Target) -> None:
    if model.target_sha256 != target.sha256:
        raise FieldError(
            f"field: made for {model.target_name} ({model.target_sha256[:12]}), not for {target.name} "
            f"({target.sha256[:12]}); other parameters, units or parts make another target, so fit and certify again"
        )


def _refuse_contact(scenario: Scenario, target: Target) -> None:
    """Refuse a start or goal where the chaser would touch the target."""
    radius = scenario.chaser.radius
    for name, position in (("start", scenario.start.position), ("goal", scenario.goal.position)):
        distance = float(target.distance.distance(np.asarray(position)[None])[0])
        if distance <= radius:
            raise ScenarioError(
                f"{name}.position: {list(position)} m is {distance:.3f} m from the target, where a chaser of radius "
                f"{radius} m touches it; it must be further than that radius"
            )


def _missed_room(name: str, scenario: Scenario, target: Target, model: FieldModel, progress: Progress) -> str:
    """Say of a start or goal in the keep-out zone why, where the mesh is much farther away than the field says."""
    position = np.asarray(getattr(scenario, name).position)[None]
    distance, said = float(target.distance.distance(position)[0]), float(values(model.field, position)[0])
    if distance - said < _MISSED_ROOM:
        return ""
    closing = _closing_radius(model)
    solid = OffsetSolid.build(target.distance, offset=model.offset, closing_radius=closing, progress=progress)
    if not solid.is_exterior(position)[0]:
        return f"; no gap of more than {2.0 * closing:g} m leads there from outside"
    return (
        f"; the mesh is {distance:.3g} m away there and the field says {said:.3g} m: "
        f"move the {name}, or fit the field again with another seed"
    )


def _controller(
    scenario: Scenario, model: FieldModel, certificate: Certificate, motion: RelativeMotion, progress: Progress
) -> Controller:
    """Build the scenario's law; entries left unset keep the profile's own.

    A start inside the law's keep-out zone is refused, unless a guard flies along: it leads the way out first.
    """
    control, chaser = scenario.control, scenario.chaser
    chosen = {
        name: value
        for name in ("guidance", "spacing", "circulation", "observer")
        if (value := getattr(control, name)) is not None
    }
    build = partial(
        {"default": profiles.default, "paper": profiles.paper}[control.profile],
        model.field,
        error_bound=certificate.error_bound,
        chaser_radius=chaser.radius,
        margin=scenario.safety.margin,
        goal=np.asarray(scenario.goal.position),
        motion=motion,
        mass=chaser.mass,
        force_limit=chaser.force_limit,
        speed_limit=chaser.speed_limit,
        period=control.period,
        disturbance_bound=environment.disturbance_bound(scenario),
        progress=progress,
        **chosen,
    )
    start = np.asarray(scenario.start.position)
    try:
        return build(start=start)
    except ControlError:
        if not scenario.guard.enabled:
            raise
        law = build()
        # Refused for another reason than being too near, or inside the target: then there is no way to lead out.
        if not 0.0 < float(values(model.field, start[None])[0]) <= float(law.velocity.offset):
            raise
        return law


def _flown_law(scenario: Scenario, law: Any, model: FieldModel, motion: RelativeMotion) -> Any:
    """Tell the law of the delay that the scenario declares, and break it as the scenario's faults say."""
    chaser, period = scenario.chaser, scenario.control.period
    if scenario.guard.delay:
        law = AheadOfDelay(law, motion, chaser.mass, period, scenario.guard.delay)
    if scenario.faults.law == "none":
        return law
    return BrokenLaw(
        law,
        model.field,
        scenario.faults.law,
        chaser.force_limit,
        chaser.mass,
        chaser.speed_limit,
        seed=scenario.seed,
    )


def _closing_radius(model: FieldModel) -> float:
    """Return the radius (m) of the gaps that the solid behind the field has sealed."""
    return float(model.training.get("closing_radius", 0.25))


def _guard(scenario: Scenario, target: Target, model: FieldModel, progress: Progress) -> Guard:
    """Build the guard, with the scenario's numbers as its assumptions and a field of its own (`guard_field`).

    That field is a spline of exact distances whose error and gradient bounds are proved, not the learned one: an error
    in one is not an error in the other.
    """
    radius = scenario.chaser.radius
    closing = _closing_radius(model)
    grid = guard_field(target, radius, offset=model.offset, closing_radius=closing, progress=progress)
    certificate = grid.certificate(radius)
    return Guard(
        field=grid.field,
        threshold=certificate.error_bound + radius,
        lipschitz=certificate.gradient_bound,
        evaluation_error=certificate.evaluation_error,
        assumptions=environment.guard_assumptions(scenario, target),
    )

"""A scenario made flyable: load its target and field, build its law and its guard."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from keepout.compiled.kept_programs import keep_programs
from keepout.control import profiles
from keepout.control.circulation import (
    CirculationLaw,
    NoCirculation,
    SwitchingCirculation,
    printed_circulation,
    skew_circulation,
)
from keepout.control.controller import Controller
from keepout.control.delay import AheadOfDelay
from keepout.control.guidance.guidance import Guidance
from keepout.control.guidance.plan import Componentwise, Geodesic, GuidancePlan, Straight
from keepout.control.law import Law
from keepout.control.observer import NoObserver, Observer, constant_observer, harmonic_observer, printed_observer
from keepout.control.operation import Operation
from keepout.errors import ControlError, FieldError, KeepOutZoneError
from keepout.fields.evaluate import values
from keepout.fields.field import Field
from keepout.fields.model import Certificate, FieldModel
from keepout.fields.shipped import load_shipped, shipped_names
from keepout.flight.faults import BrokenLaw
from keepout.flight.setup import FlightSetup
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.guard.field import guard_field
from keepout.guard.guard import Guard
from keepout.guard.safety_layer import SafetyLayer
from keepout.mission import environment
from keepout.mission.assumptions import broken_assumptions
from keepout.mission.scenario import Scenario
from keepout.mission.target import load_target, require_apart
from keepout.mission.thrusters import thrusters
from keepout.motion import MotionState
from keepout.motion.arrays import as_float64
from keepout.progress import Progress, part_of, silent

_MISSED_ROOM = 0.2
"""By so much (m) the field may say less than the mesh before a refusal mentions it: more than margins explain."""


@dataclass(frozen=True)
class Mission:
    """Everything a scenario needs to be flown: target, field with its certificate, setup and initial state.

    Attributes:
        scenario: what to fly.
        target: its mesh.
        model: the field that the law flies by.
        certificate: of that field for the chaser's radius.
        setup: what the flight loop flies.
        initial: the true state at the start.
        start_certified: whether the guard's theorem holds from the start, whichever estimate of it within the errors
            the guard is told, and no assumption is broken; None without a guard.
        assumptions_broken: what the scenario flies beyond what it declares, each with its numbers.
        own_push: largest norm of a disturbance that is not the scenario's, N; None where it is.

    """

    scenario: Scenario
    target: Target
    model: FieldModel
    certificate: Certificate
    setup: FlightSetup
    initial: MotionState
    start_certified: bool | None
    assumptions_broken: tuple[str, ...] = ()
    own_push: float | None = None

    @property
    def guard(self) -> Guard | None:
        """The guard that flies along."""
        guard = self.setup.guard
        return guard if isinstance(guard, Guard) else None

    @property
    def steps(self) -> int:
        """Control steps in the scenario's duration."""
        return self.scenario.steps

    def with_law(self, law: Law) -> "Mission":
        """Give the same mission flown by another law, told of the scenario's delay and broken by its faults.

        The guard's theorem holds for any law, so what is certified of the start stays.
        """
        flown = flown_law(self.scenario, law, self.model)
        return replace(self, setup=replace(self.setup, controller=flown))

    def with_guard(self, guard: SafetyLayer | None) -> "Mission":
        """Give the same mission with another safety layer, or none; nothing is certified of it."""
        return replace(self, setup=replace(self.setup, guard=guard), start_certified=None)


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
    model.require_target(target, where="field")
    return model


def prepare(
    scenario: Scenario,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    guidance: Guidance | GuidancePlan | None = None,
    guard_grid: FieldModel | None = None,
    progress: Progress = silent,
) -> Mission:
    """Build everything that flying a scenario needs.

    Args:
        scenario: what to fly.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        guidance: instead of the one that the scenario names.
        guard_grid: the guard's own field, already built; else from the cache or newly built.
        progress: called while guidance is built.

    Raises:
        KeepoutError: something in the scenario cannot be flown; the message names the entry.

    """
    keep_programs()
    target = load_target(scenario.target) if target is None else target
    model = load_model(scenario, target) if model is None else model
    model.require_target(target, where="field")
    certificate = model.certificate(scenario.chaser.radius)
    require_apart(scenario, target)
    try:
        law = _law_or_way_out(scenario, model, guidance, part_of(progress, 0.0, 0.6))
    except KeepOutZoneError as refusal:
        why = _missed_room(refusal.place, scenario, target, model, progress)
        raise KeepOutZoneError(f"{refusal}{why}", refusal.place) from None
    setup = flight_setup(scenario, flown_law(scenario, law, model), field=model.field)
    initial = setup.motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
    guard, start_certified, broken = None, None, broken_assumptions(scenario)
    if scenario.guard.enabled:
        guard = build_guard(
            scenario,
            target,
            offset=model.offset,
            closing_radius=closing_radius(model),
            grid=guard_grid,
            progress=part_of(progress, 0.6, 1.0),
        )
        start_certified = guard.require(initial, as_float64(scenario.goal.position)) and not broken
    return Mission(scenario, target, model, certificate, replace(setup, guard=guard), initial, start_certified, broken)


def flight_setup(scenario: Scenario, law: Law, **chosen: Any) -> FlightSetup:
    """Put a law where a scenario flies: its motion, disturbance, faults and numbers, without guard or logged field.

    Args:
        scenario: its entries `attitude`, `chaser`, `control.period`, `disturbance`, `faults`, `goal`, `orbit` and
            `thrusters`.
        law: as it is flown, its faults and what it is told of a delay included (`flown_law`).
        **chosen: entries of `FlightSetup`, instead of the scenario's or beside them.

    """
    entries = {
        "motion": environment.relative_motion(scenario),
        "disturbance": environment.disturbance(scenario),
        "thrusters": thrusters(scenario),
        "goal": scenario.goal.position,
        "mass": scenario.chaser.mass,
        "period": scenario.control.period,
        "faults": environment.faults(scenario),
        "tolerance": scenario.goal.tolerance,
    }
    return FlightSetup(controller=law, **(entries | chosen))


def _missed_room(name: str, scenario: Scenario, target: Target, model: FieldModel, progress: Progress) -> str:
    """Say of a start or goal in the keep-out zone why, where the mesh is much farther away than the field says."""
    position = np.asarray(getattr(scenario, name).position)[None]
    distance, said = float(target.distance.distance(position)[0]), float(values(model.field, position)[0])
    if distance - said < _MISSED_ROOM:
        return ""
    closing = closing_radius(model)
    solid = OffsetSolid.build(target.distance, offset=model.offset, closing_radius=closing, progress=progress)
    if not solid.is_exterior(position)[0]:
        return f"; no gap of more than {2.0 * closing:g} m leads there from outside"
    return (
        f"; the mesh is {distance:.3g} m away there and the field says {said:.3g} m: "
        f"move the {name}, or fit the field again with another seed"
    )


def operation(scenario: Scenario, model: FieldModel) -> Operation:
    """Gather the numbers that a scenario's law is designed for, with the field's certificate.

    Raises:
        FieldError: the model has no certificate for the chaser's radius.
        ScenarioError: the thrusters cannot hold against the disturbance.

    """
    return _operation(scenario, model.certificate(scenario.chaser.radius).error_bound)


def _operation(scenario: Scenario, error_bound: float) -> Operation:
    return Operation(
        chaser=environment.chaser(scenario),
        motion=environment.relative_motion(scenario),
        error_bound=error_bound,
        disturbance_bound=environment.disturbance_bound(scenario),
        margin=scenario.safety.margin,
        period=scenario.control.period,
    )


def build_law(
    scenario: Scenario,
    model: FieldModel,
    *,
    guidance: Guidance | GuidancePlan | None = None,
    from_start: bool = True,
    progress: Progress = silent,
    **chosen: Any,
) -> Controller:
    """Build a scenario's control law, as its designers meant it: without its faults, and without a delay.

    Args:
        scenario: its entries `control`, `chaser`, `safety`, `goal`, `start`, `orbit`, `attitude` and `disturbance`.
        model: the field, certified for the chaser's radius.
        guidance: instead of the one that the scenario names.
        from_start: whether the scenario's start must be free and connected to its goal.
        progress: called while the guidance is made.
        **chosen: further arguments of the profile (`control/profiles.py`), such as `reach`.

    Raises:
        KeepoutError: the law cannot be built; the message names the entry.

    """
    bound = model.certificate(scenario.chaser.radius).error_bound
    return law_on(scenario, model.field, bound, guidance=guidance, from_start=from_start, progress=progress, **chosen)


def law_on(
    scenario: Scenario,
    field: Field,
    error_bound: float,
    *,
    guidance: Guidance | GuidancePlan | None = None,
    from_start: bool = True,
    progress: Progress = silent,
    **chosen: Any,
) -> Controller:
    """Build a scenario's control law on any field; the arguments are those of `build_law`.

    Args:
        scenario: as of `build_law`.
        field: what the law knows of the shape.
        error_bound: e_h, how far the field over-states the distance where the chaser touches, m.
        guidance: as of `build_law`.
        from_start: likewise.
        progress: likewise.
        **chosen: likewise.

    Raises:
        KeepoutError: the law cannot be built; the message names the entry.

    """
    designed = _operation(scenario, error_bound)
    profile = {"default": profiles.default, "paper": profiles.paper}[scenario.control.profile]
    if scenario.control.profile == "paper":
        chosen = scenario.control.paper.model_dump() | chosen
    return profile(
        field,
        designed,
        np.asarray(scenario.goal.position),
        guidance=named_guidance(scenario) if guidance is None else guidance,
        circulation=_named_circulation(scenario),
        observer=_named_observer(scenario),
        start=np.asarray(scenario.start.position) if from_start else None,
        progress=progress,
        **chosen,
    )


def named_guidance(scenario: Scenario) -> GuidancePlan | None:
    """Give the guidance that a scenario names; None where the profile's own is to be had."""
    control = scenario.control
    if control.guidance == "geodesic" or control.spacing is not None:
        return Geodesic(spacing=control.spacing)
    if control.guidance == "straight":
        return Straight() if control.profile == "default" else Componentwise()
    return None


def _named_circulation(scenario: Scenario) -> CirculationLaw | NoCirculation | None:
    match scenario.control.circulation:
        case "none":
            return NoCirculation()
        case "printed":
            return printed_circulation()
        case "skew":
            return skew_circulation()
        case "switching":
            return SwitchingCirculation()
        case None:
            return None


def _named_observer(scenario: Scenario) -> Observer | None:
    mass, period = scenario.chaser.mass, scenario.control.period
    match scenario.control.observer:
        case "harmonic":
            return harmonic_observer(mass=mass, period=period)
        case "constant":
            return constant_observer(mass=mass, period=period)
        case "printed":
            return printed_observer(mass=mass, period=period)
        case "off":
            return NoObserver()
        case None:
            return None


def _law_or_way_out(
    scenario: Scenario, model: FieldModel, guidance: Guidance | GuidancePlan | None, progress: Progress
) -> Controller:
    """Build the scenario's law; a start in its keep-out zone is refused, unless a guard leads the way out first."""
    try:
        return build_law(scenario, model, guidance=guidance, progress=progress)
    except ControlError:
        if not scenario.guard.enabled:
            raise
        law = build_law(scenario, model, guidance=guidance, from_start=False, progress=progress)
        # Refused for another reason than being too near, or inside the target: then there is no way to lead out.
        said = float(values(model.field, np.asarray(scenario.start.position)[None])[0])
        if not 0.0 < said <= float(law.velocity.offset):
            raise
        return law


def flown_law(scenario: Scenario, law: Law, model: FieldModel) -> Law:
    """Tell a law of the delay that the scenario declares, and break it as the scenario's faults say."""
    return broken_as(scenario, law, model.field)


def broken_as(scenario: Scenario, law: Law, field: Field) -> Law:
    """Do the same with any field, which says where the body is."""
    chaser = scenario.chaser
    if scenario.guard.delay:
        motion = environment.relative_motion(scenario)
        law = AheadOfDelay(law, motion, chaser.mass, scenario.control.period, scenario.guard.delay)
    if scenario.faults.law == "none":
        return law
    return BrokenLaw(
        law,
        field,
        scenario.faults.law,
        chaser.force_limit,
        chaser.mass,
        chaser.speed_limit,
        seed=scenario.seed,
    )


def closing_radius(model: FieldModel) -> float:
    """Return the radius (m) of the gaps that the solid behind the field has sealed."""
    return float(model.training.get("closing_radius", 0.25))


def build_guard(
    scenario: Scenario,
    target: Target,
    *,
    offset: float = 0.03,
    closing_radius: float = 0.25,
    grid: FieldModel | None = None,
    progress: Progress = silent,
) -> Guard:
    """Build the guard, with the scenario's numbers as its assumptions and a field of its own (`guard/field.py`).

    That field is a spline of exact distances whose error and gradient bounds are proved, not the learned one: an error
    in one is not an error in the other.

    Args:
        scenario: its entries `guard`, `chaser`, `disturbance`, `orbit`, `attitude`, `start` and `goal`.
        target: the mesh.
        offset: of the solid behind the field, m.
        closing_radius: of the gaps that this solid seals, m.
        grid: that field, where it is there already.
        progress: called while the field is built.

    Raises:
        KeepoutError: the thrusters cannot meet the assumptions; the message names the entry.

    """
    radius = scenario.chaser.radius
    if grid is None:
        grid = guard_field(target, radius, offset=offset, closing_radius=closing_radius, progress=progress)
    certificate = grid.certificate(radius)
    return Guard(
        field=grid.field,
        threshold=certificate.error_bound + radius,
        lipschitz=certificate.gradient_bound,
        evaluation_error=certificate.evaluation_error,
        assumptions=environment.guard_assumptions(scenario, target),
    )

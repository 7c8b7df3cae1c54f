"""A scenario made flyable: load its target and field, put its law and its guard where they fly."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.control.guidance.guidance import Guidance
from keepout.core.control.guidance.plan import GuidancePlan
from keepout.core.control.law import Law
from keepout.core.errors import FieldError, KeepOutZoneError, ScenarioError
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.field import values
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.guard.guard import Guard
from keepout.core.guard.safety_layer import SafetyLayer
from keepout.core.guard.start import require_flyable
from keepout.core.mission import environment
from keepout.core.mission.assumptions import broken_assumptions
from keepout.core.mission.law import flown_law, law_or_way_out, room_for_guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.target import load_target, require_apart
from keepout.core.mission.thrusters import thrusters
from keepout.core.mission.tried import require_guard, require_law
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.relative import MotionState
from keepout.core.plug_ins import load
from keepout.core.progress import Progress, part_of, silent

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

        Raises:
            ControlError: it is no law, or tried at the start it does not answer as one.

        """
        require_law(law, self.initial)
        flown = flown_law(self.scenario, law, self.model)
        return replace(self, setup=replace(self.setup, controller=flown))

    def with_guard(self, guard: SafetyLayer | None) -> "Mission":
        """Give the same mission with another safety layer, or none; nothing is certified of it.

        Raises:
            ControlError: it is no safety layer, or tried at the start it does not answer as one.

        """
        require_guard(guard, self.initial)
        return replace(self, setup=replace(self.setup, guard=guard), start_certified=None)


def load_model(scenario: Scenario, target: Target, progress: Progress = silent) -> FieldModel:
    """Load a scenario's field, refusing one that was made for another mesh; "grid" is from the cache or newly built.

    Raises:
        FieldError: there is no such field, or it belongs to another target.

    """
    source = scenario.field.source
    if source == "grid":
        return guard_field(target, scenario.chaser.radius, progress=progress)
    if source != "shipped":
        return FieldModel.load(Path(source), target=target)
    if scenario.target.source not in shipped_names():
        raise FieldError(
            f'field.source: "shipped" is only for {", ".join(shipped_names())}, not for {scenario.target.source!r}; '
            'make one with `keepout fit` and `keepout certify` and name its file, or give "grid"'
        )
    model = load_shipped(scenario.target.source)
    model.require_target(target, where="field")
    return model


def prepare(
    scenario: Scenario | str | Path,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    guidance: Guidance | GuidancePlan | None = None,
    guard_grid: FieldModel | None = None,
    progress: Progress = silent,
) -> Mission:
    """Build everything that flying a scenario needs.

    Args:
        scenario: what to fly, or the path of its TOML file.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        guidance: instead of the one that the scenario names.
        guard_grid: the guard's own field, already built; else from the cache or newly built.
        progress: called while guidance is built.

    Raises:
        KeepoutError: something in the scenario cannot be flown; the message names the entry.

    """
    keep_programs()
    scenario = Scenario.of(scenario)
    target = load_target(scenario.target) if target is None else target
    model = load_model(scenario, target) if model is None else model
    model.require_target(target, where="field")
    certificate = model.certificate(scenario.chaser.radius)
    require_apart(scenario, target)
    require_navigation(scenario)
    try:
        room = room_for_guard(scenario, target)
        law = law_or_way_out(scenario, model, guidance, part_of(progress, 0.0, 0.6), **room)
    except KeepOutZoneError as refusal:
        why = _missed_room(refusal.place, scenario, target, model, progress)
        raise KeepOutZoneError(f"{refusal}{why}", refusal.place) from None
    setup = flight_setup(scenario, flown_law(scenario, law, model), field=model.field)
    if scenario.navigation.suite != "none":
        assumed = environment.guard_assumptions(scenario, target)
        setup = replace(setup, navigation=load("navigation", "flown")(scenario, setup.motion, assumed))
    initial = setup.motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
    guard, start_certified, broken = None, None, broken_assumptions(scenario, target)
    if scenario.guard.enabled:
        guard = build_guard(
            scenario,
            target,
            offset=model.offset,
            closing_radius=closing_radius(model),
            grid=guard_grid,
            progress=part_of(progress, 0.6, 1.0),
        )
        start_certified = require_flyable(guard, initial, as_float64(scenario.goal.position)) and not broken
    return Mission(scenario, target, model, certificate, replace(setup, guard=guard), initial, start_certified, broken)


def require_navigation(scenario: Scenario) -> None:
    """Refuse entries of navigation that the suite has no use for.

    Raises:
        ScenarioError: there are some; the message names them.

    """
    entry = scenario.navigation
    if entry.suite == "none":
        given = [f"navigation.{key}" for key in entry.model_dump(exclude_defaults=True)]
        if given:
            raise ScenarioError(
                f'{", ".join(given)}: only for a suite, and navigation.suite is "none"; give "far", "near" or "close"'
            )
        return
    noises = [f"navigation.{key}" for key in ("position_noise", "velocity_noise") if getattr(entry, key) is not None]
    if noises and entry.suite != "close":
        raise ScenarioError(
            f'{", ".join(noises)}: only for navigation.suite = "close", and it is "{entry.suite}"; leave them out'
        )


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
    """Build the guard, with the scenario's numbers as its assumptions and a field of its own (`core/guard/field.py`).

    That field is a spline of exact distances whose error and gradient bounds are proved, not the learned one: an error
    in one is not an error in the other. Where the guard keeps a margin, it is above its threshold nowhere that is
    nearer: from there to contact the field falls by no more than the gradient bound allows (docs/guard.md, section 7).

    Args:
        scenario: its entries `guard`, `safety`, `chaser`, `disturbance`, `orbit`, `attitude`, `start` and `goal`.
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
    certificate, margin = grid.certificate(radius), environment.kept_margin(scenario)
    threshold = certificate.error_bound + radius
    if margin:
        threshold += certificate.gradient_bound * margin + 2.0 * certificate.evaluation_error
    return Guard(
        field=grid.field,
        threshold=threshold,
        lipschitz=certificate.gradient_bound,
        evaluation_error=certificate.evaluation_error,
        assumptions=environment.guard_assumptions(scenario, target),
    )

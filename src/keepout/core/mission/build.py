"""A scenario made flyable: load its target and field, put its law and its guard where they fly; or parts of your own.

Each part of a user's own is tried at the mission's start before anything is flown; a refusal says what it must answer.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.audit.tube import FlightBounds
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.compiled.tried import THREE_NUMBERS, Asked, described
from keepout.core.control.controller import Controller
from keepout.core.control.guidance import Guidance, GuidancePlan
from keepout.core.control.law import Command, Law
from keepout.core.errors import ControlError, FieldError, KeepOutZoneError, ScenarioError
from keepout.core.fields import load_shipped
from keepout.core.fields.field import values
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.fields.own import FunctionField
from keepout.core.flight import loop
from keepout.core.flight.setup import FlightSetup
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.guard.guard import Guard
from keepout.core.guard.safety_layer import SafetyLayer
from keepout.core.guard.start import require_flyable
from keepout.core.mission.approach import as_flown, earliest, require_approach, wants_drift_safety
from keepout.core.mission.first_look import require_shipped
from keepout.core.mission.flight import Flight, judged
from keepout.core.mission.law import broken_as, law_on, law_or_way_out, room_for_guard
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.core.mission.target import load_target, require_apart
from keepout.core.mission.zones import named, zoned
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.chaser import Firing, ThrusterModel
from keepout.core.motion.disturbance import Disturbance
from keepout.core.motion.relative import MotionState
from keepout.core.plug_ins import load
from keepout.core.progress import Progress, moving, part_of, silent
from keepout.core.proof.certificate import stated_error_bound

_MISSED_ROOM = 0.2
"""By so much (m) the field may say less than the mesh before a refusal mentions it: more than margins explain."""
_OUTWARD = 1.0 + 1e-9
_TRIED = 2001
"""Moments of a flight at which a disturbance is held against its bound."""
_COMMAND = "its memory and a keepout.Command whose force is three finite numbers, N, an array (3,) of floats"
_FILTERED = "its memory, a force (3,) of floats, N, and a status, one whole number"
_FIRED = "its memory and a Firing whose force is three finite numbers, N, an array (3,) of floats"
_NUMBERS_OF_COMMAND = {
    **dict.fromkeys(("desired_velocity", "safe_velocity", "disturbance_estimate"), (3,)),
    **dict.fromkeys(("barrier", "backstepping_barrier", "lyapunov"), ()),
}


@dataclass(frozen=True)
class Mission:
    """Everything a scenario needs to be flown: target, field with its certificate, setup and initial state.

    Attributes:
        surroundings: of the scenario, with its target and all its numbers.
        model: the field that the law flies by.
        certificate: of that field for the chaser's radius.
        setup: what the flight loop flies.
        initial: the true state at the start.
        start_certified: whether the guard's theorem holds from the start, whichever estimate of it within the errors
            the guard is told, and no assumption is broken; None without a guard.
        assumptions_broken: what the scenario flies beyond what it declares, each with its numbers.
        own_push: largest norm of a disturbance that is not the scenario's, N; None where it is.

    """

    surroundings: Surroundings
    model: FieldModel
    certificate: Certificate
    setup: FlightSetup
    initial: MotionState
    start_certified: bool | None
    assumptions_broken: tuple[str, ...] = ()
    own_push: float | None = None

    @property
    def scenario(self) -> Scenario:
        """What to fly."""
        return self.surroundings.scenario

    @property
    def target(self) -> Target:
        """Its mesh."""
        assert self.surroundings.target is not None
        return self.surroundings.target

    @property
    def bounds(self) -> FlightBounds:
        """Bounds on what a record of the flight does not hold, for the audit."""
        bounds = self.surroundings.flight_bounds
        if self.own_push is None:
            return bounds
        pushed = bounds.disturbance_force - self.surroundings.disturbance.bound + self.own_push
        return replace(bounds, disturbance_force=pushed)

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

        Args:
            law: told the estimated motion once a control period; gives a force, N, body frame.

        Raises:
            ControlError: it is no law, or tried at the start it does not answer as one.

        """
        require_law(law, self.initial)
        return replace(self, setup=replace(self.setup, controller=broken_as(self.scenario, law, self.model.field)))

    def with_guard(self, guard: SafetyLayer | None) -> "Mission":
        """Give the same mission with another safety layer, or none; nothing is certified of it.

        Args:
            guard: passes each commanded force on or replaces it; None flies without one.

        Raises:
            ControlError: it is no safety layer, or tried at the start it does not answer as one.

        """
        require_guard(guard, self.initial)
        return replace(self, setup=replace(self.setup, guard=guard), start_certified=None)

    def with_disturbance(self, disturbance: Disturbance) -> "Mission":
        """Give the same mission with another disturbance; law and guard assume what they assumed, the audit is told.

        Where its bound is above what they assume, that is an assumption broken, and nothing is promised.

        Args:
            disturbance: the force (N, body frame) on the chaser as a function of time, and its bound.

        Raises:
            ScenarioError: it does not answer as a disturbance, or its force is found above the bound that it states.

        """
        require_disturbance(disturbance)
        bound, times = disturbance.bound, np.linspace(0.0, self.scenario.duration, _TRIED)
        found = float(np.linalg.norm(np.asarray(_forces(disturbance, as_float64(times))), axis=1).max())
        if not found <= bound * _OUTWARD:
            said = f"it states a bound of {bound:.6g} N, and its force is found at {found:.6g} N"
            raise ScenarioError(f"disturbance: {said}")
        assumed, broken = self.surroundings.disturbance_bound, self.assumptions_broken
        if bound > assumed * _OUTWARD:
            broken = (*broken, f"disturbance: flown up to {bound:.6g} N > disturbance.bound {assumed:.6g} N")
        return replace(
            self,
            setup=replace(self.setup, disturbance=disturbance),
            own_push=bound,
            start_certified=self.start_certified and not broken,
            assumptions_broken=broken,
        )

    def with_thrusters(self, thrusters: ThrusterModel) -> "Mission":
        """Give the same mission with other thrusters; law and guard assume the scenario's.

        The guard's theorem asks for thrusters that give what is commanded within `guard.gain_error`. Whether these do
        is not known, so nothing is certified of the start.

        Args:
            thrusters: what force (N, body frame) they give for a commanded one.

        Raises:
            ScenarioError: tried on an example, they do not answer as thrusters.

        """
        require_thruster_model(thrusters)
        said = "thrusters: others than the scenario's (what they give of a command is not known)"
        return replace(
            self,
            setup=replace(self.setup, thrusters=thrusters),
            start_certified=None if self.start_certified is None else False,
            assumptions_broken=(*self.assumptions_broken, said),
        )

    def with_field(self, field: FunctionField, *, leaf: float = 0.1, progress: Progress = silent) -> "Mission":
        """Give the same mission with the scenario's law built on another field; the guard keeps its own.

        The law's error bound is `certificate.stated_error_bound`: proved if the field's Lipschitz bound is true.

        Args:
            field: of `keepout.stated_field` or `keepout.sampled_field`.
            leaf: side of the cubes that the bound is proved with, m.
            progress: called while the guidance is made.

        Raises:
            KeepoutError: the law cannot be built on it; the message names the entry.

        """
        if not isinstance(field, FunctionField):
            said = "it must be one of keepout.stated_field or keepout.sampled_field"
            raise FieldError(f"field: {described(field)}; {said}")
        bound = stated_error_bound(field, self.target, self.scenario.chaser.radius, leaf=leaf)
        law = law_on(self.scenario, field, bound, progress=progress)
        setup = replace(self.setup, controller=broken_as(self.scenario, law, field), field=field)
        return replace(self, setup=setup)

    def fly(self, *, progress: Progress = silent) -> Flight:
        """Fly it, with the law and guard that its setup has now, and audit its clearance on the exact mesh.

        Args:
            progress: called as the work goes on.

        Returns:
            What was recorded, and what became of it.

        """
        with moving(progress, 0.0, 0.7, "flying; what is new is compiled first", usual=15.0):
            log = loop.fly(self.setup, self.initial, self.steps, jax.random.key(self.scenario.seed))
            jax.block_until_ready(log)
        progress(0.7, "audit")
        flight = judged(self, log)
        progress(1.0, "")
        return flight


def fly(
    scenario: ScenarioLike | Mission,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
) -> Flight:
    """Fly one scenario and audit its clearance on the exact mesh.

    Args:
        scenario: what to fly: a `Scenario`, the path of its TOML file, its tables as a dict, or a prepared `Mission`.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        progress: called as the work goes on.

    Returns:
        What was recorded, what became of it, and the audit's verdict.

    Raises:
        KeepoutError: something in the scenario cannot be flown; the message names the entry.

    """
    progress(0.0, "preparing")
    if not isinstance(scenario, Mission):
        scenario = prepare(scenario, target=target, model=model, progress=part_of(progress, 0.0, 0.4))
    return scenario.fly(progress=part_of(progress, 0.4, 1.0))


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
    require_shipped(scenario)
    model = load_shipped(scenario.target.source)
    model.require_target(target, where="field")
    return model


def prepare(
    scenario: ScenarioLike,
    *,
    target: Target | None = None,
    model: FieldModel | None = None,
    guidance: Guidance | GuidancePlan | None = None,
    guard_grid: FieldModel | None = None,
    progress: Progress = silent,
) -> Mission:
    """Build everything that flying a scenario needs.

    Args:
        scenario: what to fly: a `Scenario`, the path of its TOML file, or its tables as a dict.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        guidance: instead of the one that the scenario names.
        guard_grid: a grid field for the guard, already built and certified; else from the cache or newly built.
        progress: called while guidance is built.

    Returns:
        The mission, whose parts can be exchanged (`Mission.with_law` and the others) before it is flown.

    Raises:
        KeepoutError: something in the scenario cannot be flown; the message names the entry.

    """
    keep_programs()
    scenario = as_flown(Scenario.of(scenario))
    target = load_target(scenario.target) if target is None else target
    model = load_model(scenario, target) if model is None else model
    model.require_target(target, where="field")
    certificate, around = model.certificate(scenario.chaser.radius), Surroundings(scenario, target)
    require_apart(scenario, target)
    require_approach(around)
    require_navigation(scenario)
    try:
        room = room_for_guard(around)
        law = law_or_way_out(scenario, model, guidance, part_of(progress, 0.0, 0.6), **room)
    except KeepOutZoneError as refusal:
        why = _missed_room(refusal.place, scenario, target, model, progress)
        raise KeepOutZoneError(f"{refusal}{why}", refusal.place) from None
    if wants_drift_safety(scenario):
        given = {"target": target, "model": model, "guidance": guidance, "guard_grid": guard_grid}
        slowed = load("flight", "drift_safe")(around, law, part_of(progress, 0.6, 0.7))
        return prepare(slowed, **given, progress=part_of(progress, 0.7, 1.0))
    setup = around.setup(broken_as(scenario, law, model.field), field=model.field)
    if scenario.navigation.suite != "none":
        flown = load("navigation", "flown")(scenario, setup.motion, around.guard_assumptions)
        setup = replace(setup, navigation=flown)
    arrival = earliest(scenario)[-1] if scenario.leg else 0.0
    initial = setup.motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
    guard, start_certified, broken = None, None, broken_assumptions(scenario, target)
    if scenario.guard.enabled:
        guard = build_guard(
            around,
            offset=model.offset,
            closing_radius=closing_radius(model),
            grid=guard_grid,
            progress=part_of(progress, 0.6, 1.0),
        )
        start_certified = require_flyable(guard, initial, as_float64(scenario.goal.position), arrival) and not broken
        for number, (leg, time) in enumerate(zip(scenario.leg, earliest(scenario), strict=True)):
            try:
                require_flyable(guard, initial, as_float64(leg.position), time)
            except ControlError as refusal:
                raise ControlError(f"{named('leg', leg, number)}: {refusal}") from None
    return Mission(around, model, certificate, replace(setup, guard=guard), initial, start_certified, broken)


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
    around: Surroundings,
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
        around: the surroundings of the scenario, with its target.
        offset: of the solid behind the field, m.
        closing_radius: of the gaps that this solid seals, m.
        grid: that field, where it is there already.
        progress: called while the field is built.

    Raises:
        KeepoutError: the thrusters cannot meet the assumptions; the message names the entry.

    """
    radius, margin = around.scenario.chaser.radius, around.kept_margin
    if grid is None:
        assert around.target is not None
        grid = guard_field(around.target, radius, offset=offset, closing_radius=closing_radius, progress=progress)
    certificate = grid.certificate(radius)
    threshold = certificate.error_bound + radius
    if margin:
        threshold += certificate.gradient_bound * margin + 2.0 * certificate.evaluation_error
    field = zoned(around, grid.field, threshold)
    return Guard(
        field=field,
        threshold=threshold,
        # That of a zone is 1.
        lipschitz=certificate.gradient_bound if field is grid.field else max(certificate.gradient_bound, 1.0),
        evaluation_error=certificate.evaluation_error,
        assumptions=around.guard_assumptions,
    )


@eqx.filter_jit
def _forces(disturbance: Disturbance, times: Float[Array, " n"]) -> Float[Array, "n 3"]:
    return jax.vmap(disturbance.force)(times)


def require_law(law: Any, start: MotionState) -> None:
    """Refuse what is no control law, or answers otherwise than `control.law.Law` says.

    It is traced at the start; one that is not the package's own is also computed there, and its force must be finite.

    Raises:
        ControlError: naming the method, what it gives and what it must give.

    """
    if not isinstance(law, Law):
        raise ControlError(
            f"law: {described(law)}; it must be a keepout.Law; of a callable, keepout.PolicyLaw(goal, callable) is one"
        )
    name = f"law: {type(law).__name__}"
    goal = Asked(f"{name}.goal", f"{THREE_NUMBERS}, m", ControlError)
    goal.require_numbers(goal.tried(lambda: law.goal), (3,))
    memory = replace(goal, part=f"{name}.initial_state", wanted="a memory, a pytree of arrays").tried(
        law.initial_state, start
    )
    step = replace(goal, part=f"{name}.step", wanted=_COMMAND)
    after, command = step.parts(step.tried(law.step, memory, start), 2, Command)
    step.require_same(after, memory)
    step.require_numbers(command.force, (3,))
    for key, shape in _NUMBERS_OF_COMMAND.items():
        replace(step, wanted=f"{key} as an array {shape} of floats").require_numbers(getattr(command, key), shape)
    replace(step, wanted="a status, one whole number").require_numbers(command.status, (), np.integer)
    told = replace(goal, part=f"{name}.with_applied_force", wanted="its memory")
    told.require_same(told.tried(law.with_applied_force, after, command.force), memory)
    if not isinstance(law, Controller):
        force = step.computed(lambda law, start: law.step(law.initial_state(start), start)[1].force, law, start)
        step.require_numbers(force, (3,))


def require_guard(guard: Any, start: MotionState) -> None:
    """Refuse what is no safety layer, or answers otherwise than `guard.safety_layer.SafetyLayer` says.

    Raises:
        ControlError: naming the method, what it gives and what it must give.

    """
    if guard is None:
        return
    if not isinstance(guard, SafetyLayer):
        raise ControlError(f"guard: {described(guard)}; it must be a keepout.SafetyLayer, or None")
    name = f"guard: {type(guard).__name__}"
    memory = Asked(f"{name}.initial_state", "a memory", ControlError).tried(guard.initial_state, start)
    asked = Asked(f"{name}.filter", _FILTERED, ControlError)
    # With sensors it is told the errors of what it is told, and whether that contradicts itself.
    known = jnp.zeros(2), jnp.zeros((), bool)
    answer = asked.tried(guard.filter, memory, start, jnp.zeros(3), jnp.zeros(3), *known)
    after, force, status = asked.parts(answer, 3)
    asked.require_same(after, memory)
    asked.require_numbers(force, (3,))
    asked.require_numbers(status, (), np.integer)


def require_disturbance(disturbance: Any) -> None:
    """Refuse what is no disturbance, or answers otherwise than `motion.disturbance.Disturbance` says.

    Raises:
        ScenarioError: naming the method, what it gives and what it must give.

    """
    if not isinstance(disturbance, Disturbance):
        raise ScenarioError(f"disturbance: {described(disturbance)}; it must be a keepout.Disturbance")
    name, now = f"disturbance: {type(disturbance).__name__}", as_float64(0.0)
    force = Asked(f"{name}.force", f"{THREE_NUMBERS}, N", ScenarioError)
    force.require_numbers(force.tried(disturbance.force, now), (3,))
    force.require_numbers(force.computed(lambda part, time: part.force(time), disturbance, now), (3,))
    for key in ("bound", "longest_stretch"):
        number = getattr(disturbance, key)
        right = not isinstance(number, bool) and isinstance(number, int | float | np.number)
        if not (right and number >= 0.0 and (key != "bound" or math.isfinite(number))):
            shown = described(number) if not right else f"{number}"
            raise ScenarioError(f"{name}.{key}: gives {shown}; it must be a finite number of at least 0")
    switches = replace(force, part=f"{name}.switches", wanted="times, an array (switches,) of floats, s")
    times = switches.tried(disturbance.switches, now, now)
    switches.require_numbers(times, np.shape(times)[:1] if np.shape(times) else (0,))
    asked = replace(force, part=f"{name}.between_switches", wanted="a keepout.Disturbance")
    between = asked.tried(disturbance.between_switches, now)
    if not isinstance(between, Disturbance):
        raise asked.wrong(f"gives {described(between)}")


def require_thruster_model(thrusters: Any) -> None:
    """Refuse what are no thrusters, or answer otherwise than `motion.chaser.ThrusterModel` says.

    Raises:
        ScenarioError: naming the method, what it gives and what it must give.

    """
    if not isinstance(thrusters, ThrusterModel):
        raise ScenarioError(f"thrusters: {described(thrusters)}; they must be a keepout.ThrusterModel")
    name, key, command = f"thrusters: {type(thrusters).__name__}", jax.random.key(0), jnp.zeros(3)
    memory = Asked(f"{name}.initial_state", "a memory", ScenarioError).tried(thrusters.initial_state, key)
    fire = Asked(f"{name}.fire", _FIRED, ScenarioError)
    after, firing = fire.parts(fire.tried(thrusters.fire, memory, command), 2, Firing)
    fire.require_same(after, memory)
    fire.require_numbers(firing.force, (3,))
    force = fire.computed(lambda part, key: part.fire(part.initial_state(key), command)[1].force, thrusters, key)
    fire.require_numbers(force, (3,))
    saturated = replace(fire, part=f"{name}.saturated", wanted="one truth value, an array () of bool")
    saturated.require_numbers(saturated.tried(thrusters.saturated, command), (), np.bool_)

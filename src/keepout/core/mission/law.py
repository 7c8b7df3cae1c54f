"""The control law that a scenario names: what it is designed for, its parts, what it is told, and how it is broken."""

from typing import Any

import numpy as np

from keepout.core.control import profiles
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.guidance import Componentwise, Guidance, GuidancePlan, Straight
from keepout.core.control.law import AheadOfDelay, Law
from keepout.core.control.observer import NoObserver, Observer, constant_observer, harmonic_observer, printed_observer
from keepout.core.control.profiles import Operation, least_offset
from keepout.core.control.velocity import NoCirculation, SwitchingCirculation, printed_circulation, skew_circulation
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field, values
from keepout.core.fields.model import FieldModel
from keepout.core.flight.faults import BrokenLaw
from keepout.core.guard.braking import design
from keepout.core.mission.approach import LegPlan, has_rules, law_of_legs, require_braking, speed_rule
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import zoned
from keepout.core.motion.chaser import Chaser
from keepout.core.progress import Progress, silent

_CIRCULATIONS = {
    "none": NoCirculation,
    "printed": printed_circulation,
    "skew": skew_circulation,
    "switching": SwitchingCirculation,
}
_OBSERVERS = {"harmonic": harmonic_observer, "constant": constant_observer, "printed": printed_observer}
_STEEPEST = 1.25
"""More than the gradient bound of any guard's field so far."""
_GUARD_FIELD_ERROR = 0.06
"""What a guard's field says less than the distance near contact, and what the law's own wandering needs, m."""


def operation(around: Surroundings, error_bound: float) -> Operation:
    """Gather the numbers that a scenario's law is designed for, with its field's error bound e_h (m).

    Raises:
        ScenarioError: the thrusters cannot hold against the disturbance.

    """
    scenario = around.scenario
    return Operation(
        chaser=Chaser(**scenario.chaser.model_dump()),
        motion=around.motion,
        error_bound=error_bound,
        disturbance_bound=around.disturbance_bound,
        margin=scenario.safety.margin,
        period=scenario.control.period,
    )


def build_law(scenario: Scenario, model: FieldModel, **chosen: Any) -> Controller:
    """Build a scenario's control law on a field that is certified for the chaser's radius.

    Args:
        scenario: as of `law_on`.
        model: the field.
        **chosen: further arguments of `law_on`.

    Raises:
        KeepoutError: the law cannot be built; the message names the entry.

    """
    return law_on(scenario, model.field, model.certificate(scenario.chaser.radius).error_bound, **chosen)


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
    """Build a scenario's control law, as its designers meant it: without its faults, and without a delay.

    Args:
        scenario: its entries `control`, `chaser`, `safety`, `goal`, `start`, `orbit`, `attitude` and `disturbance`.
        field: what the law knows of the shape.
        error_bound: e_h, how far the field over-states the distance where the chaser touches, m.
        guidance: instead of the one that the scenario names.
        from_start: whether the scenario's start must be free and connected to its goal.
        progress: called while the guidance is made.
        **chosen: further arguments of the profile (`core/control/profiles.py`), such as `reach`.

    Raises:
        KeepoutError: the law cannot be built; the message names the entry.

    """
    around, circulation = Surroundings(scenario), scenario.control.circulation
    designed = operation(around, error_bound)
    plan = named_guidance(scenario) if guidance is None else guidance
    if has_rules(scenario):
        if not isinstance(plan, Guidance):
            usual = Geodesic() if scenario.control.profile == "default" else Componentwise()
            rule = speed_rule(scenario, field, error_bound)
            plan = (plan or usual).of_legs(lambda each: LegPlan(scenario, each, rule))
        field = zoned(around, field, error_bound + scenario.chaser.radius)
        if scenario.control.profile == "default":
            places = [scenario.start.position, *(leg.position for leg in scenario.leg), scenario.goal.position]
            chosen = {"reach": max(float(np.linalg.norm(place)) for place in places)} | chosen
    profile = {"default": profiles.default, "paper": profiles.paper}[scenario.control.profile]
    if scenario.control.profile == "paper":
        chosen = scenario.control.paper.model_dump() | chosen
    law = profile(
        field,
        designed,
        np.asarray(scenario.goal.position),
        guidance=plan,
        circulation=None if circulation is None else _CIRCULATIONS[circulation](),
        observer=_named_observer(scenario),
        start=np.asarray(scenario.start.position) if from_start else None,
        progress=progress,
        **chosen,
    )
    require_braking(scenario, law)
    return law


def named_guidance(scenario: Scenario) -> GuidancePlan | None:
    """Give the guidance that a scenario names; None where the profile's own is to be had."""
    control = scenario.control
    if control.guidance == "geodesic" or control.spacing is not None:
        return Geodesic(spacing=control.spacing)
    if control.guidance == "straight":
        return Straight() if control.profile == "default" else Componentwise()
    return None


def _named_observer(scenario: Scenario) -> Observer | None:
    named = scenario.control.observer
    if named == "off" or (scenario.navigation.suite != "none" and scenario.navigation.estimate == "raw"):
        return NoObserver()
    return None if named is None else _OBSERVERS[named](mass=scenario.chaser.mass, period=scenario.control.period)


def broken_as(scenario: Scenario, law: Law, field: Field) -> Law:
    """Tell a law of the legs and the delay that the scenario declares, and break it as the scenario's faults say.

    The field says where the body is.
    """
    chaser, law = scenario.chaser, law_of_legs(scenario, law)
    if scenario.guard.delay:
        motion = Surroundings(scenario).motion
        law = AheadOfDelay(law, motion, chaser.mass, scenario.control.period, scenario.guard.delay)
    if scenario.faults.law == "none":
        return law
    return BrokenLaw(
        law, field, scenario.faults.law, chaser.force_limit, chaser.mass, chaser.speed_limit, seed=scenario.seed
    )


def room_for_guard(around: Surroundings) -> dict[str, float]:
    """Give the default law's `nominal_offset` (m) where the guard asks for more than the law's margin holds anyway.

    That is where it expects errors or a fault, or keeps the margin itself.

    The guard passes commands on only where its tube around the way to rest is free. The more it allows for, the wider
    the tube; a law that led into it would be held there for ever. So it keeps the tube's radius and the margin that the
    guard keeps, times the steepest guard field met, and a little for that field's own error, beyond what its own margin
    holds already.

    Raises:
        ControlError: the thrusters cannot meet the guard's assumptions.

    """
    scenario = around.scenario
    if not scenario.guard.enabled or scenario.control.profile != "default":
        return {}
    assumed, kept = around.guard_assumptions, around.kept_margin
    if not (any(assumed.estimate_errors) or assumed.fault_steps or kept):
        return {}
    own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
    asked = _STEEPEST * (float(design(assumed).position_radius) + kept) + _GUARD_FIELD_ERROR
    return {"nominal_offset": max(own, asked - scenario.safety.margin)}


def law_or_way_out(
    scenario: Scenario, model: FieldModel, guidance: Guidance | GuidancePlan | None, progress: Progress, **chosen: Any
) -> Controller:
    """Build the scenario's law; a start in its keep-out zone is refused, unless a guard leads the way out first."""
    try:
        return build_law(scenario, model, guidance=guidance, progress=progress, **chosen)
    except ControlError:
        if not scenario.guard.enabled:
            raise
        law = build_law(scenario, model, guidance=guidance, from_start=False, progress=progress, **chosen)
        # Refused for another reason than being too near, or inside the target: then there is no way to lead out.
        said = float(values(model.field, np.asarray(scenario.start.position)[None])[0])
        if not 0.0 < said <= float(law.velocity.offset):
            raise
        return law

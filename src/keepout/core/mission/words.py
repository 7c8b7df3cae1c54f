"""A scenario in words: what will be flown, a sentence each."""

import math

import numpy as np

from keepout.core.geometry.target import Target
from keepout.core.mission.first_look import assumed_disturbance, flown_disturbance
from keepout.core.mission.scenario import Scenario

_TURNING = {"vvlh": "fixed to VVLH", "inertial": "fixed to the stars", "tumbling": "tumbling"}


def in_words(scenario: Scenario, target: Target) -> tuple[str, ...]:
    """Say what a scenario flies: chaser, target, way, law, guard, disturbance and faults."""
    chaser, orbit, control = scenario.chaser, scenario.orbit, scenario.control
    extents = " × ".join(f"{extent:.3g}" for extent in np.ptp(target.vertices, axis=0))
    apart = math.dist(scenario.start.position, scenario.goal.position)
    turning = _TURNING[scenario.attitude.kind]
    if scenario.attitude.kind == "tumbling":
        turning += f" at {math.degrees(math.hypot(*scenario.attitude.angular_velocity)):.3g} °/s"
    forces = [name for name, there in (("J2", orbit.j2), ("drag", scenario.drag.density > 0.0)) if there]
    sentences = [
        f"A chaser of {chaser.mass:g} kg in a ball of {chaser.radius:g} m flies around {target.name}, {extents} m, "
        f"{turning}, on an orbit with a semi-major axis of {orbit.semi_major_axis / 1e3:.6g} km and an eccentricity of "
        f"{orbit.eccentricity:g}{', with ' + ' and '.join(forces) if forces else ''}.",
        f"From {_shown(scenario.start.position)} m to {_shown(scenario.goal.position)} m, {apart:.3g} m apart, in "
        f"{scenario.duration:g} s, at up to {chaser.speed_limit:g} m/s, with up to {chaser.force_limit:g} N an axis.",
        f"The law is {control.profile}, asked every {control.period:g} s"
        + "".join(
            f", {kind} {chosen}"
            for kind, chosen in (
                ("guidance", control.guidance),
                ("circulation", control.circulation),
                ("observer", control.observer),
            )
            if chosen is not None
        )
        + f"; it keeps {scenario.safety.margin:g} m beside what is proved.",
        "The guard flies along." if scenario.guard.enabled else "No guard flies along: nothing is proved.",
        _pushed(scenario),
    ]
    faults = scenario.faults.model_dump(exclude_defaults=True)
    if faults:
        sentences.append(f"Faults: {', '.join(f'{name} {value}' for name, value in faults.items())}.")
    return tuple(sentences)


def _shown(place: tuple[float, float, float]) -> str:
    return f"[{', '.join(f'{x:g}' for x in place)}]"


def _pushed(scenario: Scenario) -> str:
    if scenario.disturbance.kind == "none":
        return "Nothing disturbs it."
    flown, assumed = flown_disturbance(scenario), assumed_disturbance(scenario)
    said = f"The disturbance is {scenario.disturbance.kind}, up to {flown:.4g} N"
    return f"{said}." if flown == assumed else f"{said}; law and guard assume {assumed:.4g} N."

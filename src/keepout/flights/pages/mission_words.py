"""What a scenario flies, in sentences: what `keepout scenario check` says first."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from keepout.core.errors import KeepoutError
from keepout.core.geometry.target import Target
from keepout.core.mission.first_look import assumed_disturbance, flown_disturbance
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import LegEntry, ZoneEntry
from keepout.core.mission.zones import named
from keepout.core.plug_ins import load
from keepout.flights.pages.page import bracketed
from keepout.flights.requirements import required

_ESTIMATE = {
    "filter": "a Kalman filter",
    "observer": "the last samples and its own observer",
    "raw": "the last samples",
}
_TOLD_WRONG = {
    "position_bias": "a constant error of {:g} m",
    "velocity_bias": "a constant velocity error of {:g} m/s",
    "position_noise": "a new error of up to {:g} m each period",
    "velocity_noise": "a new velocity error of up to {:g} m/s each period",
    "position_noise_std": "a Gaussian error of {:g} m an axis",
    "velocity_noise_std": "a Gaussian velocity error of {:g} m/s an axis",
    "noise_correlation_time": "correlated over {:g} s",
}
_BEYOND = {
    "law": 'The law is replaced by a broken one, "{}".',
    "delay": "In truth a command takes effect {} control periods late.",
    "dropped": "Each command is lost with probability {:g}; the last one then goes on.",
    "gain_error": "Each axis gives 1 ± {:g} of its command, drawn once a flight.",
}
_ASSUMED = {
    "position_error": "a position error of up to {:g} m",
    "velocity_error": "a velocity error of up to {:g} m/s",
    "mass_error": "a mass wrong by up to {:.3g} of it",
    "gain_error": "thrusters wrong by up to {:.3g} of their force",
}


def in_words(scenario: Scenario, target: Target) -> tuple[str, ...]:
    """Say what a scenario flies, a sentence each; what it leaves out is not said.

    Args:
        scenario: to be told.
        target: its mesh.

    """
    chaser, control, guard = scenario.chaser, scenario.control, scenario.guard
    parts = {name: getattr(control, name) for name in ("guidance", "circulation", "observer")}
    chosen = "".join(f", {name} {part}" for name, part in parts.items() if part is not None)
    apart = math.dist(scenario.start.position, scenario.goal.position)
    sentences = [
        _around(scenario, target),
        _turning(scenario),
        f"From {bracketed(scenario.start.position)} m to {bracketed(scenario.goal.position)} m, "
        f"{apart:.3g} m apart, in {scenario.duration:g} s, at up to {chaser.speed_limit:g} m/s.",
        *_approach(scenario),
        _thrusters(scenario),
        _sensors(scenario),
        f"The law is {control.profile}, asked every {control.period:g} s{chosen}; "
        f"it keeps {scenario.safety.margin:g} m beside what is proved.",
    ]
    if guard.delay:
        periods = f"{guard.delay} control period{'s' if guard.delay > 1 else ''} ({guard.delay * control.period:g} s)"
        sentences.append(f"Law and guard count on {periods} from a command to its effect.")
    if guard.enabled:
        assumed = [said.format(getattr(guard, name)) for name, said in _ASSUMED.items() if getattr(guard, name)]
        kept = "The guard flies along" + (
            f" and keeps the margin of {scenario.safety.margin:g} m too" if guard.keeps_margin else ""
        )
        sentences.append(kept + (f"; it allows for {', '.join(assumed)}." if assumed else "."))
    else:
        sentences.append("No guard flies along: nothing is proved.")
    sentences += [_pushed(scenario), *_faults(scenario)]
    asked = list(required(scenario.require).values())
    return (*sentences, f"Required: {', '.join(asked)}.") if asked else tuple(sentences)


def _around(scenario: Scenario, target: Target) -> str:
    chaser, orbit = scenario.chaser, scenario.orbit
    extents = " × ".join(f"{extent:.3g}" for extent in np.ptp(target.vertices, axis=0))
    forces = [name for name, there in (("J2", orbit.j2), ("drag", scenario.drag.density > 0.0)) if there]
    return (
        f"A chaser of {chaser.mass:g} kg in a ball of {chaser.radius:g} m flies around {target.name}, {extents} m, on "
        f"an orbit with a semi-major axis of {orbit.semi_major_axis / 1e3:.6g} km and an eccentricity of "
        f"{orbit.eccentricity:g}{', with ' + ' and '.join(forces) if forces else ''}."
    )


def _turning(scenario: Scenario) -> str:
    attitude = scenario.attitude
    if attitude.kind == "vvlh":
        return "The target is fixed to VVLH: its x axis points along its velocity, its z axis to the Earth."
    if attitude.kind == "inertial":
        return "The target is fixed to the stars."
    rate = math.degrees(math.hypot(*attitude.angular_velocity))
    torque = "; the Earth's gravity turns it too" if attitude.gravity_gradient else ""
    return (
        f"The target tumbles freely, at first at {rate:.3g} °/s about {bracketed(attitude.angular_velocity)} rad/s in "
        f"its body axes{torque}."
    )


def _approach(scenario: Scenario) -> Iterator[str]:
    """Tell legs, zones, corridors and the rule of speeds, a sentence each."""
    if scenario.leg:
        legs = "; ".join(_leg(leg, number) for number, leg in enumerate(scenario.leg))
        yield f"It flies {_count(len(scenario.leg), 'leg')}: {legs}."
    if scenario.zone:
        zones = "; ".join(_zone(zone, number) for number, zone in enumerate(scenario.zone))
        yield f"No part of the chaser enters {_count(len(scenario.zone), 'zone')}: {zones}."
    if scenario.corridor:
        told = []
        for number, entry in enumerate(scenario.corridor):
            wide = "" if entry.radius is None else f" of {entry.radius:g} m"
            form = f"a tube{wide}"
            if entry.half_angle is not None:
                form = f"a cone of {math.degrees(entry.half_angle):.3g}° to each side" + (
                    f" from a circle{wide}" if wide else ""
                )
            name = named("corridor", entry, number)
            clear = "" if entry.clear_from is None else f", proved clear from {entry.clear_from:g} m on"
            told.append(f"{name}, {form}, within {entry.length:g} m of the port {bracketed(entry.port)} m{clear}")
        yield f"The chaser's centre stays in {_count(len(told), 'corridor')}: {'; '.join(told)}."
    rule = scenario.approach.speed_by_distance
    if rule:
        to = "the mesh" if scenario.approach.distance_to is None else f"{bracketed(scenario.approach.distance_to)} m"
        pairs = ", ".join(f"{speed:g} m/s at {distance:g} m" for distance, speed in rule)
        yield f"By the distance to {to} it flies at up to {pairs}; between two of these in proportion, beyond as there."


def _leg(leg: LegEntry, number: int) -> str:
    speed = "" if leg.speed_limit is None else f" at up to {leg.speed_limit:g} m/s"
    window = "" if leg.within is None else f" between {leg.within[0]:g} s and {leg.within[1]:g} s"
    held = [f"for {leg.dwell:g} s"] if leg.dwell else []
    held += [f'until "go" (in simulation at {leg.go_at:g} s)'] if leg.go_at is not None else []
    hold = f", held {' and '.join(held)}" if held else ""
    speed += ", slow enough to drift past without thrust" if leg.drift_safe else ""
    place = bracketed(leg.position) + (" m" if leg.axes == "body" else f" m ({leg.axes})")
    return f"{named('leg', leg, number)} to {place} within {leg.tolerance:g} m{speed}{window}{hold}"


def _zone(zone: ZoneEntry, number: int) -> str:
    said = {"body": "fixed to the target", "vvlh": "fixed in VVLH", "inertial": "fixed to the stars"}
    form = f"{'an' if zone.shape == 'ellipsoid' else 'a'} {zone.shape}"
    form += "" if zone.file is None else f" ({Path(zone.file).name})"
    form += f" of {zone.radius:g} m" if zone.shape == "sphere" else f" {zone.length:g} m long" if zone.length else ""
    since = f" from {zone.start:g} s" if zone.start else ""
    until = {None: "", "go": ' until "go"'}.get(zone.until, f" until {zone.until} s")
    return f"{named('zone', zone, number)}, {form}, {said[zone.axes]}{since}{until}"


def _count(count: int, of: str) -> str:
    return f"{count} {of}{'s' if count != 1 else ''}"


def _thrusters(scenario: Scenario) -> str:
    entry, force_limit = scenario.thrusters, scenario.chaser.force_limit
    if entry.layout == "ideal":
        held = ", held in inertial axes over a period" if entry.held_in == "inertial" else ""
        return f"Its thrusters are ideal: any force up to {force_limit:g} N an axis, at any instant{held}."
    try:
        flown = load("thrusters", "layout")(scenario)
    except KeepoutError:  # of which the check tells
        return f'Its thrusters are those of layout "{entry.layout}".'
    forces = " to ".join(dict.fromkeys(f"{force:.3g}" for force in (min(flown.force), max(flown.force))))
    said = (
        f'Its {flown.count} thrusters (layout "{entry.layout}") of {forces} N are on or off, for at least '
        f"{entry.least_on_time:g} s, by {entry.modulation} modulation"
    )
    wrong = {"begin and end {:g} s late": entry.rise_delay, "up to {:g} rad askew": entry.misalignment}
    wrong["up to {:g} of their force too strong or weak"] = entry.scale_error
    said += "".join(f", {words.format(value)}" for words, value in wrong.items() if value)
    survived = f"the guard covers one that sticks, known after {entry.detection_time:g} s"
    return f"{said}; {survived}." if entry.survive_failure else f"{said}."


def _sensors(scenario: Scenario) -> str:
    entry, period = scenario.navigation, scenario.control.period
    if entry.suite == "none":
        errors = [said.format(v) for name, said in _TOLD_WRONG.items() if (v := getattr(scenario.faults, name))]
        return (
            f"It is told its state, with {', '.join(errors)}."
            if errors
            else "It is told its true state; no sensors fly."
        )
    told = []
    try:
        suite = load("navigation", "suite")(entry)
    except KeepoutError:  # of which the check tells
        return f'Its sensors are those of suite "{entry.suite}".'
    for sensor in suite.sensors:
        name = re.sub(r"(?<!^)(?=[A-Z])", " ", type(sensor).__name__).lower()
        late = f", {sensor.latency * period:g} s late" if sensor.latency else ""
        lost = f", at most {sensor.most_missed} lost in a row" if sensor.most_missed else ""
        told.append(f"{name} every {sensor.every * period:g} s{late}{lost}")
    return f'Its sensors (suite "{entry.suite}"): {"; ".join(told)}. The law flies by {_ESTIMATE[entry.estimate]}.'


def _pushed(scenario: Scenario) -> str:
    if scenario.disturbance.kind == "none":
        return "Nothing disturbs it."
    flown, assumed = flown_disturbance(scenario), assumed_disturbance(scenario)
    said = f"The disturbance is {scenario.disturbance.kind}, up to {flown:.4g} N"
    return f"{said}." if flown == assumed else f"{said}; law and guard assume {assumed:.4g} N."


def _faults(scenario: Scenario) -> Iterator[str]:
    faults = scenario.faults
    yield from (said.format(v) for name, said in _BEYOND.items() if (v := getattr(faults, name)) not in (0, "none"))
    if faults.stuck is not None:
        since = f"from {faults.stuck_from:g} s on, at {faults.stuck_force:g} N"
        yield f"The thruster that pushes to {faults.stuck} sticks {since}."
    if faults.abort_at is not None:
        back = (
            "it flies back to the hold before" if scenario.approach.abort == "retreat" else "nothing thrusts any more"
        )
        yield f"The mission is abandoned at {faults.abort_at:g} s: from then on {back}."
    if faults.thruster is not None:
        yield f"Thruster {faults.thruster} sticks {faults.thruster_stuck} from {faults.stuck_from:g} s on."

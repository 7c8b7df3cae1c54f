"""What a scenario's numbers, file names and mesh refuse by themselves: said at once, before anything slow is imported.

Each refusal here is one that `prepare` would come to as well, after seconds. Nothing here needs JAX.
"""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from keepout.core.errors import ControlError, FieldError, MeshError, ScenarioError
from keepout.core.fields import shipped_folder, shipped_names
from keepout.core.mission.scenario import Scenario
from keepout.core.plug_ins import load

if TYPE_CHECKING:
    from keepout.core.geometry.target import Target

STOPPING_DISTANCE = 3.0
"""Within which the recommended law must be able to stop from its speed limit, m."""
_PAPER = 0.01 * math.sqrt(2.0)
"""Largest norm of the paper's disturbance, N: a sine and a cosine of one frequency, and a sine of another."""
_SAME_RADIUS = 2e-9
"""Metres within which two chaser radii are one; twice as far as for what reads the field."""
_LONGEST_HEADER = 10_000_000
"""Bytes; a longer header of a field file is left to what reads it."""
_OUTWARD = 1.0 + 1e-9
"""More than the models' own bounds are rounded up by, so that nothing is refused here that they would let pass."""


def look(scenario: Scenario) -> "Target":
    """Refuse what can be refused at once; return the target, which is loaded by then.

    Raises:
        ScenarioError: the thrusters are weaker than the disturbance, or start or goal touch the target.
        ControlError: the thrusters cannot stop the chaser from its speed limit, even without drift.
        MeshError: the mesh is not there or cannot be used.
        FieldError: the field is not there, or has no certificate for the chaser.

    """
    require_authority(scenario)
    require_stopping(scenario)
    require_thrusters(scenario)
    require_files(scenario)
    require_certified(scenario)
    from keepout.core.mission.target import load_target, require_apart

    target = load_target(scenario.target)
    require_apart(scenario, target)
    return target


def flown_disturbance(scenario: Scenario) -> float:
    """Give the largest norm, N, of the force that the scenario's disturbance pushes with."""
    entry = scenario.disturbance
    match entry.kind:
        case "none":
            return 0.0
        case "paper":
            return _PAPER
        case "constant":
            return math.hypot(*(entry.force or ()))
        case _:
            return entry.amplitude or 0.0


def assumed_disturbance(scenario: Scenario) -> float:
    """Give the largest norm, N, that law and guard assume of it."""
    declared = scenario.disturbance.bound
    return flown_disturbance(scenario) if declared is None else declared


def require_authority(scenario: Scenario) -> None:
    """Refuse a disturbance that the thrusters cannot hold against."""
    refuse_disturbance(assumed_disturbance(scenario) / _OUTWARD, scenario.chaser.force_limit)


def refuse_disturbance(bound: float, force_limit: float) -> None:
    """Refuse a bound of the disturbance, N, that is not below the thrusters' limit, N.

    Raises:
        ScenarioError: it is not.

    """
    if bound >= force_limit:
        raise ScenarioError(
            f"disturbance: its bound, {bound:.4g} N, is not below chaser.force_limit, {force_limit} N; "
            "no law can hold the chaser"
        )


def require_stopping(scenario: Scenario) -> None:
    """Refuse a speed limit from which the recommended law could not stop the chaser even if nothing drifted."""
    if scenario.control.profile != "default":
        return
    chaser = scenario.chaser
    authority = (chaser.force_limit - assumed_disturbance(scenario) / _OUTWARD) / chaser.mass
    honoured = math.sqrt(2.0 * authority * STOPPING_DISTANCE)
    if chaser.speed_limit > honoured * _OUTWARD:
        raise ControlError(
            f"chaser.speed_limit: {chaser.speed_limit:.3g} m/s cannot be stopped within {STOPPING_DISTANCE:.3g} m with "
            f"{authority:.3g} m/s2; at most {honoured:.3g} m/s, and less where the frame turns fast"
        )


def require_thrusters(scenario: Scenario) -> None:
    """Refuse a layout that cannot be flown, and entries that are for a layout where there is none."""
    if scenario.thrusters.layout != "ideal":
        load("thrusters", "require")(scenario)
        return
    given = [f"thrusters.{key}" for key in scenario.thrusters.model_dump(exclude_defaults=True, exclude={"held_in"})]
    if scenario.faults.thruster is not None:
        given.append("faults.thruster")
    if given:
        raise ScenarioError(
            f'{", ".join(given)}: only for a layout, and thrusters.layout is "ideal"; give "six", "12", "24" or "own"'
        )


def require_files(scenario: Scenario) -> None:
    """Refuse names of a mesh or a field that lead to no file."""
    require_mesh(scenario.target.source)
    field = scenario.field.source
    if field == "shipped":
        require_shipped(scenario)
    elif field != "grid" and not Path(field).exists():
        raise FieldError(f"{field}: no such file; a field is a .keepout file")


def require_mesh(source: str) -> None:
    """Refuse the name of a mesh file that is not there."""
    if Path(source).suffix and not Path(source).exists():
        raise MeshError(f"{source}: no such file, and no built-in target of that name")


def require_shipped(scenario: Scenario) -> None:
    """Refuse a field that would have to come with the package and does not."""
    shipped = shipped_names()
    if scenario.target.source not in shipped:
        raise FieldError(
            f'field.source: "shipped" is only for {", ".join(shipped)}, not for {scenario.target.source!r}; '
            'make one with `keepout fit` and `keepout certify` and name its file, or give "grid"'
        )


def require_certified(scenario: Scenario) -> None:
    """Refuse a chaser radius for which the field's file holds no certificate; what it holds besides is not looked at.

    A file that cannot be understood is left to what reads it whole, which says why.
    """
    source = scenario.field.source
    if source == "grid":
        return
    path = shipped_folder() / f"{scenario.target.source}.keepout" if source == "shipped" else Path(source)
    try:
        with path.open("rb") as file:
            told = json.loads(file.read(min(int.from_bytes(file.read(8), "little"), _LONGEST_HEADER)))
        header = json.loads(told["__metadata__"]["header"])
        name, radii = header["target"]["name"], [float(entry["chaser_radius"]) for entry in header["certificates"]]
    except (OSError, ValueError, KeyError, TypeError):
        return
    radius = scenario.chaser.radius
    if not any(abs(certified - radius) <= _SAME_RADIUS for certified in radii):
        raise FieldError(
            f"chaser radius {radius:g} m: the field of {name} is certified for: "
            f"{', '.join(f'{certified:g} m' for certified in radii) or 'none'}; "
            f"`keepout certify --chaser-radius {radius:g}` adds a certificate"
        )

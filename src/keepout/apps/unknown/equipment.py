"""What a scenario says of exploring, as objects: the depth sensor, the declared ball, the map; and what is refused."""

import dataclasses
import math
from pathlib import Path

import numpy as np

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown import map_file
from keepout.apps.unknown.by_map import DeclaredBall
from keepout.apps.unknown.depth_sensor import DepthCamera
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import ScenarioError
from keepout.core.geometry.target import Target
from keepout.core.mission.approach import require_one_leg
from keepout.core.mission.scenario import Scenario

_CAP = 1.5
"""Metres from unknown room beyond which the default law flies at its full speed, about."""
_SHALLOWEST = 1.0
"""Metres between the least and the greatest range used, below which nothing could be seen from where one may be."""


def depth_camera(scenario: Scenario) -> DepthCamera:
    """Give the scenario's depth sensor.

    Raises:
        KeepoutError: a number out of range; the message names the entry.

    """
    entry = scenario.depth_sensor
    own = ("period", "latency", "mounting", "dropout", "grazing_angle")
    bounds = SensorBounds(**{field.name: getattr(entry, field.name) for field in dataclasses.fields(SensorBounds)})
    return DepthCamera(pinhole(scenario), bounds, **{name: getattr(entry, name) for name in own})


def pinhole(scenario: Scenario) -> Pinhole:
    """Give the camera that the scenario's depth images are taken with."""
    entry = scenario.depth_sensor
    return Pinhole(entry.width, entry.height, entry.field_of_view)


def declared_ball(scenario: Scenario) -> DeclaredBall:
    """Give the ball that is promised to hold the target.

    Raises:
        ScenarioError: the scenario does not say how large it is.

    """
    entry = scenario.map
    if entry.radius is None:
        raise ScenarioError(
            "map.radius: not given; it must be the radius (m) of a ball round map.centre that surely holds the whole "
            "target, since nothing else is known of it"
        )
    return DeclaredBall(entry.centre, entry.radius)


def told_apart(scenario: Scenario) -> float:
    """Give the greatest distance that the scenario's map tells apart, m: enough for the law's full speed, if unset."""
    entry = scenario.map
    if entry.cap is not None:
        return entry.cap
    return math.ceil(_CAP / entry.spacing - 1e-9) * entry.spacing


def map_of(scenario: Scenario, camera: DepthCamera) -> KnownFreeMap:
    """Begin the scenario's map, or go on with the file that it names.

    Raises:
        KeepoutError: a number out of range, or a file that is not a map of this ball, spacing and sensor.

    """
    ball, entry = declared_ball(scenario), scenario.map
    fresh = KnownFreeMap.begin(
        np.asarray(ball.centre),
        ball.radius,
        spacing=entry.spacing,
        cap=told_apart(scenario),
        bounds=camera.bounds,
        name=scenario.name,
        speed_limit=1.5 * scenario.chaser.speed_limit,
    )
    if entry.file is None:
        return fresh
    kept = map_file.load(Path(entry.file), name=scenario.name, spacing=entry.spacing)
    asked, held = map_file.settings(fresh), map_file.settings(kept)
    for key, value in asked.items():
        if held[key] != value:
            raise ScenarioError(
                f"map.file: {entry.file} was begun with {key} {held[key]}, and the scenario has {value}; use the "
                "scenario that it was begun with, or begin a new map"
            )
    kept.begin_flight()
    return kept


def require_explorable(scenario: Scenario, camera: DepthCamera) -> None:
    """Refuse what no flight could make good, with numbers, before anything flies.

    Raises:
        ScenarioError: the message names the entry.

    """
    require_one_leg(scenario, "an exploration is led by what it sees")
    period, entry = scenario.control.period, scenario.depth_sensor
    for name in ("period", "latency"):
        value = getattr(entry, name)
        if abs(value / period - round(value / period)) > 1e-9:
            raise ScenarioError(f"depth_sensor.{name}: {value} s; it must be whole control periods of {period} s")
    usable = camera.bounds.usable_range(camera.camera)
    if usable < entry.least_range + _SHALLOWEST:
        pitch = entry.least_range + _SHALLOWEST
        needed = 2.0 * pitch / (camera.camera.focal * entry.rays_across)
        raise ScenarioError(
            f"depth_sensor.surely_returned_width: {entry.surely_returned_width} m lets ranges up to {usable:.3g} m be "
            f"used; that must be at least {pitch:.3g} m: a width of {needed:.3g} m, more rays_across, or more pixels"
        )
    if scenario.field.source != "shipped":
        raise ScenarioError(
            f"field.source: {scenario.field.source!r}; an explorer knows the map alone, so leave it out"
        )
    laws = ("faults.law", scenario.faults.law, "none"), ("control.profile", scenario.control.profile, "default")
    for name, value, flown in laws:
        if value != flown:
            raise ScenarioError(f'{name}: "{value}"; exploring is flown by the default law')
    least = scenario.chaser.radius + scenario.safety.margin + math.sqrt(3.0) * scenario.map.spacing + 0.3
    if told_apart(scenario) < least:
        raise ScenarioError(
            f"map.cap: {told_apart(scenario):g} m; it must be at least {least:.3g} m: the chaser's radius, the margin, "
            "and room to tell near from far"
        )
    ball = declared_ball(scenario)
    if scenario.explore.towards == "goal":
        away = float(np.max(np.abs(np.asarray(scenario.goal.position) - np.asarray(ball.centre))))
        farthest = ball.radius + told_apart(scenario)
        if away > farthest:
            raise ScenarioError(
                f"goal.position: {list(scenario.goal.position)} m is {away:.3g} m from map.centre along an axis; it "
                f"must be at most {farthest:.3g} m, within the map"
            )


def expected_target(scenario: Scenario) -> Target | None:
    """Load the mesh that the mission believes in, where it names one."""
    entry = scenario.explore
    if entry.expected is None:
        return None
    return Target.load(entry.expected, units=entry.expected_units)

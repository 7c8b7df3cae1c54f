"""What a scenario says of exploring, as objects: the depth sensor, the declared ball, the map; and what is refused."""

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
from keepout.core.geometry.octree import cubes_met
from keepout.core.geometry.target import Target
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
    camera = Pinhole(entry.width, entry.height, entry.field_of_view)
    bounds = SensorBounds(
        range_error=entry.range_error,
        position_error=entry.position_error,
        attitude_error=entry.attitude_error,
        surely_returned_width=entry.surely_returned_width,
        rays_across=entry.rays_across,
        sure_empty_range=entry.sure_empty_range,
        least_range=entry.least_range,
        greatest_range=entry.greatest_range,
    )
    return DepthCamera(
        camera=camera,
        bounds=bounds,
        period=entry.period,
        latency=entry.latency,
        mounting=entry.mounting,
        dropout=entry.dropout,
        grazing_angle=entry.grazing_angle,
    )


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
    if scenario.faults.law != "none" or scenario.control.profile != "default":
        given = (
            ("faults.law", scenario.faults.law)
            if scenario.faults.law != "none"
            else ("control.profile", scenario.control.profile)
        )
        raise ScenarioError(f'{given[0]}: "{given[1]}"; exploring is flown by the default law')
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


class WronglyFree:
    """Cubes that a map calls free although they hold a part of the true mesh, which only a simulation can know.

    They are what the assumptions of docs/mapping.md exclude. So this looks at assumption A1 wherever it matters, in
    every view, and misses no part however thin: where an image frees no such cube, nothing follows from a part that
    it did not meet.
    """

    def __init__(self, known: KnownFreeMap, target: Target) -> None:
        met = cubes_met(target.vertices, target.faces, known.origin, known.spacing, len(known.free))
        self._held = np.flatnonzero(met)
        self._before = self._count = int(known.free.ravel()[self._held].sum())
        self._first = math.inf

    def note(self, known: KnownFreeMap, now: float) -> None:
        """Look at the map after it has taken in an image of the time `now` (s)."""
        self._count = int(known.free.ravel()[self._held].sum())
        if self._count > self._before:
            self._first = min(self._first, now)

    def words(self, scenario: Scenario) -> tuple[str, ...]:
        """Say what was found; () where every free cube is."""
        told = []
        if self._before and scenario.map.file is not None:
            told.append(f"map.file: {self._before} cubes that it calls free hold a part of the target")
        if self._count > self._before:
            sensor = scenario.depth_sensor
            # Its other promises are kept wherever the simulation is not told to break one.
            why = (
                ""
                if sensor.broken != "none"
                else f": assumption A1 (width {sensor.surely_returned_width:g} m) is broken"
            )
            told.append(
                f"{self._count - self._before} cubes that hold a part of the target were called free, the first by the "
                f"image at {self._first:g} s{why}"
            )
        return tuple(told)


def broken_promises(scenario: Scenario, target: Target, ball: DeclaredBall) -> tuple[str, ...]:
    """Name what the simulated world does beyond what ball and sensor promise, each with its numbers."""
    found = []
    reach = float(np.linalg.norm(target.vertices - np.asarray(ball.centre), axis=1).max())
    if reach > ball.radius:
        found.append(f"target: reaches {reach:.6g} m from map.centre > map.radius {ball.radius:.6g} m")
    if scenario.depth_sensor.broken != "none":
        found.append(f"depth_sensor.broken {scenario.depth_sensor.broken} (docs/depth-sensor.md)")
    return tuple(found)

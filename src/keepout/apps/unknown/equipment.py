"""What a scenario says of exploring, as objects: the depth sensor, the declared ball, the map; and what is refused."""

import dataclasses
import math
from pathlib import Path
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown import map_file
from keepout.apps.unknown.by_map import DeclaredBall
from keepout.apps.unknown.depth_sensor import DepthCamera
from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import ScenarioError
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

_CAP = 1.5
"""Metres from unknown room beyond which the default law flies at its full speed, about."""
_SHALLOWEST = 1.0
"""Metres between the least and the greatest range used, below which nothing could be seen from where one may be."""
_TOUCHED = 1e-9
"""Metres by which each side of a cube is moved inwards, so that a triangle that only touches it does not count."""


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
            why = f": assumption A1 (width {sensor.surely_returned_width:g} m) is broken"
            why = "" if sensor.broken != "none" else why
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


def cubes_met(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    count: int,
) -> Bool[np.ndarray, "n n n"]:
    """Say of count³ cubes of edge `spacing` (m) from the corner `origin` (m) on which of them a mesh (m) meets.

    Exact but for rounding: what reaches less than a billionth of a metre into a cube may not count.
    """
    met = np.zeros((count, count, count), dtype=np.bool_)
    _meet((vertices[faces] - origin) / spacing, 0.5 - _TOUCHED / spacing, met)
    return met


@no_type_check
@numba.njit(cache=True, nogil=True)
def _meet(triangles, half, met):
    """Mark the unit cubes, cut to the half side `half`, that triangles in units of the edge meet.

    Two convex bodies are apart just where a plane parts them. Of a triangle and a cube it is enough to look along the
    cube's sides, along the triangle's normal, and along the products of their edges.
    """
    last = len(met) - 1
    axes = np.empty((13, 3))
    axes[:3] = np.eye(3)
    for t in range(len(triangles)):
        corners = triangles[t]
        for e in range(3):
            x, y, z = corners[(e + 1) % 3] - corners[e]
            axes[3 + 3 * e], axes[4 + 3 * e], axes[5 + 3 * e] = (0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)
        axes[12] = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        low, high = np.empty(13), np.empty(13)
        for a in range(13):
            along = corners @ axes[a]
            reach = half * np.abs(axes[a]).sum()
            low[a], high[a] = along.min() - reach, along.max() + reach
        for i in range(max(int(np.floor(low[0])), 0), min(int(np.floor(high[0])), last) + 1):
            for j in range(max(int(np.floor(low[1])), 0), min(int(np.floor(high[1])), last) + 1):
                for k in range(max(int(np.floor(low[2])), 0), min(int(np.floor(high[2])), last) + 1):
                    apart = met[i, j, k]
                    for a in range(13):
                        middle = (i + 0.5) * axes[a, 0] + (j + 0.5) * axes[a, 1] + (k + 0.5) * axes[a, 2]
                        if apart or middle < low[a] or middle > high[a]:
                            apart = True
                            break
                    if not apart:
                        met[i, j, k] = True

"""What a scenario's zones and corridors become: shapes in the fields of law and guard, and regions for the audit.

How a zone turns against the body frame is followed by the flight's own model of motion. Room that a corridor declares
clear of the mesh is proved so here.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.audit import zones as judged
from keepout.core.audit.zones import Region
from keepout.core.errors import MeshError, ScenarioError
from keepout.core.fields import zones as shapes
from keepout.core.fields.field import Field, in_pieces
from keepout.core.fields.zones import ClearRoom, SweptCone, Zone, ZonedField
from keepout.core.geometry.distance import Distance
from keepout.core.geometry.hulls import Hulls, hulls_of
from keepout.core.geometry.octree import CORNERS, SQRT3
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.task_entries import SHAPES, CorridorEntry, LegEntry, ZoneEntry
from keepout.core.motion import rotation
from keepout.core.motion.arrays import Scalar, as_float64
from keepout.core.motion.relative import MotionState, RelativeMotion

_TURN = math.radians(5.0)
"""Between two rotations that stand for a turning zone, at most, unless that would pass `_MOST_MOMENTS`."""
_MOST_MOMENTS = 256
_MOST_PLANES = 32_768
"""Of a mesh that turns, over all moments."""
_FINEST = 2e-3
"""Metres: half the side of the smallest cubes by which room is proved clear."""
_MOST_CUBES = 500_000
"""That are halved at a time."""


def named(kind: str, entry: LegEntry | ZoneEntry | CorridorEntry, number: int) -> str:
    """Give what an entry of a list is called in refusals and tables, by its own name or its number from 0."""
    return f"{kind} {number}" if entry.name is None else f'{kind} "{entry.name}"'


def with_digests(scenario: Scenario) -> Scenario:
    """Give a scenario with the digest of the mesh of each zone that has one.

    Raises:
        ScenarioError: a mesh cannot be read, or is not the one of the digest that is there already.

    """
    digests = [
        mesh_of(zone, named("zone", zone, k)).sha256 if zone.file else None for k, zone in enumerate(scenario.zone)
    ]
    if digests == [zone.sha256 for zone in scenario.zone]:
        return scenario
    told = zip(scenario.zone, digests, strict=True)
    return scenario.replace(zone=[zone.model_dump() | {"sha256": of} for zone, of in told])


def mesh_of(zone: ZoneEntry, name: str) -> Hulls:
    """Give the hulls of a zone that is a mesh; `name` is the zone's, in refusals.

    Raises:
        ScenarioError: its file cannot be read, has too many planes, or is not the one that was flown.

    """
    assert zone.file is not None
    try:
        found = hulls_of(zone.file, zone.units)
    except MeshError as refusal:
        raise ScenarioError(f"{name}: file {zone.file}: {refusal}") from None
    if zone.sha256 not in (None, found.sha256):
        raise ScenarioError(
            f"{name}: file {zone.file}: not the mesh that was flown: its digest is {found.sha256[:12]}…, and sha256 "
            f"says {str(zone.sha256)[:12]}…"
        )
    return found


def ends(scenario: Scenario, zone: ZoneEntry) -> float:
    """Give the time, s, at which a zone ends; infinite where it does not. "go" is that of the first such leg."""
    if zone.until == "go":
        return next((leg.go_at for leg in scenario.leg if leg.go_at is not None), math.inf)
    return math.inf if zone.until is None else zone.until


@dataclass(frozen=True)
class Turning:
    """How a zone's axes turn against the body frame while it stands.

    Attributes:
        rotations: zone's axes ← body axes, of some moments.
        ends: until when each stands for the zone, s.
        turned: the largest angle between the two, rad; 0 for axes at rest.

    """

    rotations: Float[np.ndarray, "moments 3 3"]
    ends: Float[np.ndarray, "moments"]
    turned: float


def turning(around: Surroundings, zone: ZoneEntry) -> Turning:
    """Follow a zone's axes from when it stands until it ends, or the flight does.

    Raises:
        ScenarioError: it turns so often while it stands that it is everywhere.

    """
    scenario, end = around.scenario, ends(around.scenario, zone)
    if zone.axes == "body":
        return Turning(np.eye(3)[None], np.array([end]), 0.0)
    period, rate = scenario.control.period, around.turning_rate(zone.axes)
    first = min(math.floor(zone.start / period), scenario.steps)
    last = min(math.ceil(min(end, 2.0 * scenario.duration) / period), scenario.steps + 1)
    if not rate:
        first, last = 0, 1
    angle = rate * (max(last - first, 1) + 1) * period
    count = min(max(math.ceil(angle / _TURN), 1), _MOST_MOMENTS)
    each = max(math.ceil((last - first) / count), 1)
    turned = 0.5 * rate * (each + 1) * period
    if turned > 0.2:
        raise ScenarioError(
            f"zone: axes {zone.axes!r} turn by {math.degrees(angle):.0f} degrees against the body while it stands; "
            f"at most {math.degrees(0.4 * _MOST_MOMENTS):.0f} are followed. Give it start and until"
        )
    rotations = np.asarray(_followed(around.motion, zone.axes, as_float64(period), scenario.steps))
    stands = [*range(first, max(last, first + 1), each)]
    middles = [min(step + each // 2, scenario.steps) for step in stands]
    until = [(step + each) * period for step in stands[:-1]] + [end]
    return Turning(rotations[middles], np.array(until), turned)


@eqx.filter_jit
def _followed(motion: RelativeMotion, axes: str, period: Scalar, steps: int) -> Float[Array, "moments 3 3"]:
    """Give the axes ← body rotations at the start and after each step, by the flight's own model of the target."""

    def here(state: MotionState) -> Float[Array, "3 3"]:
        vvlh_from_body = rotation.matrix(state.attitude).T
        if axes == "vvlh":
            return vvlh_from_body
        orbit = state.target_orbit
        moved = motion.orbit.inertial_state(state.time) if orbit is None else (orbit[:3], orbit[3:])
        return rotation.vvlh_axes(*moved).T @ vvlh_from_body

    return motion.of_target(here, motion.initial_state(jnp.zeros(3), jnp.zeros(3)), period, steps)


def zone_shape(zone: ZoneEntry) -> shapes.Shape:
    """Give the shape of a zone, in its own axes."""
    if zone.file is not None:
        return _shape_of(mesh_of(zone, "zone"))
    return getattr(shapes, zone.shape.capitalize())(**_parts(zone))


@functools.lru_cache(maxsize=16)
def _shape_of(mesh: Hulls) -> shapes.Mesh:
    """Give a mesh's planes, the same arrays each time: flights of one program share them."""
    most = max(len(hull.offsets) for hull in mesh.parts)
    rows = [np.arange(most) % len(hull.offsets) for hull in mesh.parts]  # as many planes for each, some twice
    numbers = [(hull.normals[row], hull.offsets[row]) for hull, row in zip(mesh.parts, rows, strict=True)]
    return shapes.Mesh(*(np.stack(column) for column in zip(*numbers, strict=True)))


def corridor_shape(corridor: CorridorEntry) -> shapes.Beside:
    """Give the room beside a corridor, within its length of the port."""
    shared: dict[str, Any] = {"port": corridor.port, "axis": unit(corridor.axis), "length": corridor.length}
    if corridor.half_angle is not None:
        behind = (corridor.radius or 0.0) / math.tan(corridor.half_angle)
        apex = np.asarray(corridor.port) - behind * shared["axis"]
        return shapes.BesideCone(**shared, apex=apex, half_angle=corridor.half_angle)
    return shapes.BesideTube(**shared, radius=corridor.radius or 0.0)


def regions(around: Surroundings) -> list[Region]:
    """Give a scenario's zones and corridors as the audit judges them, with shapes of its own."""
    found = zones_judged(around)
    for number, entry in enumerate(around.scenario.corridor):
        walls = {"half_angle": entry.half_angle, "radius": entry.radius}
        beside = judged.beside(np.asarray(entry.port), unit(entry.axis), entry.length, **walls)
        found.append(Region(named("corridor", entry, number), beside, 0.0, np.eye(3)[None]))
    return found


def zones_judged(around: Surroundings) -> list[Region]:
    """Give a scenario's zones as the audit judges them, their rotations those at each control step."""
    scenario, found = around.scenario, []
    for number, entry in enumerate(scenario.zone):
        rotations = np.eye(3)[None]
        if entry.axes != "body":
            rotations = np.asarray(
                _followed(around.motion, entry.axes, as_float64(scenario.control.period), scenario.steps)
            )
        if entry.file is None:
            distance = getattr(judged, entry.shape)(**_parts(entry))
        else:
            distance = judged.mesh(mesh_of(entry, named("zone", entry, number)))
        found.append(
            Region(
                name=named("zone", entry, number),
                distance=distance,
                radius=scenario.chaser.radius,
                rotations=rotations,
                rate=around.turning_rate(entry.axes),
                start=entry.start,
                until=ends(scenario, entry),
            )
        )
    return found


def _parts(zone: ZoneEntry) -> dict[str, Any]:
    """Give the numbers that a zone's shape is made of, as arrays where they are vectors, an axis at length 1."""
    parts = {name: getattr(zone, name) for name in SHAPES[zone.shape]}
    if "axis" in parts:
        parts["axis"] = unit(parts["axis"])
    return {name: np.asarray(part) if isinstance(part, tuple) else part for name, part in parts.items()}


def unit(axis: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Give a vector at length 1."""
    return np.asarray(axis) / np.linalg.norm(axis)


def standing_zone(around: Surroundings, zone: ZoneEntry, shift: float) -> Zone | SweptCone:
    """Give a zone as law and guard ask it, with a `shift` (m) added to its distance."""
    swept = _swept(around, zone, shift)
    if swept is not None:
        return swept
    way = turning(around, zone)
    planes = 0 if zone.file is None else mesh_of(zone, "zone").planes
    if len(way.rotations) * planes > _MOST_PLANES:
        raise ScenarioError(
            f"zone: file {zone.file}: it turns, so that its {planes} planes count at {len(way.rotations)} moments, and "
            f"at most {_MOST_PLANES} planes are flown; give a simpler mesh, or start and until"
        )
    return Zone(zone_shape(zone), way.rotations, way.ends, way.turned, shift, by_word=zone.until == "go")


def _swept(around: Surroundings, zone: ZoneEntry, shift: float) -> SweptCone | None:
    """Give a cone that turns at the origin about the orbit's normal; None for any other zone.

    The frame's turning about one axis is not assumed but found: the axis of the cone, followed from step to step, must
    be where a turn about the normal puts it.
    """
    scenario = around.scenario
    if zone.shape != "cone" or any(zone.centre or ()) or not around.turning_rate(zone.axes):
        return None
    period, last = scenario.control.period, ends(scenario, zone)
    rotations = np.asarray(_followed(around.motion, zone.axes, as_float64(period), scenario.steps))
    axes = np.einsum("kij,i->kj", rotations, unit(zone.axis or ()))
    about = np.array([0.0, 1.0 if zone.axes == "inertial" else -1.0, 0.0])
    level = axes @ about
    angles = np.unwrap(np.arctan2(axes @ np.cross(about, axes[0]), (axes - level[:, None] * about) @ axes[0]))
    turned = level[:1, None] * about + np.outer(np.cos(angles), axes[0] - level[0] * about)
    turned += np.outer(np.sin(angles), np.cross(about, axes[0]))
    if np.abs(turned - axes).max() > 1e-9 or np.any(np.diff(angles) < 0.0):
        return None
    stood = angles[: min(scenario.steps, math.ceil(min(last, 2.0 * scenario.duration) / period)) + 1]
    stood[: math.floor(zone.start / period)] = stood[min(math.floor(zone.start / period), len(stood) - 1)]
    cone = shapes.Cone(np.zeros(3), axes[0], zone.half_angle, zone.length)  # pyright: ignore[reportArgumentType]
    return SweptCone(cone, about, stood, period, last, shift, by_word=zone.until == "go")


def zoned(around: Surroundings, field: Field, threshold: float) -> Field:
    """Put a scenario's zones and corridors into a field, so that each is entered where the field is its threshold.

    Of a zone that is when the chaser's ball touches it, of a corridor's wall when the chaser's centre does. In
    room that a corridor declares clear the field counts as above its threshold: `require_clear` has proved it.

    Args:
        around: the scenario's surroundings.
        field: a law's or a guard's.
        threshold: the value of that field, m, at and below which the chaser may touch the mesh.

    """
    scenario = around.scenario
    shift = threshold - scenario.chaser.radius
    zones: list[Zone | SweptCone] = [standing_zone(around, entry, shift) for entry in scenario.zone]
    zones += [Zone(corridor_shape(entry), np.eye(3)[None], [math.inf], 0.0, threshold) for entry in scenario.corridor]
    clear = tuple(
        ClearRoom(corridor_shape(entry), entry.clear_from, threshold)
        for entry in scenario.corridor
        if entry.clear_from is not None
    )
    return ZonedField(field, tuple(zones), clear) if zones else field


def require_clear(beside: shapes.Beside, clear_from: float, distance: Distance, needed: float, name: str) -> None:
    """Prove that the room which a corridor declares clear is nowhere nearer to the mesh than it must be.

    Cubes over the room are halved until each is outside of it, or has a centre so far from the mesh that all of it is
    far enough: depth in the room and distance are 1-Lipschitz.

    Args:
        beside: of the corridor.
        clear_from: where the room begins, m along the axis from the port.
        distance: exact, to the mesh.
        needed: how far from the mesh it must be, m.
        name: of the corridor, in refusals.

    Raises:
        ScenarioError: it is not so, or by too little to be proved; with both distances and where.

    """
    depth = jax.jit(jax.vmap(lambda point: beside.depth(point, as_float64(clear_from))))
    half, centres = float(beside.length), np.asarray(beside.port)[None]
    while len(centres):
        reach, room = SQRT3 * half, in_pieces(depth, centres)
        centres, room = centres[room > -reach], room[room > -reach]
        away = distance.distance(centres)
        near = away - reach <= needed
        refuted = near & (away < needed) & (room > 0.0)
        if refuted.any() or (half < _FINEST and near.any()):
            worst = np.flatnonzero(refuted if refuted.any() else near)
            worst = worst[np.argmin(away[worst])]
            raise ScenarioError(
                f"{name}: clear_from {clear_from:g} m, but the mesh is {away[worst]:.4g} m from "
                f"{np.round(centres[worst], 3).tolist()} m, and it must be {needed:g} m and a few millimetres from all "
                "that is declared clear; begin farther from the port, or make the corridor narrower"
            )
        if near.sum() > _MOST_CUBES:
            raise ScenarioError(
                f"{name}: clear_from {clear_from:g} m: whether the mesh is {needed:g} m away is open in more than "
                f"{_MOST_CUBES} cubes of {2000.0 * half:.0f} mm; begin farther out, or make the corridor narrower"
            )
        centres = (centres[near][:, None] + 0.5 * half * CORNERS).reshape(-1, 3)
        half *= 0.5

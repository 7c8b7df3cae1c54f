"""Legs, zones, corridors and the rule of speeds as pages draw them: bodies for the replay, lines for the plots."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from scipy.linalg import null_space
from scipy.spatial import ConvexHull

from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.hulls import hulls_of
from keepout.core.mission.flight import allowed_speed
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.task_entries import CorridorEntry, LegEntry, ZoneEntry
from keepout.core.mission.zones import ends, unit

_ARC = 16
"""Pieces of a half or a part of a circle in a body's outline."""
_ROUND = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
_COLOURS = {"zone": "#d62728", "corridor": "#2ca02c"}
STILL = "Red: zones, green: corridors, so far as they stand still over the target; diamonds: hold points."
"""What `paint_bodies` shows, in words."""


def label(kind: str, entry: LegEntry | ZoneEntry | CorridorEntry, number: int) -> str:
    """Give what a drawing calls an entry of a list: its name, or its kind and number from 0."""
    return entry.name or f"{kind} {number}"


def leg_labels(scenario: Scenario, record: FlightRecord) -> list[str]:
    """Give the names of a flight's legs; none where its law flew none."""
    return [] if record.leg is None else [label("leg", leg, number) for number, leg in enumerate(scenario.leg)]


def places(scenario: Scenario, record: FlightRecord) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows"]]:
    """Give where the chaser is led to at each row, m in the body frame, and within what it counts as there, m.

    That is the place of the leg under way; of a flight without legs it is the goal.
    """
    legs = [scenario.goal] if record.leg is None else scenario.leg
    rows = np.zeros(len(record.time), int) if record.leg is None else record.leg
    return np.array([leg.position for leg in legs])[rows], np.array([leg.tolerance for leg in legs])[rows]


def distance_left(scenario: Scenario, record: FlightRecord) -> Float[np.ndarray, "rows"]:
    """Give the distance, m, to the place of `places` at each row."""
    return np.linalg.norm(record.position - places(scenario, record)[0], axis=1)


def paint_legs(axes: Axes, time: Float[np.ndarray, "rows"], scenario: Scenario, record: FlightRecord) -> None:
    """Add a thin vertical line where a leg begins, its name before it; `time` is that of the axis, s."""
    for number, name in enumerate(leg_labels(scenario, record)):
        begun = np.flatnonzero(record.leg == number)
        if begun.size:
            axes.axvline(float(time[begun[0]]), color="grey", linewidth=0.6, zorder=0.5)
            at = {"xytext": (-2, -2), "textcoords": "offset points", "xycoords": ("data", "axes fraction")}
            look = {"rotation": 90, "va": "top", "ha": "right", "fontsize": 6, "color": "dimgrey"}
            # On its left the chaser is at rest in the place before, so that no curve is there.
            axes.annotate(name, (time[begun[0]], 1.0), **at, **look)


def paint_rules(
    axes: Axes,
    time: Float[np.ndarray, "rows"],
    scenario: Scenario,
    record: FlightRecord,
    clearance: Float[np.ndarray, "rows"],
) -> None:
    """Add the legs, and the largest speed that the rule of speeds allows, to a panel of the speed.

    Args:
        axes: the panel.
        time: of its axis, s.
        scenario: with legs and rule, or without.
        record: as flown.
        clearance: at its rows, m.

    """
    if scenario.approach.speed_by_distance:
        allowed = allowed_speed(scenario, record.position, clearance)
        axes.plot(time, allowed, color="black", linewidth=0.9, linestyle=":", label="allowed")
    paint_legs(axes, time, scenario, record)


def paint_bodies(axes: Axes, scenario: Scenario, eye: Float[np.ndarray, "3 3"]) -> None:
    """Add zones, corridors and hold points to a panel with paths around a target, which keeps its limits.

    Args:
        axes: the panel.
        scenario: with legs, zones and corridors, or without; a zone that moves over the target is left out.
        eye: its axes as rows.

    """
    approach = told(scenario, 0.0)
    limits = axes.get_xlim(), axes.get_ylim()
    still = {"body", "vvlh"} if scenario.attitude.kind == "vvlh" else {"body"}
    for body in approach["bodies"]:
        if body["axes"] in still:
            flat, colour = (_outline(body) @ eye.T)[:, :2], _COLOURS[body["kind"]]
            around = flat[ConvexHull(flat).vertices].T
            axes.fill(*around, facecolor=colour, alpha=0.09, linewidth=0.0, zorder=0.4)
            axes.fill(*around, fill=False, edgecolor=colour, linewidth=0.6)
    holds = np.array([hold["position"] for hold in approach["holds"][:-1]]).reshape(-1, 3) @ eye.T
    axes.plot(*holds[:, :2].T, color="black", marker="D", markersize=4, linestyle="")
    axes.set(xlim=limits[0], ylim=limits[1])


def _outline(body: Mapping[str, Any]) -> Float[np.ndarray, "places 3"]:
    """Give places, body frame, m, of which a body of `told` is the convex hull, or nearly."""
    if "profile" in body:
        across, along = np.array(body["profile"]).T
        flat = np.stack([np.outer(across, np.cos(_ROUND)), np.outer(across, np.sin(_ROUND))], axis=-1)
        around = null_space(np.array([body["axis"]])).T
        return (flat @ around + along[:, None, None] * np.array(body["axis"])).reshape(-1, 3) + body["at"]
    if "corners" in body:
        return np.array(body["corners"]) + body["at"]
    if "size" in body:
        corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
        return corners * body["size"] + body["at"]
    up = np.sin(np.linspace(-0.5, 0.5, len(_ROUND) // 2 + 1) * math.pi)
    across = np.sqrt(1.0 - up**2)
    ball = [np.outer(across, np.cos(_ROUND)), np.outer(across, np.sin(_ROUND)), np.outer(up, np.ones(len(_ROUND)))]
    return np.stack(ball, axis=-1).reshape(-1, 3) * body["semi_axes"] + body["at"]


def told(scenario: Scenario, start: float) -> dict[str, Any]:
    """Give legs, zones and corridors as the replay's page holds them.

    A body is round about an `axis` from `at`, where it has a `profile` of [distance from the axis, distance along it];
    else an ellipsoid or a box about `at`, of half these `semi_axes` or of this `size`, or triangles, `faces` between
    `corners`. It is told in `axes`.

    Args:
        scenario: of the flight.
        start: of the flight, s; times count from it.

    Returns:
        `bodies` and `holds`, lengths in m, times in s; `until` None: to the end.

    """
    bodies: list[dict[str, Any]] = []
    for number, zone in enumerate(scenario.zone):
        until = ends(scenario, zone)
        times = {"start": zone.start - start, "until": until - start if math.isfinite(until) else None}
        bodies.append({"kind": "zone", "name": label("zone", zone, number), "axes": zone.axes, **times, **_zone(zone)})
    for number, corridor in enumerate(scenario.corridor):
        wall = {"at": list(corridor.port), "axis": unit(corridor.axis).tolist(), "profile": _wall(corridor)}
        times = {"axes": "body", "start": 0.0, "until": None}
        bodies.append({"kind": "corridor", "name": label("corridor", corridor, number), **times, **wall})
    holds = [
        {"name": label("leg", leg, number), "position": list(leg.position)} for number, leg in enumerate(scenario.leg)
    ]
    return {"bodies": bodies, "holds": holds}


def _zone(zone: ZoneEntry) -> dict[str, Any]:
    """Give the form of a zone."""
    if zone.file is not None:
        corners, faces = hulls_of(zone.file, zone.units).surface
        return {"at": [0.0, 0.0, 0.0], "corners": corners.round(4).tolist(), "faces": faces.tolist()}
    if zone.lower is not None and zone.upper is not None:
        lower, upper = np.array(zone.lower), np.array(zone.upper)
        return {"at": (0.5 * (lower + upper)).tolist(), "size": (upper - lower).tolist()}
    at = {"at": list(zone.centre or ())}
    if zone.axis is None:
        return at | {"semi_axes": list(zone.semi_axes or 3 * (zone.radius,))}
    length = zone.length or 0.0
    if zone.half_angle is None:
        rim = [[zone.radius, 0.0], [zone.radius, length]]
        outline = [[0.0, 0.0], *_sharp(rim), [0.0, length]]
    else:
        angles = np.linspace(zone.half_angle, 0.0, _ARC + 1)
        rim, *cap = (length * np.column_stack([np.sin(angles), np.cos(angles)])).round(4).tolist()
        outline = [[0.0, 0.0], *_sharp([rim]), *cap]
    return at | {"axis": unit(zone.axis).tolist(), "profile": outline}


def _sharp(corners: Sequence[list[float]]) -> list[list[float]]:
    """Give each corner twice: the viewer smooths an outline at the points it has once."""
    return [corner for corner in corners for _ in range(2)]


def _wall(corridor: CorridorEntry) -> list[list[float]]:
    """Give the outline of a corridor's wall, from the port to `length` away from it."""
    slope = 0.0 if corridor.half_angle is None else math.tan(corridor.half_angle)
    width, length = corridor.radius or 0.0, corridor.length
    # The place t along the axis with t² + (width + slope t)² = length².
    under = (width * slope) ** 2 - (1.0 + slope**2) * (width**2 - length**2)
    along = (math.sqrt(max(under, 0.0)) - width * slope) / (1.0 + slope**2)
    return [[width, 0.0], [width + slope * along, along]]

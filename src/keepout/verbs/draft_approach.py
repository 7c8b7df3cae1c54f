"""An approach drafted for a target: hold points on a line to a port, a keep-out sphere, a corridor, speeds."""

import itertools
import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from keepout.core.errors import ScenarioError

if TYPE_CHECKING:
    from keepout.core.geometry.target import Target

_AWAY = (2.0, 10.0, 40.0)
"""Of the hold points from the port, beside the chaser's radius and the margin, m; the last outside the sphere."""
_DWELL = 60.0
_HALF_ANGLE, _WIDTH = 0.17, 0.8
"""Of the corridor's cone, rad, and its radius at the port, m."""
_TOUCHES = 1e-3


def approach_to(target: "Target", chaser_radius: float, margin: float, speed: float) -> tuple[dict[str, Any], str]:
    """Draft an approach along the axis of the body frame that leads most freely to the target.

    Args:
        target: the mesh.
        chaser_radius: m.
        margin: the operator's, m.
        speed: the chaser's limit, m/s.

    Returns:
        Entries by dotted name, and the tables of legs, zones and corridors as TOML.

    Raises:
        ScenarioError: no axis leads to the target with room beside it.

    """
    lower, upper = target.distance.lower, target.distance.upper
    centre, half = 0.5 * (lower + upper), 0.5 * float(np.linalg.norm(upper - lower))
    away = [chaser_radius + margin + more for more in _AWAY]
    sphere = math.ceil(half + 10.0)
    port, axis = _freest(target, centre, away)
    # Where the line to the port leaves the sphere, with room.
    along = float((port - centre) @ axis)
    across = float(np.linalg.norm(port - centre - along * axis))
    away[-1] = max(away[-1], math.sqrt(sphere**2 - across**2) - along + chaser_radius + 5.0)
    places = [np.round(port + distance * axis, 2).tolist() for distance in reversed(away)]
    start = np.round(port + (away[-1] + 10.0) * axis + 4.0 * np.roll(axis, 1), 2).tolist()
    slowest = 0.2 * speed
    rule = [[round(away[-1], 1), speed], [round(away[1], 1), 0.5 * speed], [round(away[0], 1), slowest]]
    times = [10.0 / speed, (away[-1] - away[1]) / (0.6 * speed), (away[1] - away[0]) / (0.3 * speed)]
    go = 10.0 * math.ceil((times[0] + _DWELL + 60.0) / 10.0)
    duration = 100.0 * math.ceil((go + 1.4 * sum(times) + 3.0 * _DWELL + 200.0) / 100.0)
    names = [f"{distance:.0f} m" for distance in reversed(away[1:])] + ["capture"]
    legs: list[dict[str, Any]] = [
        {"name": name, "position": place, "tolerance": tolerance, "dwell": _DWELL}
        for name, place, tolerance in zip(names, places, (0.5, 0.4, 0.2), strict=True)
    ]
    legs[0] |= {"until": "go", "go_at": go}
    zone = {"name": "keep-out sphere", "shape": "sphere", "centre": np.round(centre, 2).tolist(), "radius": sphere}
    corridor = {"name": "port", "port": np.round(port, 3).tolist(), "axis": (axis + 0.0).tolist()}
    corridor |= {"length": round(2.0 * away[1], 1), "half_angle": _HALF_ANGLE, "radius": _WIDTH}
    values = {
        "start.position": tuple(start),
        "goal.position": tuple(places[-1]),
        "goal.tolerance": legs[-1]["tolerance"],
        "duration": duration,
        "approach.speed_by_distance": rule,
        "approach.distance_to": tuple(corridor["port"]),
    }
    parts = ["# Hold points; the last is the goal.", *(_table("leg", leg) for leg in legs)]
    parts += ['# Nobody enters before "go".', _table("zone", zone | {"until": "go"})]
    parts += ["# Near the port the chaser's centre stays in this cone.", _table("corridor", corridor)]
    return values, "\n" + "\n".join(parts)


def _freest(target: "Target", centre: np.ndarray, away: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Give the port, m, and the unit vector outwards, of the axis with most room beside the hold points."""
    found: tuple[float, np.ndarray, np.ndarray] | None = None
    far = float(np.linalg.norm(target.distance.upper - target.distance.lower)) + 1.0
    for axis in (sign * one for sign, one in itertools.product((1.0, -1.0), np.eye(3))):
        along = far
        while along > -far:
            step = float(target.distance.distance((centre + along * axis)[None])[0])
            if step < _TOUCHES:
                break
            along -= step
        else:
            continue
        port = centre + along * axis
        points = port + np.array(away)[:, None] * axis
        room = float(np.min(target.distance.distance(points) / np.array(away)))
        if found is None or room > found[0]:
            found = room, port, axis
    if found is None or found[0] < 0.6:
        raise ScenarioError(
            f"{target.name}: no axis of its body frame leads to its surface with room beside it; write legs and "
            "corridor by hand, as in examples/approach.toml"
        )
    return found[1], found[2]


def _table(name: str, entries: Mapping[str, Any]) -> str:
    return "\n".join([f"[[{name}]]", *(f"{key} = {json.dumps(value)}" for key, value in entries.items()), ""])

"""A recorded flight as CZML, the scene description of Cesium: target and chaser about the Earth, with their paths.

Positions are inertial, to be interpolated by CZML's Hermite polynomials from positions and velocities. An orientation
in CZML is against the Earth-fixed axes, which are given well enough to look at: the Earth rotation angle and the
precession of the pole of the IAU 2000/2006 conventions (IERS Conventions 2010, chapter 5). Nutation, polar motion and
UT1 − UTC are left out: less than 40 arc seconds together.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from keepout.core.errors import ExchangeError
from keepout.core.mission.epoch import format_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.whole_file import write_whole
from keepout.flights.exchange.ephemeris import without_jumps
from keepout.flights.exchange.flight_files import FRAME, InertialFlight

_J2000 = 946_728_000_000_000_000
"""2000-01-01T12:00, ns since 1970."""
_DAY = 86_400 * 1_000_000_000
_ARC_SECOND = np.pi / 648_000.0
COLOURS = {"target": [200, 205, 215, 255], "chaser": [240, 140, 40, 255]}


def export_czml(flight: InertialFlight, scenario: Scenario, path: Path) -> dict[str, Any]:
    """Write a flight as CZML; its summary says what stands in it.

    Raises:
        ExchangeError: the file cannot be written.

    """
    times = [format_instant(int(epoch)) + "Z" for epoch in flight.epochs]
    span = f"{times[0]}/{times[-1]}"
    said = (
        f"A flight of Keepout: scenario {scenario.name}, epoch {scenario.epoch}. Positions in metres, {FRAME} axes, of "
        "the target's centre of mass and the chaser's centre; orientation of the target's body axes."
    )
    ticking = {"multiplier": 10.0, "range": "LOOP_STOP", "step": "SYSTEM_CLOCK_MULTIPLIER"}
    clock = {"currentTime": times[0], **ticking, "interval": span}
    packets = [{"id": "document", "name": scenario.name, "description": said, "version": "1.0", "clock": clock}]
    packets += [
        {
            "id": name,
            "name": f"{scenario.name}: {name}",
            "availability": span,
            **_shown(flight, scenario, name, times[0]),
        }
        for name in COLOURS
    ]
    text = json.dumps(packets, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    write_whole(path, text + "\n", refusal=ExchangeError)
    return {"frame": FRAME, "start_time": times[0], "stop_time": times[-1], "rows": len(times)}


def _shown(flight: InertialFlight, scenario: Scenario, name: str, epoch: str) -> dict[str, Any]:
    """Give what is shown of target or chaser: its way, a point and a name, and how it is turned or how large it is."""
    seconds = (flight.epochs - flight.epochs[0]) / 1e9
    states = np.concatenate([getattr(flight, f"{name}_position"), getattr(flight, f"{name}_velocity")], axis=1)
    colour = {"rgba": COLOURS[name]}
    hermite = {"epoch": epoch, "interpolationAlgorithm": "HERMITE", "interpolationDegree": 3}
    shown = {
        "position": {**hermite, "referenceFrame": "INERTIAL", "cartesianVelocity": _sampled(seconds, states)},
        "label": {"show": True, "text": name, "fillColor": colour},
        "path": {
            "width": 1.5,
            "resolution": max(float(seconds[-1]) / 500.0, 1.0),
            "material": {"solidColor": {"color": colour}},
        },
        "point": {"pixelSize": 6.0, "color": colour},
    }
    if name == "chaser":
        glass = {"solidColor": {"color": {"rgba": [*COLOURS[name][:3], 160]}}}
        return shown | {"ellipsoid": {"radii": {"cartesian": [scenario.chaser.radius] * 3}, "material": glass}}
    # CZML's quaternion takes body components to Earth-fixed ones.
    turn = earth_from_inertial(flight.epochs) @ np.swapaxes(flight.turn, 1, 2)
    turned = _sampled(seconds, without_jumps(Rotation.from_matrix(turn).as_quat()))
    linear = {"epoch": epoch, "interpolationAlgorithm": "LINEAR", "interpolationDegree": 1}
    return shown | {"orientation": {**linear, "unitQuaternion": turned}}


def _sampled(seconds: Float[np.ndarray, "n"], values: Float[np.ndarray, "n columns"]) -> list[float | None]:
    """Give [t, v, …, t, v, …] as CZML wants it; None where it is not a number."""
    row = np.concatenate([seconds[:, None], values], axis=1).ravel().tolist()
    return [number if math.isfinite(number) else None for number in row]


def earth_from_inertial(epochs: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
    """Give the rotations Earth-fixed ← EME2000 at UTC instants (ns since 1970)."""
    since = epochs - _J2000
    # Whole days are no turns of the angle's first term: taken off before floating point.
    turns = 0.7790572732640 + (since % _DAY) / _DAY + 0.00273781191135448 * (since / _DAY)
    centuries = since / _DAY / 36525.0
    x = (2004.191898 * centuries - 0.4297829 * centuries**2) * _ARC_SECOND
    y = (-0.006951 - 0.025896 * centuries - 22.4072747 * centuries**2) * _ARC_SECOND
    # The rotation that takes the pole (X, Y, Z) to z by the shortest way, and then the Earth's own turn.
    pole = np.stack([x, y, np.sqrt(1.0 - x**2 - y**2)], axis=1)
    a = 1.0 / (1.0 + pole[:, 2])
    to_pole = np.stack(
        [
            np.stack([1.0 - a * x * x, -a * x * y, -x], axis=1),
            np.stack([-a * x * y, 1.0 - a * y * y, -y], axis=1),
            pole,
        ],
        axis=1,
    )
    return Rotation.from_rotvec(np.multiply.outer(-2.0 * np.pi * turns, [0.0, 0.0, 1.0])).as_matrix() @ to_pole

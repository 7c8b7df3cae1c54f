"""A recorded flight as CZML, the scene description of Cesium: target and chaser about the Earth, with their paths.

Positions are inertial, to be interpolated by CZML's Hermite polynomials from positions and velocities. An orientation
in CZML is against the Earth-fixed axes, which are given well enough to look at: the Earth rotation angle and the
precession of the pole of the IAU 2000/2006 conventions (IERS Conventions 2010, chapter 5). Nutation, polar motion and
UT1 − UTC are left out: less than 40 arc seconds together.
"""

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
        ExchangeError: `czml3` is missing, or the file cannot be written.

    """
    try:
        from czml3 import CZML_VERSION, Document, Packet, enums, properties
        from czml3.types import TimeInterval
    except ImportError:
        raise ExchangeError("--to czml: is written with czml3; pip install 'keepout[export]'") from None
    times = [format_instant(int(epoch)) + "Z" for epoch in flight.epochs]
    span = TimeInterval(start=times[0], end=times[-1])
    said = (
        f"A flight of Keepout: scenario {scenario.name}, epoch {scenario.epoch}. Positions in metres, {FRAME} axes, of "
        "the target's centre of mass and the chaser's centre; orientation of the target's body axes."
    )
    clock = properties.Clock(
        interval=span,
        currentTime=times[0],
        multiplier=10.0,
        range=enums.ClockRanges.LOOP_STOP,
        step=enums.ClockSteps.SYSTEM_CLOCK_MULTIPLIER,
    )
    packets = [Packet(id="document", name=scenario.name, version=CZML_VERSION, description=said, clock=clock)]
    for name in COLOURS:
        shown = _shown(flight, scenario, name, times[0])
        packets.append(Packet(id=name, name=f"{scenario.name}: {name}", availability=span, **shown))
    write_whole(path, Document(packets=packets).dumps() + "\n", refusal=ExchangeError)
    return {"frame": FRAME, "start_time": times[0], "stop_time": times[-1], "rows": len(times)}


def _shown(flight: InertialFlight, scenario: Scenario, name: str, epoch: str) -> dict[str, Any]:
    """Give what is shown of target or chaser: its way, a point and a name, and how it is turned or how large it is."""
    from czml3 import enums, properties

    seconds = (flight.epochs - flight.epochs[0]) / 1e9
    states = np.concatenate([getattr(flight, f"{name}_position"), getattr(flight, f"{name}_velocity")], axis=1)
    colour = properties.Color(rgba=COLOURS[name])
    shown: dict[str, Any] = {
        "position": properties.Position(
            epoch=epoch,
            referenceFrame=enums.ReferenceFrames.INERTIAL,
            cartesianVelocity=_sampled(seconds, states),
            interpolationAlgorithm=enums.InterpolationAlgorithms.HERMITE,
            interpolationDegree=3,
        ),
        "path": properties.Path(
            width=1.5,
            resolution=max(float(seconds[-1]) / 500.0, 1.0),
            material=properties.PolylineMaterial(solidColor=properties.SolidColorMaterial(color=colour)),
        ),
        "point": properties.Point(pixelSize=6.0, color=colour),
        "label": properties.Label(text=name, show=True, fillColor=colour),
    }
    if name == "chaser":
        glass = properties.SolidColorMaterial(color=properties.Color(rgba=[*COLOURS[name][:3], 160]))
        return shown | {
            "ellipsoid": properties.Ellipsoid(
                radii=properties.EllipsoidRadii(cartesian=[scenario.chaser.radius] * 3),
                material=properties.Material(solidColor=glass),
            )
        }
    # CZML's quaternion takes body components to Earth-fixed ones.
    turn = earth_from_inertial(flight.epochs) @ np.swapaxes(flight.turn, 1, 2)
    return shown | {
        "orientation": properties.Orientation(
            epoch=epoch,
            unitQuaternion=_sampled(seconds, without_jumps(Rotation.from_matrix(turn).as_quat())),
            interpolationAlgorithm=enums.InterpolationAlgorithms.LINEAR,
            interpolationDegree=1,
        )
    }


def _sampled(seconds: Float[np.ndarray, "n"], values: Float[np.ndarray, "n columns"]) -> list[float]:
    """Give [t, v, …, t, v, …] as CZML wants it."""
    return np.concatenate([seconds[:, None], values], axis=1).ravel().tolist()


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

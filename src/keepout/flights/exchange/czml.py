"""A recorded flight as CZML, the scene description of Cesium: target and chaser about the Earth, with their paths.

Positions are inertial, to be interpolated by CZML's Hermite polynomials from positions and velocities. An orientation
in CZML is against the Earth-fixed axes, which `earth_turn` gives well enough to look at.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from keepout.core.errors import ExchangeError
from keepout.core.mission.epoch import format_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.whole_file import write_whole
from keepout.flights.exchange.earth_turn import earth_from_inertial
from keepout.flights.exchange.inertial import FRAME, InertialFlight

COLOURS = {"target": [200, 205, 215, 255], "chaser": [240, 140, 40, 255]}


def export_czml(flight: InertialFlight, scenario: Scenario, path: Path) -> dict[str, Any]:
    """Write a flight as CZML; its summary says what stands in it.

    Raises:
        ExchangeError: `czml3` is missing, or the file cannot be written.

    """
    try:
        from czml3 import CZML_VERSION, Document, Packet
        from czml3.enums import ClockRanges, ClockSteps, InterpolationAlgorithms, ReferenceFrames
        from czml3.properties import (
            Clock,
            Color,
            Ellipsoid,
            EllipsoidRadii,
            Label,
            Material,
            Orientation,
            Point,
            PolylineMaterial,
            Position,
            SolidColorMaterial,
        )
        from czml3.properties import Path as Trail
        from czml3.types import TimeInterval
    except ImportError:
        raise ExchangeError("--to czml: is written with czml3; pip install 'keepout[export]'") from None
    times = [format_instant(int(epoch)) + "Z" for epoch in flight.epochs]
    span = TimeInterval(start=times[0], end=times[-1])
    seconds = (flight.epochs - flight.epochs[0]) / 1e9

    def packet(name: str, position: np.ndarray, velocity: np.ndarray, **more: Any) -> Packet:
        colour = Color(rgba=COLOURS[name])
        return Packet(
            id=name,
            name=f"{scenario.name}: {name}",
            availability=span,
            position=Position(
                epoch=times[0],
                referenceFrame=ReferenceFrames.INERTIAL,
                cartesianVelocity=_sampled(seconds, np.concatenate([position, velocity], axis=1)),
                interpolationAlgorithm=InterpolationAlgorithms.HERMITE,
                interpolationDegree=3,
            ),
            path=Trail(
                width=1.5,
                resolution=max(float(seconds[-1]) / 500.0, 1.0),
                material=PolylineMaterial(solidColor=SolidColorMaterial(color=colour)),
            ),
            point=Point(pixelSize=6.0, color=colour),
            label=Label(text=name, show=True, fillColor=colour),
            **more,
        )

    # CZML's quaternion takes body components to Earth-fixed ones.
    turn = earth_from_inertial(flight.epochs) @ np.swapaxes(flight.turn, 1, 2)
    quaternion = Rotation.from_matrix(turn).as_quat()
    quaternion *= np.cumprod(np.append(1.0, np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0)))[
        :, None
    ]
    orientation = Orientation(
        epoch=times[0],
        unitQuaternion=_sampled(seconds, quaternion),
        interpolationAlgorithm=InterpolationAlgorithms.LINEAR,
        interpolationDegree=1,
    )
    radius = scenario.chaser.radius
    ball = Ellipsoid(
        radii=EllipsoidRadii(cartesian=[radius] * 3),
        material=Material(solidColor=SolidColorMaterial(color=Color(rgba=[*COLOURS["chaser"][:3], 160]))),
    )
    said = (
        f"A flight of Keepout: scenario {scenario.name}, epoch {scenario.epoch}. Positions in metres, {FRAME} axes, of "
        "the target's centre of mass and the chaser's centre; orientation of the target's body axes."
    )
    document = Document(
        packets=[
            Packet(
                id="document",
                name=scenario.name,
                version=CZML_VERSION,
                description=said,
                clock=Clock(
                    interval=span,
                    currentTime=times[0],
                    multiplier=10.0,
                    range=ClockRanges.LOOP_STOP,
                    step=ClockSteps.SYSTEM_CLOCK_MULTIPLIER,
                ),
            ),
            packet("target", flight.target_position, flight.target_velocity, orientation=orientation),
            packet("chaser", flight.chaser_position, flight.chaser_velocity, ellipsoid=ball),
        ]
    )
    write_whole(path, document.dumps() + "\n", refusal=ExchangeError)
    return {"frame": FRAME, "start_time": times[0], "stop_time": times[-1], "rows": len(times)}


def _sampled(seconds: Float[np.ndarray, "n"], values: Float[np.ndarray, "n columns"]) -> list[float]:
    """Give [t, v, …, t, v, …] as CZML wants it."""
    return np.concatenate([seconds[:, None], values], axis=1).ravel().tolist()

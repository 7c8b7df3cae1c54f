"""A recorded flight told in inertial axes, as CCSDS messages and CZML, and as a table whose column names end in units.

The record holds the chaser in the target's body frame. The target's orbit is the record's own where perturbations
bend it, and else the scenario's Kepler ellipse. Keepout's inertial axes are written as EME2000: a scenario's
inclination, node and perigee are read as angles in that frame.

Unlike a flight file, which Keepout reads back bit for bit, a table is for other programs: one column a component, the
UTC instant of each row first. Parquet and NPZ carry epoch, frames, units and scenario beside the columns.

CZML is the scene description of Cesium: target and chaser about the Earth, with their paths. Positions are inertial, to
be interpolated by CZML's Hermite polynomials from positions and velocities. An orientation in CZML is against the
Earth-fixed axes, which are given well enough to look at: the Earth rotation angle and the precession of the pole of the
IAU 2000/2006 conventions (IERS Conventions 2010, chapter 5). Nutation, polar motion and UT1 − UTC are left out: less
than 40 arc seconds together.
"""

import io
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from keepout.core.errors import ExchangeError
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.bounds import orbit_of
from keepout.core.mission.entries import TargetEntry
from keepout.core.mission.epoch import format_instant, leap_second_between, parse_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.rotation import matrix, vvlh_axes, without_jumps
from keepout.core.whole_file import write_whole
from keepout.flights.exchange.ephemeris import Attitude, Orbit, write_aem, write_oem

FRAME = "EME2000"
CENTRE = "EARTH"
TIME_SYSTEM = "UTC"
Craft = Literal["chaser", "target"]
BODY = "SC_BODY_1"
"""Name of the target's body frame in an attitude message."""
_OF_UNIT = {
    "s": "time",
    "m": "position estimated_position barrier backstepping_barrier field_value known_position known_position_error",
    "m2": "lyapunov",
    "mps": "velocity estimated_velocity desired_velocity safe_velocity known_velocity known_velocity_error",
    "radps": "angular_velocity",
    "N": "commanded_force guarded_force force disturbance disturbance_estimate",
    "kg": "propellant",
    "": "attitude control_status guard_status saturated target_orbit outliers contradicted leg",
}
UNITS = {name: unit for unit, names in _OF_UNIT.items() for name in names.split()}
"""The unit that ends each column's name; that of the target's orbit goes by component."""
_PARTS = {
    3: ("x", "y", "z"),
    4: ("w", "x", "y", "z"),
    6: ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
}
FRAMES = (
    "Vectors are in the target's body frame, positions from its origin; attitude is the unit quaternion body from VVLH "
    "(x along velocity, z to nadir, y against the orbit normal), scalar first; angular_velocity is inertial, in body "
    "axes; target_orbit is in EME2000. Row k's forces are held until row k + 1."
)
METADATA = "keepout"
"""Key of the metadata in a Parquet schema and an NPZ file, as JSON."""


@dataclass(frozen=True, eq=False)
class InertialFlight:
    """A flight about the Earth: EME2000 axes, metres, metres a second, UTC.

    Attributes:
        epochs: of the rows, ns since 1970-01-01 of the clock.
        target_position: of the target's centre of mass.
        target_velocity: of the same.
        chaser_position: of the chaser's centre.
        chaser_velocity: of the same.
        turn: rotations body ← EME2000.
        centre_of_mass: of the target, in the body frame, m.

    """

    epochs: Int[np.ndarray, "n"]
    target_position: Float[np.ndarray, "n 3"]
    target_velocity: Float[np.ndarray, "n 3"]
    chaser_position: Float[np.ndarray, "n 3"]
    chaser_velocity: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "n 3 3"]
    centre_of_mass: Float[np.ndarray, "3"]

    def about(self, path: Path, craft: str) -> dict[str, Any]:
        """Give what a message of chaser or target has, whatever it says of it."""
        about = {"name": f"KEEPOUT-{craft.upper()}", "centre": CENTRE, "time_system": TIME_SYSTEM}
        return {"path": path, **about, "epochs": self.epochs}


def instants(record: FlightRecord, scenario: Scenario) -> Int[np.ndarray, "n"]:
    """Give the UTC instants of a flight's rows, ns, from its scenario's epoch and its times.

    Raises:
        ExchangeError: a leap second lies within the flight.

    """
    epochs = parse_instant(scenario.epoch) + np.round(record.time * 1e9).astype(np.int64)
    day = leap_second_between(int(epochs[0]), int(epochs[-1]))
    if day is not None:
        raise ExchangeError(
            f"epoch: {scenario.epoch}; the flight, which ends at {format_instant(int(epochs[-1]))}, holds the leap "
            f"second before {day}; an epoch from which it holds none is valid"
        )
    return epochs


def inertial_flight(record: FlightRecord, scenario: Scenario) -> InertialFlight:
    """Tell a recorded flight in inertial axes.

    Raises:
        ExchangeError: a leap second lies within the flight.

    """
    epochs = instants(record, scenario)
    if record.target_orbit is None:
        position, velocity = jax.jit(jax.vmap(orbit_of(scenario.orbit).inertial_state))(jnp.asarray(record.time))
    else:
        position, velocity = record.target_orbit[:, :3], record.target_orbit[:, 3:]
    vvlh = np.asarray(jax.jit(jax.vmap(vvlh_axes))(jnp.asarray(position), jnp.asarray(velocity)))
    turn = np.asarray(jax.jit(jax.vmap(matrix))(jnp.asarray(record.attitude))) @ vvlh
    position, velocity = np.asarray(position), np.asarray(velocity)
    centre = np.asarray(scenario.target.centre_of_mass, float)
    away = record.position - centre
    drift = record.velocity + np.cross(record.angular_velocity, away)
    return InertialFlight(
        epochs,
        position,
        velocity,
        position + np.einsum("nji,nj->ni", turn, away),
        velocity + np.einsum("nji,nj->ni", turn, drift),
        turn,
        centre,
    )


def export_orbit(flight: InertialFlight, scenario: str, path: Path, *, craft: str, xml: bool) -> dict[str, Any]:
    """Write the orbit of chaser or target as an OEM; its summary says what stands in it."""
    chaser = craft == "chaser"
    orbit = Orbit(
        **flight.about(path, craft),
        frame=FRAME,
        position=flight.chaser_position if chaser else flight.target_position,
        velocity=flight.chaser_velocity if chaser else flight.target_velocity,
    )
    of = "the chaser's centre" if chaser else "the target's centre of mass"
    write_oem(orbit, comments=_comments(flight, scenario, f"States of {of}."), xml=xml)
    return {"craft": craft, "frame": FRAME, "centre": CENTRE, **_span(flight)}


def export_attitude(
    flight: InertialFlight, scenario: str, mesh: TargetEntry, path: Path, *, xml: bool
) -> dict[str, Any]:
    """Write the target's attitude as an AEM; its summary says what stands in it."""
    quaternion = Rotation.from_matrix(np.swapaxes(flight.turn, 1, 2)).as_quat()
    attitude = Attitude(**flight.about(path, "target"), frame_a=FRAME, frame_b=BODY, quaternion=quaternion)
    said = f"{BODY} is the target's body frame, in which its mesh is given."
    if mesh.rotation is not None or mesh.origin is not None:
        said = f"{BODY} is the target's body frame: a point of its mesh file, in m, is at rotation (point - origin)."
    write_aem(attitude, comments=[*_comments(flight, scenario, said), *_placed(mesh)], xml=xml)
    return {"craft": "target", "frame_a": FRAME, "frame_b": BODY, **_span(flight)}


def _comments(flight: InertialFlight, scenario: str, said: str) -> list[str]:
    centre = _numbers(flight.centre_of_mass)
    return [f"Scenario {scenario}. {said}", f"Centre of mass in the target's body frame: {centre} m."]


def _placed(mesh: TargetEntry) -> list[str]:
    """Say how a mesh file lies in the body frame; a line each, as a line of a message is no longer than 254 letters."""
    rows = [f"Rotation, row {k + 1}: {_numbers(row)}." for k, row in enumerate(mesh.rotation or ())]
    return rows if mesh.origin is None else [*rows, f"Origin in file axes: {_numbers(mesh.origin)} m."]


def _numbers(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)


def _span(flight: InertialFlight) -> dict[str, Any]:
    return {
        "time_system": TIME_SYSTEM,
        "start_time": format_instant(int(flight.epochs[0])),
        "stop_time": format_instant(int(flight.epochs[-1])),
        "rows": len(flight.epochs),
    }


def export_table(record: FlightRecord, scenario: Scenario, path: Path, *, to: str) -> dict[str, Any]:
    """Write a flight as "csv", "parquet" or "npz"; its summary says what stands in it.

    Raises:
        ExchangeError: the file cannot be written, or a leap second lies within the flight.

    """
    columns: dict[str, np.ndarray] = {
        "utc": np.array([format_instant(int(epoch)) + "Z" for epoch in instants(record, scenario)])
    }
    for name, array in record.columns.items():
        unit = f"_{UNITS[name]}" if UNITS[name] else ""
        if array.ndim == 1:
            columns[name + unit] = array
        else:
            parts = zip(_PARTS[array.shape[1]], array.T, strict=True)
            columns |= {f"{name}_{part}{unit}": np.ascontiguousarray(values) for part, values in parts}
    told = {
        "format": "keepout-flight-table 1",
        "epoch": scenario.epoch,
        "frames": FRAMES,
        "units": "each name ends in its unit: s, m, mps (m/s), radps (rad/s), N, m2; none where there is none",
        "target_sha256": record.header.get("target_sha256", ""),
        "scenario": scenario.model_dump(mode="json"),
        "statuses": record.header.get("statuses", {}),
    }
    write_whole(path, _bytes(columns, json.dumps(told), to), refusal=ExchangeError)
    return {"rows": len(record.time), "columns": list(columns), "epoch": scenario.epoch}


def _bytes(columns: dict[str, np.ndarray], told: str, to: str) -> bytes:
    stream = io.BytesIO()
    table = pa.table(columns)
    if to == "csv":
        pyarrow.csv.write_csv(table, stream)
    elif to == "parquet":
        pq.write_table(table.replace_schema_metadata({METADATA: told}), stream, compression="zstd")
    else:
        np.savez_compressed(stream, **{METADATA: np.array(told)}, **columns)  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


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
    z = np.sqrt(1.0 - x**2 - y**2)
    a = 1.0 / (1.0 + z)
    to_pole = [[1.0 - a * x * x, -a * x * y, -x], [-a * x * y, 1.0 - a * y * y, -y], [x, y, z]]
    turned = Rotation.from_rotvec(np.multiply.outer(-2.0 * np.pi * turns, [0.0, 0.0, 1.0])).as_matrix()
    return turned @ np.ascontiguousarray(np.moveaxis(np.array(to_pole), -1, 0))

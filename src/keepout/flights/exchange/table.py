"""A recorded flight as a table whose column names end in their units: CSV, Parquet and NPZ.

Unlike a flight file, which Keepout reads back bit for bit, this is for other programs: one column a component, the
UTC instant of each row first. Parquet and NPZ carry epoch, frames, units and scenario beside the columns.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from keepout.core.errors import ExchangeError
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.epoch import format_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.whole_file import write_whole
from keepout.flights.exchange.inertial import instants

UNITS = {
    "time": "s",
    "position": "m",
    "velocity": "mps",
    "attitude": "",
    "angular_velocity": "radps",
    "estimated_position": "m",
    "estimated_velocity": "mps",
    "commanded_force": "N",
    "guarded_force": "N",
    "force": "N",
    "disturbance": "N",
    "disturbance_estimate": "N",
    "desired_velocity": "mps",
    "safe_velocity": "mps",
    "barrier": "m",
    "backstepping_barrier": "m",
    "lyapunov": "m2",
    "field_value": "m",
    "control_status": "",
    "guard_status": "",
    "saturated": "",
    "target_orbit": "",
    "propellant": "kg",
    "known_position": "m",
    "known_velocity": "mps",
    "known_position_error": "m",
    "known_velocity_error": "mps",
    "outliers": "",
    "contradicted": "",
}
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
    write_whole(path, _WRITERS[to](columns, json.dumps(told)), refusal=ExchangeError)
    return {"rows": len(record.time), "columns": list(columns), "epoch": scenario.epoch}


def _csv(columns: dict[str, np.ndarray], _: str) -> bytes:
    stream = io.BytesIO()
    pyarrow.csv.write_csv(_table(columns), stream)
    return stream.getvalue()


def _parquet(columns: dict[str, np.ndarray], told: str) -> bytes:
    stream = io.BytesIO()
    pq.write_table(_table(columns).replace_schema_metadata({METADATA: told}), stream, compression="zstd")
    return stream.getvalue()


def _npz(columns: dict[str, np.ndarray], told: str) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **{METADATA: np.array(told)}, **columns)  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def _table(columns: dict[str, np.ndarray]) -> pa.Table:
    return pa.table([pa.array(array) for array in columns.values()], names=list(columns))


_WRITERS = {"csv": _csv, "parquet": _parquet, "npz": _npz}

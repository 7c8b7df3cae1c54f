"""A flight as NumPy arrays with a header that says where it came from, and its way to disk and back."""

import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.errors import FlightError
from keepout.core.flight.loop import FlightLog
from keepout.core.flight.outcome import FlightOutcome
from keepout.core.flight.record_file import read, write

EXPLORED = "explored"
"""Header entry of a flight by a map that grew: it knew no field of its target."""
_PACKAGES = ("keepout", "jax", "jaxlib", "equinox", "numpy")


@dataclass(frozen=True, eq=False)
class FlightRecord:
    """One flight: N rows, one a control step and one at the end, and a header that JSON can hold.

    The arrays are those of `FlightLog`: same names, units and frames. `of_log` fills the header's entries `scenario`,
    `seed`, `target_sha256`, `statuses`, `final` and `versions`.

    Raises:
        FlightError: an array of the wrong shape or kind of number.

    """

    header: dict[str, Any]
    time: Float[np.ndarray, "N"]
    position: Float[np.ndarray, "N 3"]
    velocity: Float[np.ndarray, "N 3"]
    attitude: Float[np.ndarray, "N 4"]
    angular_velocity: Float[np.ndarray, "N 3"]
    estimated_position: Float[np.ndarray, "N 3"]
    estimated_velocity: Float[np.ndarray, "N 3"]
    commanded_force: Float[np.ndarray, "N 3"]
    guarded_force: Float[np.ndarray, "N 3"]
    force: Float[np.ndarray, "N 3"]
    disturbance: Float[np.ndarray, "N 3"]
    disturbance_estimate: Float[np.ndarray, "N 3"]
    desired_velocity: Float[np.ndarray, "N 3"]
    safe_velocity: Float[np.ndarray, "N 3"]
    barrier: Float[np.ndarray, "N"]
    backstepping_barrier: Float[np.ndarray, "N"]
    lyapunov: Float[np.ndarray, "N"]
    field_value: Float[np.ndarray, "N"]
    control_status: Int[np.ndarray, "N"]
    guard_status: Int[np.ndarray, "N"]
    saturated: Bool[np.ndarray, "N"]
    target_orbit: Float[np.ndarray, "N 6"] | None = None
    propellant: Float[np.ndarray, "N"] | None = None
    known_position: Float[np.ndarray, "N 3"] | None = None
    known_velocity: Float[np.ndarray, "N 3"] | None = None
    known_position_error: Float[np.ndarray, "N"] | None = None
    known_velocity_error: Float[np.ndarray, "N"] | None = None
    outliers: Int[np.ndarray, "N"] | None = None
    contradicted: Bool[np.ndarray, "N"] | None = None

    @classmethod
    def of_log(
        cls,
        log: FlightLog,
        *,
        outcome: FlightOutcome | None = None,
        scenario: str = "",
        seed: int = 0,
        target_sha256: str = "",
        statuses: Mapping[str, Mapping[int, str]] | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> "FlightRecord":
        """Record one flight.

        Args:
            log: of one flight, not of a batch.
            outcome: its summary; goes into the header as `final`, with null for what is not finite.
            scenario: the scenario's text, as it would be written to a file.
            seed: what the flight's randomness was made from.
            target_sha256: hash of the target's mesh.
            statuses: the meaning of the numbers in the status columns, by column.
            extra: further header entries, anything JSON holds.

        """
        header = {
            "scenario": scenario,
            "seed": int(seed),
            "target_sha256": target_sha256,
            "statuses": {name: {str(k): v for k, v in legend.items()} for name, legend in (statuses or {}).items()},
            "final": {} if outcome is None else plain_outcome(outcome),
            "versions": {name: _version(name) for name in _PACKAGES} | {"python": platform.python_version()},
        }
        header |= dict(extra or {})
        arrays = jax.device_get({name: getattr(log, name) for name in FlightLog.__annotations__})
        return cls(header, **{name: np.array(array) for name, array in arrays.items() if array is not None})

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The arrays by name, without those that are absent."""
        arrays = {name: getattr(self, name) for name in FlightLog.__annotations__}
        return {name: array for name, array in arrays.items() if array is not None}

    @property
    def steps(self) -> int:
        """Number of control steps flown: one less than there are rows."""
        return len(self.time) - 1

    def save(self, path: str | Path) -> Path:
        """Write the flight to `path`, which ends in `.parquet` or `.npz`, and return that path.

        The file appears under its name only when it is complete.

        Raises:
            FlightError: another ending, a header that JSON does not hold, or a place that cannot be written.

        """
        return write(Path(path), self.header, self.columns)

    @classmethod
    def load(cls, path: str | Path) -> "FlightRecord":
        """Read a flight file.

        Raises:
            FlightError: a file that is missing, damaged, truncated, foreign, or of a later format.

        """
        header, columns = read(Path(path))
        missing = [name for name in FlightLog.__annotations__ if name not in columns and name not in OPTIONAL_COLUMNS]
        if missing:
            raise FlightError(f"{path}: not a flight file: it has no column {missing[0]}")
        unknown = sorted(set(columns) - set(FlightLog.__annotations__))
        if unknown:
            raise FlightError(f"{path}: not a flight file: unknown column {unknown[0]}")
        try:
            _check(columns)
        except FlightError as error:
            raise FlightError(f"{path}: {error}") from error
        return cls(header, **columns)

    def __post_init__(self):
        _check(self.columns)


OPTIONAL_COLUMNS = (
    *("target_orbit", "propellant"),
    *("known_position", "known_velocity", "known_position_error", "known_velocity_error", "outliers", "contradicted"),
)
"""Columns of some flights."""
_VECTORS = (
    *("position", "velocity", "angular_velocity", "estimated_position", "estimated_velocity", "commanded_force"),
    *("guarded_force", "force", "disturbance", "disturbance_estimate", "desired_velocity", "safe_velocity"),
    *("known_position", "known_velocity"),
)
_SHAPES = {name: (3,) for name in _VECTORS} | {"attitude": (4,), "target_orbit": (6,)}
_KINDS = {
    "control_status": np.int32,
    "guard_status": np.int32,
    "saturated": np.bool_,
    "outliers": np.int32,
    "contradicted": np.bool_,
}


def _check(columns: Mapping[str, np.ndarray]) -> None:
    rows = np.size(columns["time"])
    for name, array in columns.items():
        shape, kind = (rows, *_SHAPES.get(name, ())), np.dtype(_KINDS.get(name, np.float64))
        if array.shape != shape or array.dtype != kind:
            raise FlightError(f"{name}: {array.dtype} of shape {array.shape}; it must be {kind} of shape {shape}")


def plain_outcome(outcome: FlightOutcome) -> dict[str, Any]:
    """Give one flight's outcome as JSON values: None for what is not finite."""

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(entry) for entry in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    names = FlightOutcome.__annotations__
    return {name: plain(np.asarray(jax.device_get(getattr(outcome, name))).tolist()) for name in names}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # run from a source tree that was never installed
        return "unknown"

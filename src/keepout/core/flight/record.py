"""Bytes of a flight file: a header and named columns, as Parquet or NPZ. No pickle; damage is always noticed.

The header is JSON: schema metadata in a Parquet file, an array of bytes in an NPZ file. A SHA-256 of the header and all
columns stands beside it, so that a file either reads back bit for bit or is refused. In a Parquet file a vector is one
column a component (`position_x`, `position_y`, `position_z`), for other programs to read without a schema.
"""

import dataclasses
import io
import json
import math
import platform
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float, Int

from keepout import __version__
from keepout.core.errors import FlightError
from keepout.core.flight.loop import FlightLog, FlightOutcome
from keepout.core.kept import digest, packed, unpacked
from keepout.core.whole_file import write_whole

FORMAT = "keepout-flight"
VERSION = 1

_HEADER = "keepout_flight"
_MOST_BYTES = 2**31
"""Of the columns of a file that is read: some four million control steps."""
_COMPONENTS = {3: ("x", "y", "z"), 4: ("w", "x", "y", "z"), 6: ("x", "y", "z", "vx", "vy", "vz")}

Columns = dict[str, np.ndarray]


def write(path: Path, header: dict[str, Any], columns: Columns) -> Path:
    """Write a header and columns to `path`, by its ending; other readers see the whole file or none.

    Raises:
        FlightError: another ending, a header that JSON does not hold, or a place that cannot be written.

    """
    encode = _encode_parquet if _is_parquet(path) else _encode_npz
    try:
        text = json.dumps(header, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise FlightError(f"{path}: the header holds something that JSON does not: {_one_line(error)}") from error
    if json.loads(text) != header:
        raise FlightError(f"{path}: the header would not read back the same; use only strings as keys, and no tuples")
    envelope = {"format": FORMAT, "version": VERSION, "sha256": _digest(text, columns), "header": text}
    write_whole(path, encode(json.dumps(envelope), columns), refusal=FlightError)
    return path


def read(path: Path) -> tuple[dict[str, Any], Columns]:
    """Read what `write` wrote.

    Raises:
        FlightError: a file that is missing, damaged, truncated, foreign, or of a later format.

    """
    decode = _decode_parquet if _is_parquet(path) else _decode_npz
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FlightError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        envelope_text, columns = decode(content)
        envelope = json.loads(envelope_text)
        version, text = envelope["version"], envelope["header"]
        foreign = envelope["format"] != FORMAT
    except Exception as error:  # damaged bytes surface as almost anything a reading library can raise
        raise FlightError(f"{path}: damaged, truncated or not a flight file ({_one_line(error)})") from error
    if foreign:
        raise FlightError(f"{path}: not a flight file")
    if version != VERSION:
        raise FlightError(f"{path}: flight format {version!r}; this version of keepout reads format {VERSION}")
    if not isinstance(text, str) or envelope.get("sha256") != _digest(text, columns):
        raise FlightError(f"{path}: damaged: its content does not match its checksum")
    return json.loads(text), columns


def _is_parquet(path: Path) -> bool:
    ending = path.suffix.lower()
    if ending not in (".parquet", ".npz"):
        raise FlightError(f"{path}: a flight file ends in .parquet or .npz")
    return ending == ".parquet"


def _digest(header: str, columns: Columns) -> str:
    named = ((f"{name} {columns[name].dtype.str} {columns[name].shape}", columns[name]) for name in sorted(columns))
    return digest(header, *chain.from_iterable(named))


def _encode_npz(envelope: str, columns: Columns) -> bytes:
    return packed({_HEADER: np.frombuffer(envelope.encode(), np.uint8), **columns}, compressed=True)


def _require_size(size: int) -> None:
    if size > _MOST_BYTES:
        raise FlightError(f"it holds {size} bytes when inflated; at most {_MOST_BYTES} are read")


def _decode_npz(content: bytes) -> tuple[str, Columns]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _require_size(sum(entry.file_size for entry in archive.infolist()))
    columns = unpacked(content)
    return columns.pop(_HEADER).tobytes().decode(), columns


def _table(columns: Columns) -> pa.Table:
    """Lay columns out as a table; a vector is a column a component."""
    names, arrays = [], []
    for name, array in columns.items():
        if array.ndim == 1:
            names.append(name)
            arrays.append(pa.array(array))
            continue
        for component, values in zip(_COMPONENTS[array.shape[1]], array.T, strict=True):
            names.append(f"{name}_{component}")
            arrays.append(pa.array(np.ascontiguousarray(values)))
    return pa.table(arrays, names=names)


def _encode_parquet(envelope: str, columns: Columns) -> bytes:
    shapes = json.dumps({name: list(array.shape[1:]) for name, array in columns.items()})
    table = _table(columns).replace_schema_metadata({_HEADER: envelope, "keepout_shapes": shapes})
    stream = io.BytesIO()
    pq.write_table(table, stream, compression="zstd", write_page_checksum=True)
    return stream.getvalue()


def _decode_parquet(content: bytes) -> tuple[str, Columns]:
    metadata = pq.read_metadata(pa.BufferReader(content))
    _require_size(8 * metadata.num_rows * metadata.num_columns)  # a column of one value takes no room in the file
    table = pq.read_table(pa.BufferReader(content), page_checksum_verification=True)
    described = table.schema.metadata or {}
    shapes = json.loads(described[b"keepout_shapes"])
    columns = {}
    for name, shape in shapes.items():
        parts = [name] if not shape else [f"{name}_{component}" for component in _COMPONENTS[shape[0]]]
        values = [table.column(part).to_numpy() for part in parts]
        columns[name] = np.stack(values, axis=1) if shape else values[0].copy()
    return described[_HEADER.encode()].decode(), columns


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text[:120] if text else type(error).__name__


EXPLORED = "explored"
"""Header entry of a flight by a map that grew: it knew no field of its target."""
_PACKAGES = ("jax", "jaxlib", "equinox", "numpy")


@dataclass(frozen=True, eq=False)
class FlightRecord:
    """One flight: N rows, one a control step and one at the end, and a header that JSON can hold.

    The arrays are those of `FlightLog`: same names and meaning; s, m, m/s, rad/s, N, kg, in the target's body axes, but
    for `attitude` (body ← VVLH, scalar first) and `target_orbit` (inertial). `of_log` fills the header's entries
    `scenario`, `seed`, `target_sha256`, `statuses`, `final` and `versions`.

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
    leg: Int[np.ndarray, "N"] | None = None

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
            "versions": {
                "keepout": __version__,
                **{name: metadata.version(name) for name in _PACKAGES},
                "python": platform.python_version(),
            },
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

    def table(self) -> pa.Table:
        """Give the columns as an Arrow table, which pandas and polars take; a vector is a column a component."""
        return _table(self.columns)

    def save(self, path: str | Path) -> Path:
        """Write the flight to `path`, which ends in `.parquet` or `.npz`, and return that path.

        The file appears under its name only when it is complete.

        Args:
            path: of the file.

        Raises:
            FlightError: another ending, a header that JSON does not hold, or a place that cannot be written.

        """
        return write(Path(path), self.header, self.columns)

    @classmethod
    def load(cls, path: str | Path) -> "FlightRecord":
        """Read a flight file.

        Args:
            path: ends in `.parquet` or `.npz`.

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


OPTIONAL_COLUMNS = tuple(field.name for field in dataclasses.fields(FlightLog) if field.default is None)
"""Columns of some flights."""


def _declared(annotation: Any) -> tuple[tuple[int, ...], np.dtype]:
    """Give the shape of a column's row and its kind of number, as `FlightLog` declares them."""
    array = get_args(annotation)[0] if get_args(annotation) else annotation
    kind = next(kind for kind in ("float64", "int32", "bool") if kind in array.dtypes)
    return tuple(int(size) for size in array.dim_str.split()[1:]), np.dtype(kind)


_DECLARED = {name: _declared(annotation) for name, annotation in FlightLog.__annotations__.items()}


def _check(columns: Mapping[str, np.ndarray]) -> None:
    rows = np.size(columns["time"])
    for name, array in columns.items():
        shape, kind = (rows, *_DECLARED[name][0]), _DECLARED[name][1]
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

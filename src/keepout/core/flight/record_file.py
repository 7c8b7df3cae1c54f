"""Bytes of a flight file: a header and named columns, as Parquet or NPZ. No pickle; damage is always noticed.

The header is JSON: schema metadata in a Parquet file, an array of bytes in an NPZ file. A SHA-256 of the header and all
columns stands beside it, so that a file either reads back bit for bit or is refused. In a Parquet file a vector is one
column a component (`position_x`, `position_y`, `position_z`), for other programs to read without a schema.
"""

import io
import json
import zipfile
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from keepout.core.digest import digest
from keepout.core.errors import FlightError
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
    stream = io.BytesIO()
    header = np.frombuffer(envelope.encode(), np.uint8)
    np.savez_compressed(stream, **{_HEADER: header}, **columns)  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def _require_size(size: int) -> None:
    if size > _MOST_BYTES:
        raise FlightError(f"it holds {size} bytes when inflated; at most {_MOST_BYTES} are read")


def _decode_npz(content: bytes) -> tuple[str, Columns]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _require_size(sum(entry.file_size for entry in archive.infolist()))
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        columns = {name: archive[name] for name in archive.files}
    return columns.pop(_HEADER).tobytes().decode(), columns


def _encode_parquet(envelope: str, columns: Columns) -> bytes:
    names, arrays = [], []
    for name, array in columns.items():
        if array.ndim == 1:
            names.append(name)
            arrays.append(pa.array(array))
            continue
        for component, values in zip(_COMPONENTS[array.shape[1]], array.T, strict=True):
            names.append(f"{name}_{component}")
            arrays.append(pa.array(np.ascontiguousarray(values)))
    shapes = json.dumps({name: list(array.shape[1:]) for name, array in columns.items()})
    table = pa.table(arrays, names=names).replace_schema_metadata({_HEADER: envelope, "keepout_shapes": shapes})
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

"""A campaign's folder: what it is, one table file a chunk, the bands beside them, and who is writing.

    campaign.json               what the campaign is (`Plan.identity`)
    bands/part-00000.npz        counts of chunk 0, written first
    flights/part-00000.parquet  its table, written whole or not at all, which says that the chunk is done
    kept/run-0000004711.parquet flights kept in full

A chunk is done where its table can be read, belongs to this campaign and names the digest of its bands. Whatever else
stands in its place is flown again.
"""

import fcntl
import json
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from keepout.core.digest import digest
from keepout.core.errors import FlightError, ScenarioError
from keepout.core.whole_file import write_whole
from keepout.flights.campaign import table
from keepout.flights.campaign.bands import Bands
from keepout.flights.campaign.chunk import ChunkResult
from keepout.flights.campaign.plan import Plan


@dataclass(frozen=True)
class Dataset:
    """The folder of one campaign.

    Attributes:
        folder: where it is.
        chunks: how many it has when complete.
        plan_sha256: digest of the plan.

    """

    folder: Path
    chunks: int
    plan_sha256: str

    @classmethod
    def begin(cls, folder: Path, plan: Plan) -> "Dataset":
        """Open the folder of a plan, made where it is not there.

        Raises:
            ScenarioError: it holds another campaign, or cannot be made a folder.

        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ScenarioError(f"{folder}: cannot be made a folder ({error.strerror}); give another folder") from None
        path = folder / "campaign.json"
        identity = plan.identity()
        if path.exists():
            differing = _differing(_read_identity(path), identity)
            if differing:
                raise ScenarioError(
                    f"{folder}: holds another campaign: {'; '.join(differing[:4])}"
                    + (f"; and {len(differing) - 4} more" if len(differing) > 4 else "")
                    + "; give another folder"
                )
        else:
            write_whole(path, json.dumps(identity, indent=1) + "\n", refusal=ScenarioError)
        return cls(folder, plan.chunks, plan.sha256)

    @classmethod
    def open(cls, folder: str | Path) -> "Dataset":
        """Open a folder to read.

        Raises:
            ScenarioError: it holds no campaign.

        """
        identity = _read_identity(Path(folder) / "campaign.json")
        runs = identity["scenario"]["campaign"]["runs"]
        return cls(Path(folder), -(-runs // identity["chunk"]), digest(json.dumps(identity, sort_keys=True)))

    @property
    def identity(self) -> dict[str, Any]:
        """What the campaign is (`Plan.identity`)."""
        return _read_identity(self.folder / "campaign.json")

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the folder while the block runs; released when the process ends, however it does.

        Raises:
            ScenarioError: another process holds it.

        """
        with open(self.folder / ".lock", "a+") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.seek(0)
                by = lock.read().strip()
                said = f" (process {by})" if by else ""
                raise ScenarioError(f"{self.folder}: another process{said} is flying this campaign") from None
            lock.truncate(0)
            lock.write(str(os.getpid()))
            lock.flush()
            yield

    def missing(self) -> list[int]:
        """Give the chunks that are not done, in order."""
        return [number for number in range(self.chunks) if self._done(number) is None]

    def write(self, result: ChunkResult) -> None:
        """Write a chunk, its bands first."""
        write_whole(self._bands(result.number), result.bands, refusal=FlightError)
        write_whole(self._table(result.number), result.table, refusal=FlightError)

    def part(self, number: int, columns: list[str] | None = None) -> pa.Table:
        """Read a chunk's table, or some of its columns.

        Raises:
            FlightError: the chunk is not done.

        """
        found = self._done(number, columns)
        if found is None:
            raise FlightError(f"{self._table(number)}: missing or damaged; start the campaign again to fly it")
        return found

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """Read the whole table, or some of its columns: one row a run, in order."""
        return pa.concat_tables(
            self.part(number, columns).replace_schema_metadata(None) for number in range(self.chunks)
        )

    def bands(self) -> Bands:
        """Add up the bands of all chunks."""
        whole = Bands.of_bytes(self._bands(0).read_bytes())
        for number in range(1, self.chunks):
            whole.add_bytes(self._bands(number).read_bytes())
        return whole

    def processors(self) -> dict[str, int]:
        """Count the chunks that each kind of processor flew: on another kind the last bits are others."""
        marks = (pq.read_schema(self._table(number)).metadata or {} for number in range(self.chunks))
        return dict(Counter(mark.get(b"processor", b"unknown").decode() for mark in marks))

    def kept(self, run: int) -> Path:
        """Where the flight file of a run is, if it is kept."""
        return self.folder / "kept" / f"run-{run:010d}.parquet"

    def _table(self, number: int) -> Path:
        return self.folder / "flights" / f"part-{number:05d}.parquet"

    def _bands(self, number: int) -> Path:
        return self.folder / "bands" / f"part-{number:05d}.npz"

    def _done(self, number: int, columns: list[str] | None = None) -> pa.Table | None:
        try:
            found = table.of_bytes(self._table(number).read_bytes(), columns)
            sketch = self._bands(number).read_bytes()
        except (OSError, FlightError):
            return None
        marks = {key.decode(): value.decode() for key, value in (found.schema.metadata or {}).items()}
        known = {"plan": self.plan_sha256, "chunk": str(number), "bands": digest(np.frombuffer(sketch, np.uint8))}
        return found if all(marks.get(key) == value for key, value in known.items()) else None


def _read_identity(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if all(isinstance(n, int) for n in (found["scenario"]["campaign"]["runs"], found["chunk"], found["batch"])):
            return found
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror}); no campaign was flown here") from None
    except (ValueError, KeyError, TypeError):
        pass  # refused below, as is one with other values
    raise ScenarioError(f"{path}: not what a campaign writes; give another folder")


def _differing(kept: Any, own: Any, name: str = "") -> list[str]:
    """Name the entries in which two trees differ, with both values."""
    if isinstance(kept, dict) and isinstance(own, dict):
        found = []
        for key in dict.fromkeys((*kept, *own)):
            within = f"{name}.{key}" if name else str(key)
            found += _differing(kept.get(key), own.get(key), within)
        return found
    if kept == own:
        return []
    return [f"{name.removeprefix('scenario.')} is {_short(kept)} there and {_short(own)} here"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."

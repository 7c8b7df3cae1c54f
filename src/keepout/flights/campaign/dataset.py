"""A campaign's folder: what it is, one table file a chunk, the bands beside them, and who is writing.

    campaign.json               what the campaign is (`Plan.identity`)
    bands/part-00000.npz        counts of chunk 0, written first
    flights/part-00000.parquet  its table, written whole or not at all, which says that the chunk is done
    kept/run-0000004711.parquet flights kept in full

A chunk is done where its table belongs to this campaign and names the digest of its bands. Who flies on reads the whole
table, and flies again what is damaged; who reports looks at its marks only, and says of damage where it meets it.
"""

import fcntl
import json
import os
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Bool, Int

from keepout.core.errors import FlightError, ScenarioError
from keepout.core.flight.record import FlightRecord
from keepout.core.kept import digest
from keepout.core.mission.scenario import COMPONENTS, Scenario
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole
from keepout.flights.campaign import table
from keepout.flights.campaign.bands import Bands
from keepout.flights.campaign.flying import ChunkResult
from keepout.flights.campaign.plan import FORMAT, Plan


@dataclass(frozen=True)
class Dataset:
    """The folder of one campaign.

    Attributes:
        folder: where it is.
        identity: what the campaign is (`Plan.identity`).
        parts: the chunks that are done, of a folder opened by `read_campaign`.

    """

    folder: Path
    identity: dict[str, Any]
    parts: tuple[int, ...] = ()

    @classmethod
    def begin(cls, folder: Path, plan: Plan) -> "Dataset":
        """Open the folder of a plan, made where it is not there.

        Raises:
            ScenarioError: it holds another campaign, or cannot be written to.

        """
        identity = plan.identity()
        if not (folder / "campaign.json").exists():
            write_whole(folder / "campaign.json", json.dumps(identity, indent=1) + "\n", refusal=ScenarioError)
        else:
            kept = entries(cls.open(folder).identity)
            differing = [
                f"{name.removeprefix('scenario.')} is {_short(one)} there and {_short(other)} here"
                for name, one, other in differences(kept, entries(identity))
            ]
            if differing:
                raise ScenarioError(
                    f"{folder}: holds another campaign: {'; '.join(differing[:4])}"
                    + (f"; and {len(differing) - 4} more" if len(differing) > 4 else "")
                    + "; give another folder, or replace it (--force)"
                )
        return cls(folder, identity)

    @classmethod
    def open(cls, folder: str | Path) -> "Dataset":
        """Open a folder.

        Raises:
            ScenarioError: it holds no campaign.

        """
        path = Path(folder) / "campaign.json"
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            if all(isinstance(n, int) for n in (found["scenario"]["campaign"]["runs"], found["chunk"], found["batch"])):
                return cls(Path(folder), found)
        except OSError as error:
            raise ScenarioError(f"{path}: cannot be read ({error.strerror}); no campaign was flown here") from None
        except (ValueError, KeyError, TypeError):
            pass  # refused below, as is one with other values
        raise ScenarioError(f"{path}: not what a campaign writes; give another folder")

    @cached_property
    def scenario(self) -> Scenario:
        """Of all runs, with its `campaign` table."""
        return Scenario.parse(self.identity["scenario"])

    @property
    def runs(self) -> int:
        """Runs of the complete campaign."""
        return self.identity["scenario"]["campaign"]["runs"]

    @property
    def chunks(self) -> int:
        """How many chunks it has when complete."""
        return -(-self.runs // self.identity["chunk"])

    @property
    def complete(self) -> bool:
        """Whether every part is done."""
        return len(self.parts) == self.chunks

    @cached_property
    def plan_sha256(self) -> str:
        """Digest of the plan."""
        return digest(json.dumps(self.identity, sort_keys=True))

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
        return [number for number in range(self.chunks) if self._whole(number) is None]

    def write(self, result: ChunkResult) -> None:
        """Write a chunk, its bands first."""
        write_whole(self._bands(result.number), result.bands, refusal=FlightError)
        write_whole(self._table(result.number), result.table, refusal=FlightError)

    def part(self, number: int, columns: list[str] | None = None) -> pa.Table:
        """Read a chunk's table, or some of its columns.

        Raises:
            FlightError: the chunk is not done.

        """
        found = self._whole(number, columns)
        if found is None:
            raise FlightError(f"{self._table(number)}: missing or damaged; start the campaign again to fly it")
        return found

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """Read the whole table, or some of its columns: one row a run, in order."""
        parts = (self.part(number, columns) for number in range(self.chunks))
        return pa.concat_tables(part.replace_schema_metadata(None) for part in parts)

    def bands(self, progress: Progress = silent) -> Bands:
        """Add up the bands of the chunks that are done; of all, where nobody looked which are.

        Raises:
            FlightError: one is damaged.

        """
        whole = Bands.empty(self.scenario.duration, self.scenario.control.period)
        numbers = self.parts or range(self.chunks)
        for place, number in enumerate(numbers):
            try:
                whole.add_bytes(self._bands(number).read_bytes())
            except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile) as error:
                said = f"damaged ({_line(error)}); start the campaign again to mend it"
                raise FlightError(f"{self._bands(number)}: {said}") from None
            progress(place / len(numbers), "bands")
        return whole

    def processors(self) -> dict[str, int]:
        """Count the chunks that each kind of processor flew: on another kind the last bits are others."""
        marks = (pq.read_schema(self._table(number)).metadata or {} for number in range(self.chunks))
        return dict(Counter(mark.get(b"processor", b"unknown").decode() for mark in marks))

    def kept(self, run: int) -> Path:
        """Where the flight file of a run is, if it is kept."""
        return self.folder / "kept" / f"run-{run:010d}.parquet"

    def keep(self, run: int, record: FlightRecord) -> None:
        """Write the flight file of a run.

        Raises:
            FlightError: it cannot be written.

        """
        self.kept(run).parent.mkdir(parents=True, exist_ok=True)
        record.save(self.kept(run))

    def kept_record(self, run: int) -> FlightRecord | None:
        """Read the flight file of a run; None where it is not kept, being written, or of another campaign."""
        try:
            record = FlightRecord.load(self.kept(run))
        except FlightError:
            return None
        return record if (record.header.get("campaign"), record.header.get("run")) == (self.plan_sha256, run) else None

    def _table(self, number: int) -> Path:
        return self.folder / "flights" / f"part-{number:05d}.parquet"

    def _bands(self, number: int) -> Path:
        return self.folder / "bands" / f"part-{number:05d}.npz"

    def _whole(self, number: int, columns: list[str] | None = None) -> pa.Table | None:
        """Read a chunk's table from its first byte to its last; None where it is not done."""
        try:
            found = table.of_bytes(self._table(number).read_bytes(), columns)
        except (OSError, FlightError):
            return None
        return found if self._is_marked(number, found.schema.metadata) else None

    def is_done(self, number: int) -> bool:
        """Whether a chunk is done, by the marks of its table alone."""
        try:
            return self._is_marked(number, pq.read_schema(self._table(number)).metadata)
        except (OSError, pa.ArrowException):
            return False

    def _is_marked(self, number: int, marks: Mapping[bytes, bytes] | None) -> bool:
        """Whether a table's marks are those of a chunk of this campaign, with the digest of its bands."""
        try:
            sketch = self._bands(number).read_bytes()
        except OSError:
            return False
        known = {"plan": self.plan_sha256, "chunk": str(number), "bands": digest(np.frombuffer(sketch, np.uint8))}
        return all((marks or {}).get(key.encode()) == value.encode() for key, value in known.items())

    # ---- the table by columns, of the parts that are done

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the table's columns.

        Raises:
            FlightError: no part is done.

        """
        return tuple(table.named_now(self._schema.names))

    @cached_property
    def _schema(self) -> pa.Schema:
        if not self.parts:
            raise FlightError(f"{self.folder}: none of its {self.chunks} parts is done; start the campaign again")
        return pq.read_schema(self._table(self.parts[0]))

    def arrays(
        self, columns: Sequence[str], *, grouped: Mapping[str, Callable[[str], str]] | None = None
    ) -> dict[str, Any]:
        """Read columns of all parts that are done, one entry a run in order.

        Args:
            columns: their names.
            grouped: of columns of text, what to make of each text before equal ones are counted as one.

        Returns:
            Numbers and truth values as float64, not a number where a run has no value; text as `Words`.

        Raises:
            FlightError: there is no such column, or a part is damaged.

        """
        absent = [name for name in columns if name not in self.names]
        if absent:
            raise FlightError(f"{self.folder}: its table has no column {absent[0]}; this version did not fly it")
        paths = [self._table(number) for number in self.parts]
        kinds = dict(zip(self.names, self._schema.types))
        text = {name for name in columns if pa.types.is_string(kinds[name])}
        try:
            for number, path in zip(self.parts, paths):
                begin, count = number * self.identity["chunk"], pq.read_metadata(path).num_rows
                end = min(begin + self.identity["chunk"], self.runs)
                if count != end - begin:
                    raise self._damaged(f"{count} rows for the runs {begin} to {end - 1}")
            whole = table.read(paths, columns, read_dictionary=list(text))
        except (OSError, pa.ArrowException) as error:
            raise self._damaged(_line(error)) from None
        return {
            name: Words.of(whole[name], (grouped or {}).get(name, str))
            if name in text
            else whole[name].cast(pa.float64()).to_numpy()
            for name in columns
        }

    def _damaged(self, said: str) -> FlightError:
        return FlightError(f"{self.folder}: damaged ({said}); start the campaign again to mend it")

    def rows(self, runs: Sequence[int], columns: Sequence[str]) -> list[dict[str, Any]]:
        """Read some runs' values of columns, `run` among them, one dictionary a run in the order of the table."""
        wanted = {run // self.identity["chunk"] for run in runs}
        found: list[dict[str, Any]] = []
        for number in self.parts:
            if number in wanted:
                part = table.read([self._table(number)], columns)
                found += part.filter(pc.field("run").isin(list(runs))).to_pylist()
        return found

    @cached_property
    def factor_columns(self) -> dict[str, tuple[str, ...]]:
        """What varies, one entry a factor, and the columns it stands in: a vector's components vary each."""
        given = self.scenario.campaign.dispersions
        found: dict[str, tuple[str, ...]] = {}
        for name in sorted(given) or ["start.position"]:
            columns = tuple(c for c in (name, *(f"{name}.{axis}" for axis in COMPONENTS)) if c in self.names)
            chosen = name in given and given[name].choice is not None
            found |= {name: columns} if chosen and columns else {column: (column,) for column in columns}
        return found

    def drawn(self, name: str, arrays: Mapping[str, Any]) -> tuple[Any, tuple[str, ...] | None]:
        """Give what was drawn for one of `factor_columns`, from `arrays` that have its columns.

        Returns:
            One entry a run; of a choice the place of the chosen value among those that follow as text, else None.

        """
        columns = [arrays[column] for column in self.factor_columns[name]]
        given = self.scenario.campaign.dispersions.get(name)
        if given is None or given.choice is None:
            return columns[0], None
        places, texts = np.zeros(len(columns[0]), np.int64), [""]
        for of in columns:  # of a vector, three
            if isinstance(of, Words):
                own, codes = np.unique(of.values, return_inverse=True)
                codes = codes[of.codes]
            else:
                levels, codes = np.unique(of, return_inverse=True)
                own = [f"{level:g}" for level in levels]
            places = places * len(own) + codes
            texts = [f"{text}, {value}" if text else str(value) for text in texts for value in own]
        used, places = np.unique(places, return_inverse=True)
        return places, tuple(texts[place] for place in used)


@dataclass(frozen=True, eq=False)
class Words:
    """A column of text: of each run the place of its text in `values`; of a run without one, that of ""."""

    codes: Int[np.ndarray, "runs"]
    values: tuple[str, ...]

    @classmethod
    def of(cls, texts: pa.ChunkedArray, group: Callable[[str], str]) -> "Words":
        """Read a column, equal ones of what `group` makes of its texts as one."""
        column: Any = texts.unify_dictionaries().combine_chunks()
        known: dict[str, int] = {}
        own = [known.setdefault(text, len(known)) for text in (*map(group, column.dictionary.to_pylist()), "")]
        return cls(np.asarray(own, np.int32)[column.indices.fill_null(len(own) - 1).to_numpy()], tuple(known))

    def __len__(self) -> int:
        """How many runs."""
        return len(self.codes)

    def equal(self, value: str) -> Bool[np.ndarray, "runs"]:
        """Which runs have a text."""
        return self.codes == (self.values.index(value) if value in self.values else -1)


def read_campaign(folder: str | Path, *, progress: Progress = silent) -> Dataset:
    """Open a campaign's folder, complete or not: a part that is missing, unfinished or foreign is left out.

    Raises:
        ScenarioError: it holds no campaign, or one of another version.

    """
    dataset = Dataset.open(folder)
    if dataset.identity.get("format") != FORMAT:
        raise ScenarioError(
            f"{folder}: campaign.json: format {dataset.identity.get('format')!r}; this version of Keepout reads "
            f"{FORMAT}"
        )
    try:
        _ = dataset.scenario
    except ScenarioError as error:
        raise ScenarioError(f"{folder}: campaign.json is of another version of Keepout ({_line(error)})") from None
    done = []
    for number in range(dataset.chunks):
        if dataset.is_done(number):
            done.append(number)
        progress((number + 1) / dataset.chunks, "looking at what is done")
    return replace(dataset, parts=tuple(done))


def entries(tree: dict[str, Any], above: str = "") -> dict[str, Any]:
    """Give a tree's leaves by dotted name."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{above}.{key}" if above else str(key)
        found |= entries(value, name) if isinstance(value, dict) else {name: value}
    return found


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Name the entries in which two trees or rows differ, with both values; None where one has none."""
    both = ((name, one.get(name), other.get(name)) for name in dict.fromkeys((*one, *other)))
    return [(name, a, b) for name, a, b in both if a != b and (a == a or b == b)]  # not a number is not a number


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."

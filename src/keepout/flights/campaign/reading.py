"""What of a campaign's folder is done, read by columns: a part that is missing, unfinished or foreign is left out."""

import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Bool, Int

from keepout.core.cores import available_cores
from keepout.core.digest import digest
from keepout.core.errors import FlightError, ScenarioError
from keepout.core.mission.scenario import COMPONENTS, Scenario
from keepout.core.progress import Progress, silent
from keepout.flights.campaign.bands import Bands
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.influence import Factor
from keepout.flights.campaign.plan import FORMAT

_THREADS = 4
"""Parts decoded at once, at most."""
_AHEAD = 64
"""Parts decoded together: what is decoded and not yet copied is these and no more."""


@dataclass(frozen=True)
class Reading:
    """The parts of a campaign that are done. Open with `read_campaign`.

    Attributes:
        folder: the campaign's.
        identity: what the campaign is (`Plan.identity`).
        scenario: of all runs, with its `campaign` table.
        parts: the tables that are done, in the order of their runs.
        sketches: their bands.
        chunks: how many parts there are when the campaign is complete.

    """

    folder: Path
    identity: dict[str, Any]
    scenario: Scenario
    parts: tuple[Path, ...]
    sketches: tuple[Path, ...]
    chunks: int

    @property
    def runs(self) -> int:
        """Runs of the complete campaign."""
        return self.scenario.campaign.runs

    @property
    def complete(self) -> bool:
        """Whether every part is done."""
        return len(self.parts) == self.chunks

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the table's columns.

        Raises:
            FlightError: no part is done.

        """
        if not self.parts:
            raise FlightError(f"{self.folder}: none of its {self.chunks} parts is done; start the campaign again")
        return tuple(pq.read_schema(self.parts[0]).names)

    def arrays(
        self, columns: Sequence[str], *, grouped: Mapping[str, Callable[[str], str]] | None = None
    ) -> dict[str, Any]:
        """Read columns of all parts that are done, one entry a run in order, without ever holding more than these.

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
        schema = pq.read_schema(self.parts[0])
        text = [name for name in columns if pa.types.is_string(schema.field(name).type)]
        known: dict[str, dict[str, int]] = {name: {} for name in text}
        rows = [self._rows_of(path) for path in self.parts]
        total = sum(last - first for first, last in rows)
        found = {name: np.empty(total, np.int32 if name in text else float) for name in columns}

        done = 0
        try:
            with ThreadPoolExecutor(min(available_cores(), _THREADS)) as pool:
                for first in range(0, len(rows), _AHEAD):
                    parts = list(pool.map(lambda path: _decoded(path, columns, text), self.parts[first:][:_AHEAD]))
                    for part, (begin, end) in zip(parts, rows[first:]):
                        if len(part) != end - begin:
                            raise self._damaged(f"{len(part)} rows for the runs {begin} to {end - 1}")
                    some = pa.concat_tables(parts).unify_dictionaries()
                    here = slice(done, done + len(some))
                    for name in columns:
                        if name in text:
                            codes = _codes(some[name].combine_chunks(), known[name], (grouped or {}).get(name, str))
                            found[name][here] = codes
                        else:
                            found[name][here] = some[name].cast(pa.float64()).to_numpy()
                    done = here.stop
        except (OSError, pa.ArrowException) as error:
            raise self._damaged(error) from None
        return {name: Words(of, tuple(known[name])) if name in text else of for name, of in found.items()}

    def _rows_of(self, part: Path) -> tuple[int, int]:
        """Give the first run of a part and the one after its last."""
        first = _number(part) * self.identity["chunk"]
        return first, min(first + self.identity["chunk"], self.runs)

    def _damaged(self, error: Exception | str) -> FlightError:
        said = " ".join(str(error).split())[:120]
        return FlightError(f"{self.folder}: damaged ({said}); start the campaign again to mend it")

    def rows(self, runs: Sequence[int], columns: Sequence[str]) -> list[dict[str, Any]]:
        """Read some runs' values of columns, `run` among them, one dictionary a run in the order of the table."""
        wanted = {run // self.identity["chunk"] for run in runs}
        found: list[dict[str, Any]] = []
        for path in self.parts:
            if _number(path) in wanted:
                part = pq.read_table(path, columns=list(columns))
                found += part.filter(pc.field("run").isin(list(runs))).to_pylist()
        return found

    def factor_columns(self) -> dict[str, tuple[str, ...]]:
        """Name what varies, one entry a factor, and the columns it stands in: a vector's components vary each."""
        given = self.scenario.campaign.dispersions
        found: dict[str, tuple[str, ...]] = {}
        for name in sorted(given) or ["start.position"]:
            columns = tuple(c for c in (name, *(f"{name}.{axis}" for axis in COMPONENTS)) if c in self.names)
            if name in given and given[name].choice is not None:
                found[name] = columns
            else:
                found |= {column: (column,) for column in columns}
        return {name: columns for name, columns in found.items() if columns}

    def factor(self, name: str, arrays: Mapping[str, Any]) -> Factor:
        """Give what was drawn for one of `factor_columns`, from `arrays` that have its columns."""
        columns = self.factor_columns()[name]
        given = self.scenario.campaign.dispersions.get(name)
        if given is None or given.choice is None:
            return Factor(name, arrays[columns[0]])
        places, texts = np.zeros(len(arrays[columns[0]]), np.int64), [""]
        for column in columns:  # of a vector, three
            of = arrays[column]
            if isinstance(of, Words):
                own, codes = list(of.values), of.codes
            else:
                levels, codes = np.unique(of, return_inverse=True)
                own = [f"{level:g}" for level in levels]
            order = np.argsort(np.argsort(own)) if isinstance(of, Words) else np.arange(len(own))
            places = places * len(own) + order[codes]
            own = sorted(own) if isinstance(of, Words) else own
            texts = [f"{text}, {value}" if text else value for text in texts for value in own]
        used, places = np.unique(places, return_inverse=True)
        return Factor(name, places, tuple(texts[place] for place in used))

    def bands(self, progress: Progress = silent) -> Bands:
        """Add up the bands of the parts that are done.

        Raises:
            FlightError: one is damaged.

        """
        whole = Bands.empty(self.scenario.duration, self.scenario.control.period)
        for place, path in enumerate(self.sketches):
            try:
                whole.add_bytes(path.read_bytes())
            except (OSError, ValueError, KeyError, IndexError, zipfile.BadZipFile) as error:
                said = " ".join(str(error).split())[:120]
                raise FlightError(f"{path}: damaged ({said}); start the campaign again to mend it") from None
            if place % _AHEAD == 0:
                progress(place / len(self.sketches), "bands")
        return whole


@dataclass(frozen=True, eq=False)
class Words:
    """A column of text: of each run the place of its text in `values`."""

    codes: Int[np.ndarray, "runs"]
    values: tuple[str, ...]

    def __len__(self) -> int:
        """How many runs."""
        return len(self.codes)

    def equal(self, value: str) -> Bool[np.ndarray, "runs"]:
        """Which runs have a text."""
        place = self.values.index(value) if value in self.values else -1
        return self.codes == place


def read_campaign(folder: str | Path, *, progress: Progress = silent) -> Reading:
    """Open a campaign's folder, whether it is complete or not.

    Raises:
        ScenarioError: it holds no campaign.

    """
    dataset = Dataset.open(folder)
    identity = dataset.identity
    if identity.get("format") != FORMAT:
        raise ScenarioError(
            f"{folder}: campaign.json: format {identity.get('format')!r}; this version of Keepout reads {FORMAT}"
        )
    try:
        scenario = Scenario.parse(identity["scenario"])
    except ScenarioError as error:
        said = " ".join(str(error).split())[:120]
        raise ScenarioError(f"{folder}: campaign.json is of another version of Keepout ({said})") from None
    parts, sketches = [], []
    found = sorted(
        (path for path in (dataset.folder / "flights").glob("part-*.parquet") if _number(path) >= 0), key=_number
    )
    for place, path in enumerate(found):
        sketch = dataset.folder / "bands" / f"{path.stem}.npz"
        if _is_done(path, sketch, dataset.plan_sha256):
            parts.append(path)
            sketches.append(sketch)
        progress((place + 1) / len(found), "looking at what is done")
    return Reading(dataset.folder, identity, scenario, tuple(parts), tuple(sketches), dataset.chunks)


def _is_done(table: Path, sketch: Path, plan_sha256: str) -> bool:
    """Whether a table is of this campaign, in its place, and names the digest of its bands; see `Dataset`."""
    try:
        marks = pq.read_schema(table).metadata or {}
        content = sketch.read_bytes()
    except (OSError, pa.ArrowException):
        return False
    known = {
        b"plan": plan_sha256,
        b"chunk": str(_number(table)),
        b"bands": digest(np.frombuffer(content, np.uint8)),
    }
    return all(marks.get(key) == value.encode() for key, value in known.items())


def _number(part: Path) -> int:
    """Give the chunk's number that a file name says, or -1."""
    digits = part.stem.removeprefix("part-")
    return int(digits) if digits.isdecimal() else -1


def _decoded(part: Path, columns: Sequence[str], text: Sequence[str]) -> pa.Table:
    with pq.ParquetFile(part, read_dictionary=text, page_checksum_verification=True, pre_buffer=False) as file:
        return file.read(columns=list(columns), use_threads=False)


def _codes(column: pa.DictionaryArray, known: dict[str, int], group: Callable[[str], str]) -> np.ndarray:
    """Give the places of a column's texts among all known ones, to which new ones are added; of none, of ""."""
    own = [known.setdefault(group(text), len(known)) for text in column.dictionary.to_pylist()]
    if column.null_count:
        own.append(known.setdefault("", len(known)))
    indices = column.indices.fill_null(len(own) - 1).to_numpy(zero_copy_only=False)
    return np.asarray(own, np.int32)[indices] if own else np.empty(0, np.int32)

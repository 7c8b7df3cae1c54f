"""What every part of a reproduction works with and hands over: a folder, a seed, cores, and what was computed before.

What it hands over are tables, figures and words, each beside what the paper states.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

import keepout
from keepout.core.cores import available_cores
from keepout.core.errors import ScenarioError
from keepout.core.kept import Form, Store, packed, unpacked
from keepout.core.mission.flight import Flight
from keepout.core.progress import Progress, never_back, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.pages.page import Table

__all__ = ["Part", "Table", "Work", "side_by_side"]

Thing = TypeVar("Thing")
MOST = 2
"""Computations at once, so that memory stays small."""
NUMBERS = Form(
    ".json",
    lambda path: json.loads(path.read_text(encoding="utf-8")),
    lambda path, made: write_whole(path, json.dumps(made, allow_nan=False) + "\n"),
)
"""Of plain JSON values."""
ARRAYS = Form(
    ".npz",
    lambda path: unpacked(path.read_bytes()),
    lambda path, made: write_whole(path, packed(made, compressed=True)),
)
"""Of arrays by name."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of the paper's Section VI, repeated.

    Attributes:
        name: as on the command line.
        title: heading on the page.
        paper: what the paper states of it, plain text.
        ours: what was found, plain text, a paragraph each.
        rows: one row a flight, field or campaign; see `named_rows`.
        tables: each becomes a CSV file and a table of the page.
        drawings: caption, plain text, of each figure by name: `<name>.png` and `<name>.svg` in the part's folder.
        flights: to be replayed on the page, all around one target.
        seconds: by the clock of the run that made it; little where an earlier run left what takes long.

    """

    name: str
    title: str
    paper: str
    ours: Sequence[str]
    rows: Sequence[dict[str, Any]]
    tables: Sequence[Table] = ()
    drawings: Mapping[str, str] = dataclasses.field(default_factory=dict)
    flights: Mapping[str, Flight] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0

    @property
    def named_rows(self) -> list[dict[str, Any]]:
        """Its rows as `--json` and `summary.json` list them among those of other parts: each with its name first."""
        return [{"experiment": self.name, **row} for row in self.rows]


@dataclasses.dataclass(frozen=True)
class Work:
    """Where a part of a reproduction works, and how much it does.

    What takes long goes through `numbers` or `arrays`: it is written into `folder / "kept"` as soon as it is there,
    under a digest of all that it was made of, so that a run that was stopped goes on, and a changed one begins anew.

    Attributes:
        folder: of this part; CSV files and figures go here.
        quick: fewer flights, shipped fields and short searches.
        seed: of every draw.
        fields: folder with fields of the paper's network fitted before, or None to fit them.
        progress: told how far the part is.

    """

    folder: Path
    quick: bool = False
    seed: int = 0
    fields: Path | None = None
    progress: Progress = silent

    def numbers(self, name: str, made_of: Any, make: Callable[[], Any]) -> Any:
        """Return what `make` gives, plain JSON values, from the file that an earlier run left where there is one.

        Args:
            name: begins the file's name.
            made_of: all that the values depend on, plain JSON values.
            make: computes them.

        """
        return self._kept(name, made_of, make, NUMBERS)

    def arrays(self, name: str, made_of: Any, make: Callable[[], Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return what `make` gives, arrays by name, from the file that an earlier run left where there is one."""
        return self._kept(name, made_of, lambda: {key: np.asarray(array) for key, array in make().items()}, ARRAYS)

    def batches(
        self, name: str, count: int, size: int, made_of: Any, make: Callable[[int, int], Mapping[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Return what `make` gives of so many things, from the first to before the last, some at a time, joined.

        Each batch is kept as `arrays` keeps it.
        """
        kept = []
        for first in range(0, count, size):
            last = min(first + size, count)
            kept.append(self.arrays(f"{name}-{first}", [made_of, first, last], functools.partial(make, first, last)))
            self.progress(last / count, f"{name}, {last} of {count}")
        return {key: np.concatenate([batch[key] for batch in kept]) for key in kept[0]}

    def within(self, start: float, end: float) -> "Work":
        """Give the same work for a stretch of its progress."""
        return dataclasses.replace(self, progress=part_of(self.progress, start, end))

    def stretches(self, things: Iterable[Thing]) -> Iterator[tuple["Work", Thing]]:
        """Give each of some things with the same work for its share of the progress, all alike."""
        every = list(things)
        for place, thing in enumerate(every):
            yield self.within(place / len(every), (place + 1) / len(every)), thing

    def _kept(self, name: str, made_of: Any, make: Callable[[], Any], form: Form) -> Any:
        key = json.dumps([keepout.__version__, made_of], sort_keys=True)
        return Store(self.folder / "kept", 16, _unread, _unkept).take(name, key, make, form)


def _unread(path: Path, error: Exception) -> NoReturn:
    raise ScenarioError(f"{path}: cannot be read ({error}); delete it to compute it anew") from None


def _unkept(path: Path, error: Exception) -> NoReturn:
    raise ScenarioError(str(error)) from None


def side_by_side(jobs: Mapping[str, Callable[[Progress], Thing]], progress: Progress) -> dict[str, Thing]:
    """Run jobs at once, as many as there are cores and at most `MOST`; the first failure stops those not begun.

    Args:
        jobs: by name; each is given its own progress.
        progress: told the mean over all jobs, with the name of the one that reports.

    """
    done = dict.fromkeys(jobs, 0.0)
    whole = never_back(progress)

    def reporter(name: str) -> Progress:
        def report(fraction: float, message: str) -> None:
            done[name] = fraction
            whole(sum(done.values()) / len(done), f"{name} {message}".rstrip())

        return never_back(report)

    def run(name: str) -> Thing:
        own = reporter(name)
        answer = jobs[name](own)
        own(1.0, "")
        return answer

    pool = ThreadPoolExecutor(min(MOST, available_cores()))
    try:
        futures = {name: pool.submit(run, name) for name in jobs}
        return {name: future.result() for name, future in futures.items()}
    finally:
        pool.shutdown(cancel_futures=True)

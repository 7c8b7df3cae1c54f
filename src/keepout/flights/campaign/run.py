"""A campaign flown into a folder: what is missing there is flown and nothing else, by whom, and which flights are kept.

What needs no cluster never imports one.
"""

import importlib.util
import re
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from threading import Lock

from keepout.core.audit.audit import Contact
from keepout.core.cores import available_cores
from keepout.core.errors import ClusterError, ScenarioError
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.flying import ChunkResult, Told, fly_chunk, least_clear, records
from keepout.flights.campaign.plan import Plan

VALID = "valid are tcp://HOST:PORT, tls://HOST:PORT, local and local:N"
_ADDRESS = re.compile(r"(?:tcp|tls)://(?:\[[0-9a-fA-F:.]+\]|[^\s/:\[\]]+):(\d{1,5})")

Flyer = Callable[[Plan, list[int], Told], Generator[ChunkResult, None, None]]
"""Flies chunks of a plan by their numbers, in any order, and gives each when it is there; tells of landed flights."""


@dataclass(frozen=True)
class Standing:
    """How far a campaign is.

    Attributes:
        runs: of the whole campaign.
        done: runs in chunks that are written, and flights that landed since.
        flown: flights that landed since this start.
        reached: of all flights that are done, how many reached their goal.
        contacts: of all flights that are done, how many the audit does not clear of a contact.
        seconds: since this start.

    """

    runs: int
    done: int
    flown: int
    reached: int
    contacts: int
    seconds: float

    @property
    def rate(self) -> float:
        """Flights a second since this start."""
        return self.flown / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def seconds_left(self) -> float | None:
        """Time left at this rate, s; None before the first flight."""
        return (self.runs - self.done) / self.rate if self.flown else None

    def line(self) -> str:
        """Say it in a line."""
        return (
            f"{self.done} of {self.runs}, {self.rate:.3g} flights/s, {self.reached} reached, {self.contacts} contacts"
        )


def in_threads(plan: Plan, numbers: list[int], told: Told) -> Generator[ChunkResult, None, None]:
    """Fly chunks in this process, each in a thread of its own, one for each core at once."""
    workers = min(available_cores(), max(len(numbers), 1))
    batches = 1 if workers > 1 else None
    pool = ThreadPoolExecutor(workers)
    try:
        for future in as_completed([pool.submit(fly_chunk, plan, n, workers=batches, told=told) for n in numbers]):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def fly_campaign(
    plan: Plan,
    dataset: Dataset,
    *,
    flyer: Flyer = in_threads,
    told: Callable[[Standing], None] = lambda standing: None,
) -> Standing:
    """Fly what is missing in a campaign's folder, each chunk written as soon as it is there.

    Stopped at any moment, by whatever means, it goes on when called again, to the same tables bit for bit.

    Args:
        plan: of the campaign.
        dataset: its folder (`Dataset.begin`), locked by the caller.
        flyer: who flies the chunks.
        told: called at the start, as flights land, and as chunks are written.

    Raises:
        FlightError: a file cannot be written.

    """
    began, lock = time.perf_counter(), Lock()
    missing = dataset.missing()
    before = plan.runs - sum(last - first for first, last in map(plan.chunk_runs, missing))
    flown, (reached, contacts) = 0, _found(dataset, missing)
    written = before

    def standing() -> Standing:
        done = min(max(before + flown, written), plan.runs)
        return Standing(plan.runs, done, flown, reached, contacts, time.perf_counter() - began)

    def landed(flights: int, at_goal: int, touching: int) -> None:
        nonlocal flown, reached, contacts
        with lock:
            flown, reached, contacts = flown + flights, reached + at_goal, contacts + touching
            told(standing())

    told(standing())
    with closing(flyer(plan, missing, landed)) as results:  # an interrupt between two results stops it at once
        for result in results:
            dataset.write(result)
            for run, record in result.records.items():
                dataset.keep(run, record)
            with lock:
                first, last = plan.chunk_runs(result.number)
                written += last - first
                told(standing())
    return standing()


def _found(dataset: Dataset, missing: list[int]) -> tuple[int, int]:
    """Count the flights that reached their goal, and those not clear of a contact, in the chunks that are there."""
    reached = contacts = 0
    for number in sorted(set(range(dataset.chunks)) - set(missing)):
        part = dataset.part(number, ["reached", "contact"])
        reached += part["reached"].to_pylist().count(True)
        contacts += sum(verdict not in (None, Contact.NO) for verdict in part["contact"].to_pylist())
    return reached, contacts


def keep_of(text: str) -> int | None:
    """Read how many flights to keep, those of least clearance first: `none`, `all` (None) or `worst:20`.

    Raises:
        ScenarioError: anything else.

    """
    if text in ("none", "all"):
        return 0 if text == "none" else None
    kind, _, count = text.partition(":")
    if kind == "worst" and count.isdecimal() and int(count) > 0:
        return int(count)
    raise ScenarioError(f"keep: {text!r}; valid are none, all and worst:N with N from 1 on, as worst:20")


def keep_flights(
    plan: Plan, dataset: Dataset, keep: int | None, *, told: Callable[[int, int], None] = lambda done, total: None
) -> list[int]:
    """Write the flight files of a complete campaign that are not there yet: their runs are flown again.

    Args:
        plan: of the campaign.
        dataset: its folder, complete.
        keep: how many, as `keep_of` gives it.
        told: called with how many are there, and of how many.

    Returns:
        The runs kept, of least clearance first.

    Raises:
        FlightError: a file cannot be written.

    """
    if keep == 0:
        return []
    chosen = least_clear(dataset.table(["run", "status", "minimum_clearance"]), keep)
    wanted = [run for run in chosen if dataset.kept_record(run) is None]
    for first in range(0, len(wanted), plan.batch):
        for run, record in records(plan, wanted[first : first + plan.batch]):
            dataset.keep(run, record)
        told(len(chosen) - max(len(wanted) - first - plan.batch, 0), len(chosen))
    return chosen


def scheduler_of(text: str) -> tuple[str, int]:
    """Read where chunks are handed to: an address, `local` (a process for each core it may use) or `local:N`.

    Returns:
        The address of a running `dask.distributed` scheduler, empty where workers are started here, and how many are.

    Raises:
        ClusterError: neither, or more processes than cores.

    """
    kind, colon, count = text.partition(":")
    if kind == "local":
        cores = available_cores()
        if colon and not (count.isascii() and count.isdigit() and 1 <= int(count) <= cores):
            raise ClusterError(f"scheduler: {text}: this process may use {cores} cores; N must be 1 to {cores}")
        return "", int(count) if colon else cores
    found = _ADDRESS.fullmatch(text)
    if found is None or not 1 <= int(found[1]) <= 65535:
        raise ClusterError(f"scheduler: {text!r} is not valid; {VALID}")
    return text, 0


def flyer_on(scheduler: str | None, *, mixed_processors: bool = False) -> Flyer:
    """Give who flies chunks: threads of this process, a cluster, or processes started here.

    Args:
        scheduler: as for `scheduler_of`; None: this process flies.
        mixed_processors: whether workers with processors of several kinds may fly one campaign. The same chunk then
            has other last bits on another kind; each part of the table names its own (`Dataset.processors`).

    Raises:
        ClusterError: not valid, or `dask.distributed` is not installed.

    """
    if scheduler is None:
        return in_threads
    address, workers = scheduler_of(scheduler)
    missing = [name for name in ("distributed", "cryptography") if importlib.util.find_spec(name) is None]
    if missing:
        raise ClusterError(f"scheduler: {missing[0]} is not installed; pip install 'keepout-gnc[cluster]'")
    from keepout.flights.campaign.cluster import Cluster

    return Cluster(address, workers=workers, mixed_processors=mixed_processors)

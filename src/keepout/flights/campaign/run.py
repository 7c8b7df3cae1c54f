"""A campaign flown into a folder: what is missing there is flown, and nothing else."""

import time
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from threading import Lock

from keepout.core.audit.audit import Contact
from keepout.core.cores import available_cores
from keepout.flights.campaign.chunk import ChunkResult, Told, fly_chunk
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.plan import Plan

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
    waiting = iter(numbers)
    pool = ThreadPoolExecutor(workers)

    def fly(number: int) -> ChunkResult:
        return fly_chunk(plan, number, workers=1 if workers > 1 else None, told=told)

    try:
        under_way: set[Future[ChunkResult]] = {pool.submit(fly, n) for _, n in zip(range(workers), waiting)}
        while under_way:
            ready, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            for future in ready:
                following = next(waiting, None)
                if following is not None:
                    under_way.add(pool.submit(fly, following))
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

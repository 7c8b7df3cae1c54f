"""Which flights of a campaign become flight files: the worst, all, or none."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from keepout.core.errors import FlightError, ScenarioError
from keepout.core.flight.record import FlightRecord
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.replay import replay
from keepout.flights.campaign.table import FLOWN


@dataclass(frozen=True)
class Keep:
    """How many flights to keep, those of least clearance first; None: all."""

    worst: int | None

    @classmethod
    def parse(cls, text: str) -> "Keep":
        """Read `none`, `all` or `worst:20`.

        Raises:
            ScenarioError: anything else.

        """
        if text in ("none", "all"):
            return cls(0 if text == "none" else None)
        kind, _, count = text.partition(":")
        if kind == "worst" and count.isdecimal() and int(count) > 0:
            return cls(int(count))
        raise ScenarioError(f"keep: {text!r}; valid are none, all and worst:N with N from 1 on, as worst:20")


def keep_flights(
    plan: Plan, dataset: Dataset, keep: Keep, *, told: Callable[[int, int], None] = lambda done, total: None
) -> list[int]:
    """Write the flight files of a complete campaign that are not there yet: each run is flown again, to the same bits.

    Args:
        plan: of the campaign.
        dataset: its folder, complete.
        keep: which flights.
        told: called with how many are there, and of how many.

    Returns:
        The runs kept, of least clearance first.

    Raises:
        FlightError: a file cannot be written.

    """
    if keep.worst == 0:
        return []
    whole = dataset.table(["run", "status", "minimum_clearance"])
    flown = np.asarray(whole["status"].to_numpy(zero_copy_only=False) == FLOWN)
    clearance = np.asarray(whole["minimum_clearance"].cast(pa.float64()).to_numpy(zero_copy_only=False), float)
    runs = np.flatnonzero(flown)
    chosen = [int(run) for run in runs[np.lexsort((runs, clearance[runs]))][: keep.worst]]
    wanted = [run for run in chosen if not _is_kept(dataset, run)]
    for first in range(0, len(wanted), plan.batch):
        for made in replay(plan, wanted[first : first + plan.batch]):
            path = dataset.kept(made.run.number)
            path.parent.mkdir(parents=True, exist_ok=True)
            made.flight.record.save(path)
        told(len(chosen) - max(len(wanted) - first - plan.batch, 0), len(chosen))
    return chosen


def _is_kept(dataset: Dataset, run: int) -> bool:
    try:
        header = FlightRecord.load(dataset.kept(run)).header
    except FlightError:
        return False
    return header.get("campaign") == dataset.plan_sha256 and header.get("run") == run

"""The rows of `benchmarks/rivals.py`: what each holds, when one need not be flown again, and where they are kept."""

import fcntl
import json
import time
from collections import Counter
from pathlib import Path

import keepout
from keepout.digest import digest
from keepout.report.machine import machine
from keepout.whole_file import write_whole
from rivals_laws.flying import Flown, laws_of, step_ms
from rivals_laws.rival import Rival
from rivals_laws.rival_case import RivalCase

COLUMNS = (
    "rival",
    "target",
    "guard",
    "flights",
    "reached",
    "contacts",
    "minimum_clearance_m",
    "delta_v_mps",
    "time_over_bound",
    "step_ms",
    "note",
    "refused",
    "reached_without_contact",
    "undecided",
    "plan_s",
    "guard_interventions",
    "largest_speed_mps",
    "seconds",
    "machine",
    "seed",
    "digest",
)
"""Of every row; where a rival cannot run, the numbers are None and `note` says why."""
KEY = ("rival", "target", "guard", "flights", "seed", "digest")


def planned(case: RivalCase, rival: Rival, guarded: bool, flights: int) -> dict:
    """Give the entries by which a row is known before it is flown."""
    most = rival.flights(case.name)
    flights = flights if most is None else min(flights, most)
    world = {"version": keepout.__version__, "field": case.model.sha256, "scenario": case.scenario.model_dump()}
    mark = digest(json.dumps(rival.settings | world, sort_keys=True, default=str))[:32]
    return dict(zip(KEY, (rival.name, case.name, guarded, flights, case.seed, mark), strict=True))


def flown_row(case: RivalCase, rival: Rival, plan: dict, progress) -> dict:
    """Fly one row; `progress(fraction, message)` is told as it goes."""
    began, row = time.perf_counter(), dict.fromkeys(COLUMNS) | plan | {"machine": machine(), "note": rival.missing}
    if rival.missing:
        return row
    flown, refusals, seconds, timed = Flown(case), [], [], None
    size = min(rival.batch, plan["flights"])
    for first in range(0, plan["flights"], size):
        index, laws, refused, took = laws_of(case, rival, range(first, min(first + size, plan["flights"])))
        refusals, seconds = refusals + refused, seconds + took
        if laws:
            timed = (laws[0], case.pairs[index[0], 1]) if timed is None else timed
            done = first / plan["flights"]
            share = min(size, plan["flights"] - first) / plan["flights"]
            flown.add(index, laws, plan["guard"], size, lambda f, m, d=done, s=share: progress(d + s * f, m))
    row |= flown.row() | {"refused": len(refusals), "plan_s": sorted(seconds)[len(seconds) // 2]}
    if timed is not None:
        row["step_ms"] = step_ms(case, *timed, flown.first, plan["guard"])
    row["note"] = "; ".join(filter(None, (rival.note(case), _said(refusals))))
    return row | {"seconds": time.perf_counter() - began}


def _said(refusals: list[str]) -> str:
    """Say how many pairs were refused for which end, by the first words of each refusal."""
    ends = Counter(line.partition(":")[0] for line in refusals)
    return ", ".join(f"{count} refused for their {end}" for end, count in sorted(ends.items()))


class Rows:
    """Rows flown so far, in one file that is written whole after each; several runs may share it."""

    def __init__(self, path: Path):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)

    @property
    def kept(self) -> list[dict]:
        """All rows in the file now."""
        return json.loads(self.path.read_text()) if self.path.exists() else []

    def find(self, plan: dict) -> dict | None:
        """Give the row of a plan, if it has been flown with the same settings."""
        return next((row for row in self.kept if all(row.get(name) == plan[name] for name in KEY)), None)

    def keep(self, row: dict) -> None:
        """Keep a row, in place of that of another number of flights or other settings, and write the file."""
        same = ("rival", "target", "guard", "seed")
        with open(self.path.with_suffix(".lock"), "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # released as the file is closed
            others = [old for old in self.kept if any(old.get(name) != row[name] for name in same)]
            write_whole(self.path, json.dumps([*others, row], indent=1) + "\n")

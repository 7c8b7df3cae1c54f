"""The rows of `benchmarks/rivals.py`: what each holds, and when one need not be flown again."""

import functools
import json
import time
from collections import Counter

import kept_rows

import keepout
from keepout.core.kept import digest
from keepout.flights.pages.page import machine
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
PLACE, SETTINGS = ("rival", "target", "guard", "seed"), ("flights", "digest")
Rows = functools.partial(kept_rows.Rows, place=PLACE, settings=SETTINGS)


def planned(case: RivalCase, rival: Rival, guarded: bool, flights: int) -> dict:
    """Give the entries by which a row is known before it is flown."""
    most = rival.flights(case.name)
    flights = flights if most is None else min(flights, most)
    world = {"version": keepout.__version__, "field": case.model.sha256, "scenario": case.scenario.model_dump()}
    mark = digest(json.dumps(rival.settings | world, sort_keys=True, default=str))[:32]
    return dict(zip(PLACE + SETTINGS, (rival.name, case.name, guarded, case.seed, flights, mark), strict=True))


def flown_row(case: RivalCase, rival: Rival, plan: dict, progress) -> dict:
    """Fly one row; `progress(fraction, message)` is told as it goes."""
    began, row = time.perf_counter(), dict.fromkeys(COLUMNS) | plan | {"machine": machine(), "note": rival.missing}
    if rival.missing:
        return row
    flown, refusals, seconds, timed = Flown(case, case.seconds + rival.more_seconds), [], [], None
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

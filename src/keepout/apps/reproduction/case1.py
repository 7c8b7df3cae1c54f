"""The paper's Case 1 (section VI.C.1): a trap, the way out of it by circulation, and how often either happens."""

import dataclasses
import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from keepout.apps.reproduction import figures
from keepout.apps.reproduction.case1_map import draw_pairs, geodesic_passages, map_rows, only
from keepout.apps.reproduction.case1_words import PAPER, findings
from keepout.apps.reproduction.fitted import PAPER_NETWORK, field_of
from keepout.apps.reproduction.kept_flight import kept_flight
from keepout.apps.reproduction.part import Drawing, Part, Table
from keepout.apps.reproduction.passages import Landed, Passage, Triple, fly_passages, log_of
from keepout.apps.reproduction.rest import first_within, trapped
from keepout.apps.reproduction.side_by_side import side_by_side
from keepout.apps.reproduction.work import Work
from keepout.core.fields.model import FieldModel
from keepout.core.flight.loop import FlightLog
from keepout.core.geometry.target import Target
from keepout.core.mission.build import Mission, load_model, load_target, prepare
from keepout.core.mission.flight import Flight, judged
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of

CASE: tuple[Triple, Triple] = ((0.0, 10.0, 6.0), (0.0, -10.0, -4.0))
WING: tuple[Triple, Triple] = ((7.0, 0.0, 6.0), (7.0, 0.0, -6.0))
"""A start and a goal on either side of a wing."""
CIRCULATIONS = {"none": "paper without circulation", "printed": "paper with circulation"}
MAIN_LENGTH = 20.0
"""k_p of the flights that are drawn, m."""


@dataclasses.dataclass(frozen=True)
class Group:
    """Flights of the printed constants that are told one by one: a rate, and what is flown at it.

    Attributes:
        name: ends the flights' names; empty for the paper's own rate.
        period: s.
        force_limit: per axis, N.
        duration: s.
        passages: by what they add to a flight's name.

    """

    name: str
    period: float
    force_limit: float
    duration: float
    passages: Mapping[str, Passage]


def _groups(*, quick: bool) -> tuple[Group, Group | None]:
    """Give the flights at the paper's 1 Hz and 0.1 N, and those at 20 Hz and 10 N, which `quick` leaves out."""
    slow = {"": Passage(*CASE, MAIN_LENGTH), "wing, ": Passage(*WING, 1.5)}
    if quick:
        return Group("", 1.0, 0.1, 3000.0, slow), None
    slow |= {f"k_p {length:g}, ": Passage(*CASE, length) for length in (1.5, 10.0, 15.0, 30.0)}
    fast = {f"k_p {length:g}, ": Passage(*CASE, length) for length in (10.0, 15.0, 20.0)}
    return Group("", 1.0, 0.1, 3000.0, slow), Group(", 20 Hz", 0.05, 10.0, 1500.0, fast)


def _scenario(seed: int, circulation: str, group: Group) -> Scenario:
    """Give the scenario of the printed constants with one circulation, at a group's rate, for Case 1's passage."""
    return Scenario().replace(
        name=f"paper-{circulation}-{1.0 / group.period:g}hz",
        seed=seed,
        duration=group.duration,
        control={
            "profile": "paper",
            "circulation": circulation,
            "period": group.period,
            "paper": {"slowing_length": MAIN_LENGTH},
        },
        guard={"enabled": False},
        chaser={"force_limit": group.force_limit},
    )


class _Flown:
    """What the laws of Case 1 share: target and field, and missions that are prepared once, and only where needed."""

    def __init__(self, work: Work, target: Target, model: FieldModel):
        self.work, self.target, self.model = work, target, model
        self.made_with = (target.sha256, model.sha256)
        target.distance.distance(np.zeros((1, 3)))  # built and compiled once, before the laws share it

    def mission(self, scenario: Scenario) -> Callable[[], Mission]:
        """Give what prepares a scenario's mission at the first call."""
        lock = threading.Lock()
        prepared = functools.lru_cache(maxsize=1)(lambda: prepare(scenario, target=self.target, model=self.model))

        def once() -> Mission:
            with lock:
                return prepared()

        return once

    def flight(self, scenario: Scenario, log: FlightLog) -> Flight:
        """Give the flight of a scenario from its log."""
        return judged(prepare(scenario, target=self.target, model=self.model), log)


def case1(work: Work) -> Part:
    """Fly the trap, the escape and the default law; then, over k_p and random pairs, count the trapped."""
    entry = Scenario()
    target = load_target(entry.target)
    flown, network = _Flown(work, target, load_model(entry, target)), _paper_network(work, target)
    pairs = draw_pairs(8 if work.quick else 300, seed=work.seed)
    lengths = (1.5, MAIN_LENGTH) if work.quick else (1.5, 5.0, 10.0, 15.0, 20.0, 30.0)
    slow, fast = _groups(quick=work.quick)
    crossings = [Passage(*pair, length) for length in lengths for pair in pairs]
    choices = ["none", "printed"] if work.quick else ["none", "printed", "skew", "switching"]

    tasks: dict[str, Callable[[Progress], Any]] = {}
    for choice in choices:
        told = list(slow.passages.values()) if choice in CIRCULATIONS else []
        scenario = _scenario(work.seed, choice, slow)
        tasks[f"slow {choice}"] = _laws_passages(flown, scenario, [*told, *crossings], len(told))
    tasks["default"] = _default_flight(flown, CASE, "default-law")
    if fast is not None:
        tasks["default wing"] = _default_flight(flown, WING, "wing-default-law")
        tasks["default map"] = functools.partial(_default_map, flown, pairs)
        for choice in CIRCULATIONS:
            told = list(fast.passages.values())
            tasks[f"fast {choice}"] = _laws_passages(flown, _scenario(work.seed, choice, fast), told, len(told))
    alone = dataclasses.replace(slow, name=", paper's network", passages={"": slow.passages[""]})
    if network is not None:
        for choice in CIRCULATIONS:
            told = list(alone.passages.values())
            tasks[f"network {choice}"] = _laws_passages(network, _scenario(work.seed, choice, alone), told, len(told))
    done = side_by_side(tasks, part_of(work.progress, 0.1, 0.9))

    flights: dict[str, Flight] = {}
    for group, speed in ((slow, "slow"), (fast, "fast")):
        if group is not None:
            for choice in CIRCULATIONS:
                flights |= _told(flown, work.seed, choice, group, done[f"{speed} {choice}"])
    flights["default law"] = done["default"]
    if "default wing" in done:
        flights["wing, default law"] = done["default wing"]
    if network is not None:
        for choice in CIRCULATIONS:
            flights |= _told(network, work.seed, choice, alone, done[f"network {choice}"])

    counts = []
    for choice in choices:
        first = len(slow.passages) if choice in CIRCULATIONS else 0
        counts += map_rows(choice, lengths, len(pairs), only(done[f"slow {choice}"], first))
    if "default map" in done:
        counts += map_rows("default law", [None], len(pairs), done["default map"])
    rows = [_row(work, name, flight) for name, flight in flights.items()]
    return Part(
        name="case1",
        title="Case 1: local minimum",
        paper=PAPER,
        ours=findings(rows, counts, has_network=network is not None),
        rows=rows,
        tables=[
            Table(
                "flights",
                "1 Hz and 0.1 N; where 20 Hz is said, 10 N. end: trapped is at rest outside the goal's 0.1 m; after: "
                "first within it; gap: from the chaser's ball to the exact mesh; h: the law's own barrier",
                [table_line(row) for row in rows],
            ),
            Table(
                "map",
                "Random ±y pairs at 1 Hz, 0.1 N, 3000 s: x in [-4, 4] m, z in [-3, 3] m, start y in [5, 12] m, goal y "
                "in [-12, -5] m. arrived: came within 0.1 m of the goal; touched: whatever the audit does not exclude; "
                "clean: arrived without a touch",
                counts,
            ),
        ],
        drawings=_drawings(work, flights, counts),
        flights={name: flights[name] for name in (*CIRCULATIONS.values(), "default law")},
    )


def _laws_passages(
    flown: _Flown, scenario: Scenario, passages: Sequence[Passage], logs: int
) -> Callable[[Progress], Landed]:
    def run(progress: Progress) -> Landed:
        work = dataclasses.replace(flown.work, progress=progress)
        own = passages[0].scenario(scenario)
        return fly_passages(work, own, passages, flown.mission(own), made_with=flown.made_with, logs=logs)

    return run


def _default_scenario(seed: int, pair: tuple[Triple, Triple], name: str) -> Scenario:
    return Passage(*pair).scenario(Scenario().replace(name=name, seed=seed, duration=3000.0))


def _default_flight(flown: _Flown, pair: tuple[Triple, Triple], name: str) -> Callable[[Progress], Flight]:
    scenario = _default_scenario(flown.work.seed, pair, name)
    return lambda progress: kept_flight(flown.work, scenario, flown.target, progress, model=flown.model)


def _default_map(flown: _Flown, pairs: Sequence[tuple[Triple, Triple]], progress: Progress) -> Landed:
    """Fly the pairs by the default law, without its guard."""
    work, passages = dataclasses.replace(flown.work, progress=progress), [Passage(*pair) for pair in pairs]
    scenario = _default_scenario(work.seed, pairs[0], "default-map").replace(guard={"enabled": False})
    made = functools.cache(lambda: geodesic_passages(flown.mission(scenario)(), pairs))
    return fly_passages(
        work,
        scenario,
        passages,
        lambda: made()[0],
        made_with=flown.made_with,
        guidances=lambda some: made()[1](some),
    )


def _told(flown: _Flown, seed: int, choice: str, group: Group, landed: Landed) -> dict[str, Flight]:
    """Give the flights of a group by one circulation."""
    flights = {}
    for place, (what, passage) in enumerate(group.passages.items()):
        name = f"{what}{CIRCULATIONS[choice]}{group.name}"
        words = name.replace(",", "").replace(" ", "-").replace("k_p", "kp").replace("'", "").lower()
        scenario = passage.scenario(_scenario(seed, choice, group)).replace(name=words)
        flights[name] = flown.flight(scenario, log_of(landed, place))
    return flights


def _paper_network(work: Work, target: Target) -> _Flown | None:
    """Give what flies by the paper's network, where there is a field of it and time for it."""
    model = None if work.quick else field_of(work.within(0.0, 0.1), PAPER_NETWORK, target, fitting=False)
    return None if model is None else _Flown(work, target, model)


def _row(work: Work, name: str, flight: Flight) -> dict[str, Any]:
    """Give what `--json` and `summary.json` hold of a flight, and save its file."""
    scenario, record = flight.scenario, flight.record
    path = work.folder / f"{scenario.name}.parquet"
    record.save(path)
    goal, tolerance = np.asarray(scenario.goal.position), scenario.goal.tolerance
    paper = scenario.control.profile == "paper"
    return {
        "name": name,
        "trapped": trapped(record.time, record.position, goal, tolerance),
        "first_within_s": first_within(record.time, record.position, goal, tolerance),
        "slowing_length_m": scenario.control.paper.slowing_length if paper else None,
        "rate_hz": 1.0 / scenario.control.period,
        "force_limit_n": scenario.chaser.force_limit,
        "minimum_barrier_m": float(np.min(record.barrier)),
        **flight.summary(),
        "flight": str(path),
    }


def table_line(row: Mapping[str, Any]) -> dict[str, Any]:
    """Give a row of the table, which fits a terminal of 80 columns."""
    within = row["first_within_s"]
    return {
        "flight": row["name"],
        "k_p m": row["slowing_length_m"],
        "end": "trapped" if row["trapped"] else "under way" if within is None else "arrived",
        "after s": None if within is None else round(within, 1),
        "contact": row["contact_verdict"],
        "least gap m": round(row["minimum_clearance_m"], 4),
        "least h m": round(row["minimum_barrier_m"], 4) + 0.0,
        "error m": round(row["final_error_m"], 4),
    }


def _drawings(work: Work, flights: Mapping[str, Flight], counts: Sequence[Mapping[str, Any]]) -> list[Drawing]:
    """Draw the paper's figures in its order, then those that it lacks."""
    sets = {"": ""}
    if any(name.endswith(", 20 Hz") for name in flights):
        sets[", 20 Hz"] = "-20hz"
    drawings = []
    for ending, suffix in sets.items():
        what = f"k_p {MAIN_LENGTH:g}, " if ending else ""
        shown = {name: flights[f"{what}{name}{ending}"] for name in CIRCULATIONS.values()}
        if not ending:
            shown["default law"] = flights["default law"]
        drawings += figures.draw_case(work.folder, shown, suffix=suffix, remark=ending)
    wing = {name: flights[f"wing, {name}"] for name in CIRCULATIONS.values()}
    drawings.append(figures.draw_wing(work.folder, wing))
    drawings.append(figures.draw_map(work.folder, counts))
    return [Drawing(name, caption) for name, caption in drawings]

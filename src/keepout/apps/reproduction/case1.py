"""The paper's Case 1 (section VI.C.1): a trap, the way out of it by circulation, and how often either happens.

The map says it over many start and goal pairs and k_p, for each choice of circulation.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from keepout.apps.reproduction import figures
from keepout.apps.reproduction.fitted import paper_network, target_of
from keepout.apps.reproduction.flown import (
    Landed,
    Passage,
    Triple,
    first_within,
    fly_passages,
    kept_flight,
    log_of,
    trapped,
)
from keepout.apps.reproduction.work import Part, Table, Work, side_by_side
from keepout.core.control.barrier_grid import BarrierGrid
from keepout.core.control.geodesic import geodesic_guidance
from keepout.core.control.guidance import Guidance, Straight, StraightGuidance
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.mission.build import Mission, load_model
from keepout.core.mission.flight import Flight, judged
from keepout.core.mission.law import build_law
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of
from keepout.flights.campaign.plan import Workshop

PAPER = (
    "Without the circulation inequality the chaser is trapped in a local minimum; with it, it arrives, and the "
    "position error converges to zero. In both flights the barrier h stays positive; without circulation it falls to "
    "zero. Safe velocity and velocity keep within ±v_max. Start (0, 10, 6) m, goal (0, -10, -4) m, 1 Hz, 0.1 N, "
    "0.1 m/s. The slowing length k_p is not printed."
)
CASE: tuple[Triple, Triple] = ((0.0, 10.0, 6.0), (0.0, -10.0, -4.0))
WING: tuple[Triple, Triple] = ((7.0, 0.0, 6.0), (7.0, 0.0, -6.0))
"""A start and a goal on either side of a wing."""
CIRCULATIONS = {"none": "paper without circulation", "printed": "paper with circulation"}
MAIN_LENGTH = 20.0
"""k_p of the flights that are drawn, m."""
NEAR, FAR = 5.0, 12.0
"""Starts lie between these y (m), goals between their negatives."""
ASIDE, UP = 4.0, 3.0
"""Starts and goals lie within ± these x and z (m)."""
_ROOM = 3.0
"""Between the pairs and the sides of the grid of travel times, m."""


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
        self.work, self.target, self.model, self.workshop = work, target, model, Workshop()
        self.workshop.keep(target, model, Scenario())

    def passages(
        self, scenario: Scenario, passages: Sequence[Passage], logs: int = 0, *, geodesic: bool = False
    ) -> Callable[[Progress], Landed]:
        """Give what flies passages by a scenario's law; led by the default law's geodesics, one for each, if asked."""
        own = passages[0].scenario(scenario)
        mission = functools.partial(self.workshop.mission, own)
        guided: dict[str, Any] = {}
        if geodesic:
            made = functools.cache(lambda: geodesic_passages(self.workshop.mission(own), passages))
            mission, guided = (lambda: made()[0]), {"guidances": lambda some: made()[1](some)}
        made_with = self.target.sha256, self.model.sha256

        def fly(progress: Progress) -> Landed:
            work = dataclasses.replace(self.work, progress=progress)
            return fly_passages(work, own, passages, mission, made_with=made_with, logs=logs, **guided)

        return fly

    def default(self, pair: tuple[Triple, Triple], name: str) -> Callable[[Progress], Flight]:
        """Give what flies a passage by the default law."""
        scenario = _default_scenario(self.work.seed, pair, name)
        return functools.partial(kept_flight, self.work, scenario, self.target, model=self.model)

    def told(self, choice: str, group: Group, landed: Landed) -> dict[str, Flight]:
        """Give the flights of a group by one circulation."""
        flights = {}
        for place, (what, passage) in enumerate(group.passages.items()):
            name = f"{what}{CIRCULATIONS[choice]}{group.name}"
            words = name.replace(",", "").replace(" ", "-").replace("k_p", "kp").replace("'", "").lower()
            scenario = passage.scenario(_scenario(self.work.seed, choice, group)).replace(name=words)
            flights[name] = judged(self.workshop.mission(scenario), log_of(landed, place))
        return flights


def _default_scenario(seed: int, pair: tuple[Triple, Triple], name: str) -> Scenario:
    return Passage(*pair).scenario(Scenario().replace(name=name, seed=seed, duration=3000.0))


def case1(work: Work) -> Part:
    """Fly the trap, the escape and the default law; then, over k_p and random pairs, count the trapped."""
    target = target_of("intelsat30")
    model = paper_network(work, target)
    flown = _Flown(work, target, load_model(Scenario(), target))
    pairs = draw_pairs(8 if work.quick else 300, seed=work.seed)
    lengths = (1.5, MAIN_LENGTH) if work.quick else (1.5, 5.0, 10.0, 15.0, 20.0, 30.0)
    choices = ["none", "printed"] if work.quick else ["none", "printed", "skew", "switching"]
    crossings = [Passage(*pair, length) for length in lengths for pair in pairs]
    slow, fast = _groups(quick=work.quick)
    told = {"slow": (flown, slow)}
    if fast is not None:
        told["fast"] = (flown, fast)
    if model is not None:
        alone = dataclasses.replace(slow, name=", paper's network", passages={"": slow.passages[""]})
        told["network"] = (_Flown(work, target, model), alone)

    tasks: dict[str, Callable[[Progress], Any]] = {}
    for name, (by, group) in told.items():
        for choice in choices if name == "slow" else CIRCULATIONS:
            own = list(group.passages.values()) if choice in CIRCULATIONS else []
            every = [*own, *(crossings if name == "slow" else ())]
            tasks[f"{name} {choice}"] = by.passages(_scenario(work.seed, choice, group), every, len(own))
    tasks["default"] = flown.default(CASE, "default-law")
    if fast is not None:
        tasks["default wing"] = flown.default(WING, "wing-default-law")
        unguarded = _default_scenario(work.seed, pairs[0], "default-map").replace(guard={"enabled": False})
        tasks["default map"] = flown.passages(unguarded, [Passage(*pair) for pair in pairs], geodesic=True)
    done = side_by_side(tasks, part_of(work.progress, 0.1, 0.9))

    named: dict[str, dict[str, Flight]] = {name: {} for name in told}
    for name, (by, group) in told.items():
        for choice in CIRCULATIONS:
            named[name] |= by.told(choice, group, done[f"{name} {choice}"])
    default = {"default law": done["default"]}
    if fast is not None:
        default["wing, default law"] = done["default wing"]
    flights = {**named["slow"], **named.get("fast", {}), **default, **named.get("network", {})}
    counts = []
    for choice in choices:
        first = len(slow.passages) if choice in CIRCULATIONS else 0
        counts += map_rows(choice, lengths, len(pairs), only(done[f"slow {choice}"], first))
    if "default map" in done:
        counts += map_rows("default law", [None], len(pairs), done["default map"])
    return _part(work, flights, counts, has_network=model is not None)


def _part(work: Work, flights: Mapping[str, Flight], counts: list[dict[str, Any]], *, has_network: bool) -> Part:
    rows = [_row(work, name, flight) for name, flight in flights.items()]
    return Part(
        name="case1",
        title="Case 1: local minimum",
        paper=PAPER,
        ours=findings(rows, counts, has_network=has_network),
        rows=rows,
        tables=[
            Table(
                "flights",
                "1 Hz and 0.1 N; where 20 Hz is said, 10 N. end: trapped is at rest outside the goal's 0.1 m, arrived "
                "stays within it to the end; within, stays: when it first was, since when it stays; gap: from the "
                "chaser's ball to the exact mesh; h: the law's own barrier",
                [table_line(row) for row in rows],
            ),
            Table(
                "map",
                "Random ±y pairs at 1 Hz, 0.1 N, 3000 s: x in [-4, 4] m, z in [-3, 3] m, start y in [5, 12] m, goal y "
                "in [-12, -5] m. arrived: stays within 0.1 m of the goal; touched: whatever the audit does not "
                "exclude; clean: arrived without a touch",
                counts,
            ),
        ],
        drawings=_drawings(work, flights, counts),
        flights={name: flights[name] for name in (*CIRCULATIONS.values(), "default law")},
    )


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
        "largest_axis_safe_velocity_mps": float(np.nanmax(np.abs(record.safe_velocity))),
        "largest_axis_velocity_mps": float(np.max(np.abs(record.velocity))),
        **flight.summary(),
        "flight": str(path),
    }


def table_line(row: Mapping[str, Any]) -> dict[str, Any]:
    """Give a row of the table, which fits a terminal of 80 columns."""
    within = row["first_within_s"]
    return {
        "flight": row["name"],
        "k_p m": row["slowing_length_m"],
        "end": "trapped" if row["trapped"] else "arrived" if row["reached"] else "under way",
        "within s": None if within is None else round(within, 1),
        "stays s": None if row["time_to_reach_s"] is None else round(row["time_to_reach_s"], 1),
        "contact": row["contact_verdict"],
        "least gap m": round(row["minimum_clearance_m"], 4),
        "least h m": round(row["minimum_barrier_m"], 4) + 0.0,
        "error m": round(row["final_error_m"], 4),
    }


def _drawings(work: Work, flights: Mapping[str, Flight], counts: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Draw the paper's figures in its order, then those that it lacks."""
    sets = {"": ""}
    if any(name.endswith(", 20 Hz") for name in flights):
        sets[", 20 Hz"] = "-20hz"
    drawings = {}
    for ending, suffix in sets.items():
        what = f"k_p {MAIN_LENGTH:g}, " if ending else ""
        shown = {name: flights[f"{what}{name}{ending}"] for name in CIRCULATIONS.values()}
        if not ending:
            shown["default law"] = flights["default law"]
        drawings |= figures.draw_case(work.folder, shown, suffix=suffix, remark=ending)
    wing = {name: flights[f"wing, {name}"] for name in CIRCULATIONS.values()}
    return drawings | figures.draw_wing(work.folder, wing) | figures.draw_map(work.folder, counts)


def draw_pairs(count: int, *, seed: int) -> list[tuple[Triple, Triple]]:
    """Draw starts and goals on either side of the target: "±y pairs".

    Uniform and independent: x in [-4, 4] m and z in [-3, 3] m, where bus and dishes are, for both; y in [5, 12] m for
    the start and in [-12, -5] m for the goal.
    That is 1 m and more beside `intelsat30`, whose y ends at ±3.93 m.

    """
    corner = np.array([ASIDE, NEAR, UP])
    points = np.random.default_rng(seed).uniform(corner * (-1.0, 1.0, -1.0), (ASIDE, FAR, UP), (count, 2, 3))
    points[:, 1, 1] *= -1.0
    return [((a[0], a[1], a[2]), (b[0], b[1], b[2])) for a, b in points.tolist()]


def map_rows(
    choice: str, lengths: Sequence[float | None], pairs: int, landed: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Count what became of the passages of one choice: a row for each k_p, `pairs` passages each, in that order."""
    rows = []
    for place, length in enumerate(lengths):
        own = {name: column[place * pairs : (place + 1) * pairs] for name, column in landed.items()}
        arrived, touched = own["reached"], own["contact"] != "no"
        rows.append(
            {
                "circulation": choice,
                "k_p m": length,
                "pairs": pairs,
                "trapped": int(own["trapped"].sum()),
                "arrived": int(arrived.sum()),
                "clean": int(np.sum(arrived & ~touched)),
                "touched": int(touched.sum()),
                "least gap m": round(float(own["minimum_clearance_m"].min()), 4),
            }
        )
    return rows


def only(landed: Landed, first: int) -> Landed:
    """Leave out the first passages, and the logs."""
    return {name: column[first:] for name, column in landed.items() if not name.startswith("log_")}


def geodesic_passages(
    mission: Mission, passages: Sequence[Passage]
) -> tuple[Mission, Callable[[Sequence[Passage]], Guidance]]:
    """Give the default law for all passages, without a guard, and what makes their geodesic guidances, stacked.

    One barrier grid serves them all; a way is marched for each goal, from it to its start.
    """
    points = np.array([point for passage in passages for point in (passage.start, passage.goal)])
    reach = float(np.linalg.norm(points, axis=1).max())
    law = build_law(mission.scenario, mission.model, guidance=Straight(), reach=reach)
    leader, offset = law.velocity.guidance, float(law.velocity.offset)
    assert isinstance(leader, StraightGuidance)
    lower = np.minimum(points.min(axis=0), mission.target.vertices.min(axis=0)) - _ROOM
    upper = np.maximum(points.max(axis=0), mission.target.vertices.max(axis=0)) + _ROOM
    grid = BarrierGrid.build(mission.model.field, offset, lower, upper)
    speed, length = float(leader.speed), float(leader.slowing_length)

    def stacked(passages: Sequence[Passage]) -> Guidance:
        made = {
            passage: geodesic_guidance(
                grid,
                mission.model.field,
                offset,
                np.asarray(passage.goal),
                speed=speed,
                slowing_length=length,
                start=np.asarray(passage.start),
            )
            for passage in set(passages)
        }
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(made[passage] for passage in passages))

    return mission.with_law(law), stacked


def findings(rows: Sequence[Mapping[str, Any]], counts: Sequence[Mapping[str, Any]], *, has_network: bool) -> list[str]:
    """Say what was found, a paragraph each.

    Args:
        rows: of the flights, as in `summary.json`.
        counts: of the map.
        has_network: whether the paper's own network was flown too.

    """
    said = [
        "tanh acts on each component apart, so k_p decides what the paper's law does here. With k_p much smaller than "
        "the way, v_c saturates in every component: the chaser leaves along the diagonal of the axes and slips past "
        "the bus. With large k_p it follows the straight line to the goal, into the corner of dish and bus.",
    ]
    said += [_sentence(row) for row in rows]
    lowest = min((row for row in rows if row["slowing_length_m"] is not None), key=lambda row: row["minimum_barrier_m"])
    said.append(
        f"h is not positive throughout: its least is {lowest['minimum_barrier_m']:.3g} m ({lowest['name']})."
        if lowest["minimum_barrier_m"] < 0.0
        else "h is never negative in these flights."
    )
    paper = [row for row in rows if row["slowing_length_m"] is not None]
    fastest = max(paper, key=lambda row: row["largest_axis_velocity_mps"])
    said.append(
        "Of the paper's law the safe velocity comes to "
        f"{max(row['largest_axis_safe_velocity_mps'] for row in paper):.4g} m/s in an axis at most, and the velocity "
        f"to {fastest['largest_axis_velocity_mps']:.4g} m/s ({fastest['name']}); the limit is "
        f"{Scenario().chaser.speed_limit:g} m/s."
    )
    if not has_network:
        said.append("All these flights are by Keepout's own learned field: none of the paper's network was given.")
    by_length: dict[Any, list[str]] = {}
    for count in counts:
        words = f"{count['circulation']} {count['trapped']}, {count['clean']}, {count['touched']}"
        by_length.setdefault(count["k_p m"], []).append(words)
    for length, words in by_length.items():
        at = "By the default law without its guard" if length is None else f"At k_p = {length:g} m"
        of = f"of {counts[0]['pairs']} random pairs were trapped, arrived without a touch, touched"
        said.append(f"{at}, {of}: {'; '.join(words)}.")
    return said


def _sentence(row: Mapping[str, Any]) -> str:
    if row["trapped"]:
        end = f"comes to rest {row['final_error_m']:.3g} m from the goal"
    elif row["reached"]:
        end = f"is first within the goal's tolerance after {row['first_within_s']:.0f} s and"
        end += f" stays there from {row['time_to_reach_s']:.0f} s to the end"
    else:
        end = f"is still under way at the end, {row['final_error_m']:.3g} m from the goal"
    touch = {"no": "without contact", "yes": "and touches the target"}.get(row["contact_verdict"], "contact undecided")
    gap = row["minimum_clearance_m"]
    return f"{row['name'][0].upper()}{row['name'][1:]}: {end}, {touch} (least gap {gap:.3g} m)."

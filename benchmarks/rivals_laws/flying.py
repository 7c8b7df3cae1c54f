"""Fly a rival's pairs in compiled batches, audit every flight, and time one control step."""

import functools
import gc
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.audit.audit import Contact
from keepout.core.errors import KeepoutError
from keepout.core.flight.batches import states_at
from keepout.core.flight.loop import fly
from keepout.core.flight.setup import FlightSetup
from keepout.core.mission.flight import fly_audited
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.on_board import OnBoard
from rivals_laws.rival import Rival
from rivals_laws.rival_case import Point, RivalCase

TIMED = 200
"""Control steps timed, spread over a flight."""


def setup_of(case: RivalCase, law, goal: Point, guarded: bool) -> FlightSetup:
    """Put a law on the loop that all rivals fly: motion, disturbance and thrusters of the scenario."""
    return Surroundings(case.scenario).setup(law, goal=goal, guard=case.guard if guarded else None)


def laws_of(case: RivalCase, rival: Rival, index) -> tuple[list, list, list, list]:
    """Make the laws of some pairs: those that can be flown, their laws, the refusals, and the seconds of each."""
    flown, laws, refusals, seconds = [], [], [], []
    for i in index:
        case.seconds_spared, began = 0.0, time.perf_counter()
        try:
            laws.append(rival.law(case, *case.pairs[i]))
            flown.append(i)
        except KeepoutError as refusal:
            refusals.append(str(refusal))
        seconds.append(time.perf_counter() - began + case.seconds_spared)
    return flown, laws, refusals, seconds


def stacked(laws: list):
    """Give one law whose arrays that differ between the laws have a leading axis, and a function to select those."""
    columns = list(zip(*(jax.tree.leaves(law) for law in laws), strict=True))
    differs = [any(one is not column[0] for one in column) for column in columns]
    merged = [np.stack(column) if own else column[0] for own, column in zip(differs, columns, strict=True)]
    paths = [path for path, _ in jax.tree_util.tree_flatten_with_path(laws[0])[0]]
    chosen = [path for own, path in zip(differs, paths, strict=True) if own]

    def select(law) -> list:
        return [functools.reduce(_inside, path, law) for path in chosen]

    return jax.tree.unflatten(jax.tree.structure(laws[0]), merged), select


def _inside(tree, key):
    """Follow one step of a leaf's path."""
    if isinstance(key, jax.tree_util.GetAttrKey):
        return getattr(tree, key.name)
    return tree[key.idx if isinstance(key, jax.tree_util.SequenceKey) else key.key]


class Flown:
    """What became of the flights of a row."""

    def __init__(self, case: RivalCase, seconds: int):
        self.case, self.seconds, self.index, self.outcomes, self.audits = case, seconds, [], [], []
        self.first = None
        """Times, positions and velocities of the first flight."""

    def add(self, part, laws, guarded, size, progress):
        """Fly and audit the pairs `part` in a batch of `size`."""
        case = self.case
        goals = case.pairs[part, 1]
        law, select = stacked(laws)
        setup = setup_of(case, laws[0], goals[0], guarded)
        setup = eqx.tree_at(lambda s: (s.controller, s.goal), setup, (law, jnp.asarray(goals)))

        def landed(_, columns):
            if self.first is None:
                self.first = (columns["time"][0], columns["position"][0], columns["velocity"][0])

        outcome, audits = fly_audited(
            case.scenario.replace(duration=float(self.seconds)),
            case.target,
            setup,
            states_at(setup.motion, case.pairs[part, 0]),
            vary=lambda s: [s.goal, *select(s.controller)],
            landed=landed,
            batch=size,
            progress=progress,
        )
        self.index += list(part)
        self.outcomes.append(outcome)
        self.audits += audits

    def row(self):
        """Give the row's figures; None where nothing was flown."""
        names = ("contacts", "minimum_clearance_m", "delta_v_mps", "time_over_bound")
        if not self.index:
            return {"reached": 0} | dict.fromkeys(names)
        outcome = jax.tree.map(lambda *parts: np.concatenate(parts), *self.outcomes)
        reached, contact = outcome.reached, np.array([a.contact is Contact.YES for a in self.audits])
        ratio = outcome.time_to_reach * self.case.scenario.chaser.speed_limit
        ratio = ratio / self.case.ways(self.case.law_offset)[self.index]
        return {
            "reached": int(reached.sum()),
            "contacts": int(contact.sum()),
            "minimum_clearance_m": min(a.minimum_clearance for a in self.audits),
            "delta_v_mps": float(np.median(outcome.delta_v)),
            "time_over_bound": float(np.median(ratio[reached])) if reached.any() else None,
            "reached_without_contact": int(np.sum(reached & ~contact)),
            "undecided": sum(a.contact is Contact.UNDECIDED for a in self.audits),
            "guard_interventions": int(outcome.guard_interventions.sum()),
            "largest_speed_mps": max(a.largest_speed for a in self.audits),
        }


def step_ms(case: RivalCase, law, goal: Point, flight, guarded: bool) -> float:
    """Median milliseconds of a control step on board, at states along a flight (its times, positions, velocities)."""
    setup = setup_of(case, law, goal, guarded)
    _, positions, velocities = (column[:: max(1, len(column) // TIMED)] for column in flight)
    board, seconds = OnBoard(setup, setup.motion.initial_state(positions[0], velocities[0])), []
    gc.collect()
    gc.disable()
    for number, (position, velocity) in enumerate(zip(positions, velocities, strict=True)):
        began = time.perf_counter()
        board.step(number * float(setup.period), position, velocity)
        seconds.append(time.perf_counter() - began)
    gc.enable()
    return 1e3 * float(np.median(seconds))


def path(case: RivalCase, rival: Rival, start: Point, goal: Point, guarded: bool) -> np.ndarray:
    """Fly one pair and give its positions (steps + 1, 3) m.

    Raises:
        KeepoutError: the rival refuses the pair.

    """
    setup = setup_of(case, rival.law(case, start, goal), goal, guarded)
    initial = setup.motion.initial_state(start, np.zeros(3))
    steps = round((case.seconds + rival.more_seconds) / case.scenario.control.period)
    return np.asarray(fly(setup, initial, steps, jax.random.key(0)).position)

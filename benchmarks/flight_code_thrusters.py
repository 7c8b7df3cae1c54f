"""Forces for the thrusters of a layout, in C and in Python: of every kind, and where a pulse is just fired or not.

Each force comes with on-times that are owed and pulses that are still on. Where which thrusters fire changes along a
ray of forces, the ray is cut in halves down to two neighbouring numbers. On such a threshold the two round apart, and a
pulse may be fired by one of them alone: it is counted, and must not be so a little to either side.
"""

from typing import NamedTuple

import jax
import numpy as np
from compiled_step import memory_type
from flight_code_missions import Exported
from flight_code_states import GIVEN, apart, fired, given_of, with_parts
from flight_code_stored import of_thrusters

from keepout.flights.thrusters.on_off import OnOffThrusters

HALVES, STORED = 60, 7
SIDES = (0, 1, -1, 3, -8)
"""Units in the last place by which forces on a threshold are moved."""
ASIDE = 1e-9
"""How far from a threshold pulses must agree, over the length of the ray."""


class Found(NamedTuple):
    """What forces have shown.

    Attributes:
        forces: how many were compared.
        on_it: forces on a threshold of which other thrusters fire.
        beside: the same a little beside one, or anywhere else.
        given: largest difference of a mean force, a pulse or an on-time, of forces for which the same thrusters fire,
            over 1 of its unit.
        memory: likewise of what is owed and still on, s.
        records: some of them, for `flight_code_stored`.

    """

    forces: int
    on_it: int
    beside: int
    given: float
    memory: float
    records: list[np.ndarray]


def compared(flown: Exported, count: int) -> Found:
    """Compare at least `count` forces."""
    thrusters = flown.made.mission.setup.thrusters
    assert isinstance(thrusters, OnOffThrusters)
    asked = _Asked(flown, thrusters)
    limit, rng, rows = float(thrusters.force_limit.max()), np.random.default_rng(8), 256
    while asked.found.forces < count:
        force = rng.uniform(-1.3 * limit, 1.3 * limit, (rows, 3))
        force *= 10.0 ** rng.uniform(-6, 0, (rows, 1)) ** 2
        force[rng.random((rows, 3)) < 0.1] = 0.0
        corner = rng.random((rows, 3)) < 0.1
        force[corner] = np.copysign(limit, force[corner])
        force[rng.random((rows, 3)) < 0.01] = np.nan
        before = asked.memories(rng, rows)
        asked.compare(before, force, on_it=False)
        low, high = asked.cut(before, np.nan_to_num(force))
        for end in (low, high):
            for units in SIDES:
                asked.compare(before, _along(force, end + units * np.spacing(end)), on_it=True)
        for aside in (-ASIDE, ASIDE):
            asked.compare(before, _along(force, high + aside), on_it=False)
    return asked.found


def _along(force: np.ndarray, place: np.ndarray) -> np.ndarray:
    return np.nan_to_num(force) * place[:, None]


class _Asked:
    """Both codes, and what they have answered."""

    def __init__(self, flown: Exported, thrusters: OnOffThrusters) -> None:
        self.flown, self.thrusters = flown, thrusters
        self.found = Found(0, 0, 0, 0.0, 0.0, [])
        self._python = jax.jit(jax.vmap(lambda memory, force: fired(thrusters, memory, force)))

    def memories(self, rng: np.random.Generator, rows: int) -> np.ndarray:
        """Give memories such as there may be, records."""
        thrusters, memory = self.thrusters, np.zeros(rows, memory_type(self.flown.made))
        most, shape = float(thrusters.least_on_time), (rows, len(thrusters.push))
        if thrusters.delta_sigma:
            memory["thrusters"]["owed"] = rng.uniform(-0.5 * most, 0.5 * most, shape)
        memory["thrusters"]["tail"] = rng.uniform(0.0, float(thrusters.rise_delay), shape)
        return memory

    def _fires(self, before: np.ndarray, force: np.ndarray) -> np.ndarray:
        return self.flown.code.fire(before.copy(), force)["pulse"] > 0.0

    def cut(self, before: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Give neighbouring places along each ray between which it changes which thrusters fire, or 1 and 1."""
        low, high = np.zeros(len(force)), np.ones(len(force))
        at_rest = self._fires(before, 0.0 * force)
        for _ in range(HALVES):
            middle = 0.5 * (low + high)
            same = np.all(self._fires(before, _along(force, middle)) == at_rest, axis=1)
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return low, high

    def compare(self, before: np.ndarray, force: np.ndarray, *, on_it: bool) -> None:
        """Compare forces; say whether they are on a threshold."""
        held, told = before.copy(), before["thrusters"]
        by_c = given_of(self.flown.code.fire(held, force))
        count, push = len(force), np.asarray(self.thrusters.push)
        begun = self.thrusters.initial_state(jax.random.key(0))
        begun = jax.tree.map(lambda part: np.broadcast_to(part, (count, *np.shape(part))), begun)
        true = np.broadcast_to(push, (count, *push.shape))
        memory = with_parts(begun, push=true, owed=told["owed"], tail=told["tail"])
        new, by_python = jax.tree.map(np.asarray, self._python(memory, force))
        after = before.copy()
        after["thrusters"]["owed"], after["thrusters"]["tail"] = new.owed, new.tail
        pulse = GIVEN.index("pulse")
        # A pulse that is not fired is one of a few units in the last place of the period in Python.
        least = 0.25 * float(self.thrusters.least_on_time)
        other = np.any((by_c[pulse] > least) != (by_python[pulse] > least), axis=1)
        found, same = self.found, ~other
        given = max(apart(a[same], b[same], 1.0) for a, b in zip(by_c, by_python, strict=True))
        names = ("owed", "tail")
        kept = max(apart(held["thrusters"][name][same], after["thrusters"][name][same], 1.0) for name in names)
        some = np.flatnonzero(same)[::STORED]
        record = of_thrusters(self.flown.made, before[some], tuple(part[some] for part in by_python), after[some])
        self.found = Found(
            forces=found.forces + count,
            on_it=found.on_it + (int(other.sum()) if on_it else 0),
            beside=found.beside + (0 if on_it else int(other.sum())),
            given=max(found.given, given),
            memory=max(found.memory, kept),
            records=[*found.records, record],
        )

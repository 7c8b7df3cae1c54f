"""States of the guard on its thresholds, on both sides and a few units in the last place away, in C and in Python.

A line leads from a state of a random flight to another: nearer to the target, out of range, faster, off its plan, to a
jump, to another command. Where the C guard's status changes along it, the line is cut in halves down to two
neighbouring numbers. There, and a little to each side, both guards are asked.

Both round, each in its own way, so that on a threshold itself a status may differ: such a state is listed, and is close
to the threshold if both agree at `STEPS_ASIDE` on both sides. Else it counts as far from it.
"""

import collections
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from compiled_step import DOUBT, estimates_of, memories_of
from flight_code_missions import Exported
from flight_code_states import Step, apart, gathered, with_parts
from flight_code_stored import of_guard

SCAN, HALVES, LISTED, STORED = 24, 60, 4, 31
SIDES = (0, 1, -1, 2, -3, 5, -8, 13)
"""Units in the last place of the varied numbers to which a state on a threshold is moved."""
STEPS_ASIDE = (1e-12, 1e-11, 1e-9, 1e-6)
"""How far from its threshold a state is also asked, m, m/s or N along the line: there statuses must agree."""
MODES = ("clear", "braking", "holding", "escaping")
FLAGS = {4: "jump", 8: "disturbance", 16: "field", 32: "region", 64: "command", 128: "off plan", 256: "estimate"}
FLAGS |= {512: "wide", 1024: "contradicted"}


class State(NamedTuple):
    """Guards' memories, estimates, commanded forces (N) and disturbances' estimates (N), with a leading axis.

    `errors` are bounds of the estimates' errors (m, m/s), `contradicted` whether samples contradicted each other.
    """

    guard: Any
    estimate: Any
    force: np.ndarray
    disturbance: np.ndarray
    errors: np.ndarray
    contradicted: np.ndarray


class Line(NamedTuple):
    """A name, how long it is (n,), and the states at places (n,) from 0 to 1, moved by so many units (m, m/s, N)."""

    name: str
    length: np.ndarray
    at: Callable[[np.ndarray, float], State]


class Found(NamedTuple):
    """What directed states have shown.

    Attributes:
        states: how many were compared.
        modes: how often the guard was in each mode.
        crossed: how many lines were cut at what change.
        differ_close: states on a threshold whose statuses differ; both agree beside it.
        differ_far: states whose statuses differ elsewhere.
        force: largest difference of a force, of states of one status, over its size and 1 N.
        memory: likewise of the memory, over 1 of its unit.
        listed: a line for each state of a differing status, the first of each kind.

    """

    states: int
    modes: collections.Counter
    crossed: collections.Counter
    differ_close: int
    differ_far: int
    force: float
    memory: float
    listed: list[str]


def lines_of(state: State, guard: Any, rng: np.random.Generator, *, sensed: bool) -> list[Line]:
    """Give lines from states through thresholds; see the module's words. Of sensors there is one more, of doubts."""
    a, design = guard.assumptions, guard.braking
    count = len(state.force)
    turn = rng.normal(size=(count, 3))
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    place = np.asarray(state.estimate.position)
    # Where the state is no number, or far away, another line says more.
    place = np.where(np.isfinite(place) & (np.abs(place) < 1e3), place, 5.0 * turn)
    size = np.maximum(np.linalg.norm(place, axis=1), 1e-3)
    ray = place / size[:, None]
    inward = -ray + 0.3 * turn
    limit, speed = float(a.range_limit), float(a.speed_limit)
    known = 1.5 * float(a.mass) * float(a.disturbance - a.drift + 2.0 * a.velocity_error / a.period)
    bound = max(known, float(a.mass * a.drift))

    def moved(name: str, length: Any, change: Callable[[State, np.ndarray], State]) -> Line:
        whole = np.broadcast_to(np.asarray(length, float), (count,))
        return Line(name, whole, lambda places, aside: change(state, whole * places + aside))

    def all_places(direction: np.ndarray) -> Callable[[State, np.ndarray], State]:
        return lambda told, by: _carried(told, place - np.asarray(told.estimate.position), direction, by)

    def all_paces(told: State, by: np.ndarray) -> State:
        told = _carried(told, place - np.asarray(told.estimate.position), ray, 0.0 * by)
        return _hurried(told, turn * by[:, None])

    def plan_at_rest(told: State, by: np.ndarray) -> State:
        pace = turn * (1e-9 * (0.5 + by))[:, None]
        new = with_parts(told.guard, plan_velocity=pace, certified=np.ones(count, bool))
        new = with_parts(new, plan_position=_predicted(told, a, design))
        return told._replace(guard=new, force=np.full((count, 3), np.nan))

    def plan_off(told: State, by: np.ndarray) -> State:
        there = _predicted(told, a, design) + turn * by[:, None]
        return told._replace(guard=with_parts(told.guard, plan_position=there, certified=np.ones(count, bool)))

    def jump(told: State, by: np.ndarray) -> State:
        expected = np.asarray(told.guard.expected_position)
        new = with_parts(told.estimate, position=expected + turn * by[:, None])
        return told._replace(estimate=new)

    def jump_of_pace(told: State, by: np.ndarray) -> State:
        expected = np.asarray(told.guard.expected_velocity)
        new = with_parts(told.estimate, velocity=expected + turn * by[:, None])
        return told._replace(estimate=new)

    def command(told: State, by: np.ndarray) -> State:
        force = np.where(np.isfinite(told.force), told.force, 0.0)
        return told._replace(force=force + turn * by[:, None])

    def push(told: State, by: np.ndarray) -> State:
        return told._replace(disturbance=turn * by[:, None])

    caps = np.array([float(error) for error in a.estimate_errors])

    def doubt(told: State, by: np.ndarray) -> State:
        errors = np.abs(turn[:, :2]) * (caps + 1e-3) * by[:, None]
        return told._replace(errors=errors, contradicted=turn[:, 2] > 0.8)

    radius = float(guard._plan_radius)
    wide = 4.0 * (float(a.position_error) + float(design.position_radius) + 0.01)
    fast = 4.0 * (float(a.velocity_error) + float(a.disturbance * a.period) + 0.001)
    return [
        moved("field level", size, all_places(inward)),
        moved("range", np.maximum(1.2 * limit - size, 1.0), all_places(ray)),
        moved("range, way back", np.maximum(1.05 * limit - size, 1.0), all_places(ray + 0.1 * turn)),
        moved("speed", 1.6 * speed + 0.01, all_paces),
        moved("at rest", 1.0, plan_at_rest),
        moved("off plan", 3.0 * radius + 1e-3, plan_off),
        moved("jump", wide, jump),
        moved("jump of velocity", fast, jump_of_pace),
        moved("command", 3.0 * float(a.force_limit), command),
        moved("disturbance", 2.0 * bound, push),
        *([moved("doubt", 3.0, doubt)] if sensed else []),
    ]


def _predicted(told: State, a: Any, design: Any) -> np.ndarray:
    """Give about where the plan stands for what is expected (m), after the commands under way."""
    seen = told.guard if told.guard.observed is None else told.guard.observed
    place, pace = np.asarray(seen.expected_position), np.asarray(seen.expected_velocity)
    period = float(a.period)
    for step in range(a.delay):
        push = np.asarray(told.guard.pending)[:, step]
        place, pace = place + period * pace + 0.5 * period**2 * push, pace + period * push
    return place


def _carried(told: State, first: np.ndarray, direction: np.ndarray, by: np.ndarray) -> State:
    """Move all places of a state along: what is told, what is expected, and the plan."""
    step = first + direction * np.asarray(by)[:, None]
    base = np.asarray(told.estimate.position) + step
    shift = base - np.asarray(told.guard.expected_position)
    new = with_parts(
        told.guard,
        expected_position=base,
        plan_position=np.asarray(told.guard.plan_position) + shift,
    )
    if told.guard.observed is not None:
        observed = told.guard.observed
        new = with_parts(
            new,
            observed=with_parts(observed, expected_position=np.asarray(observed.expected_position) + shift),
        )
    return told._replace(guard=new, estimate=with_parts(told.estimate, position=base))


def _hurried(told: State, by: np.ndarray) -> State:
    """Add to all velocities of a state, m/s."""
    new = with_parts(
        told.guard,
        expected_velocity=np.asarray(told.guard.expected_velocity) + by,
        plan_velocity=np.asarray(told.guard.plan_velocity) + by,
    )
    if told.guard.observed is not None:
        observed = told.guard.observed
        pace = np.asarray(observed.expected_velocity) + by
        new = with_parts(new, observed=with_parts(observed, expected_velocity=pace))
    pace = np.asarray(told.guard.expected_velocity) + by
    return told._replace(guard=new, estimate=with_parts(told.estimate, velocity=pace))


class Directed:
    """The comparison of one mission's guards on thresholds.

    Attributes:
        found: so far.
        stored: records of some of the states, for `flight_code_stored`.

    """

    def __init__(self, flown: Exported, kept: list[Step], rows: int) -> None:
        """Begin with states of random flights.

        Args:
            flown: the mission.
            kept: of its random steps.
            rows: how many states of these are taken along every line.

        """
        self.stored: list[np.ndarray] = []
        self.flown, guard = flown, flown.made.mission.guard
        assert guard is not None
        self.guard = guard
        self._law, memory, estimate, force, disturbance = gathered(kept, rows)
        caps = [float(error) for error in guard.assumptions.estimate_errors]
        declared = np.broadcast_to(np.array(caps), (len(force), 2))
        self._base = State(memory, estimate, force, disturbance, declared, np.zeros(len(force), bool))
        self.found = Found(0, collections.Counter(), collections.Counter(), 0, 0, 0.0, 0.0, [])
        self._python = jax.jit(jax.vmap(lambda told: guard.filter(*told)))

    def compare(self, count: int) -> Found:
        """Compare at least `count` states on thresholds."""
        rng, sensed = np.random.default_rng(3), self.flown.made.mission.setup.navigation is not None
        while self.found.states < count:
            for line in lines_of(self._base, self.guard, rng, sensed=sensed):
                self._cut(line)
        return self.found

    def _asked(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ask the C guard: memory afterwards, force and status."""
        memory = memories_of(self.flown.made, self._law, state.guard)
        doubt = np.zeros(len(state.force), DOUBT)
        doubt["errors"], doubt["contradicted"] = state.errors, state.contradicted
        given = estimates_of(state.estimate), doubt, state.force, state.disturbance
        return memory["guard"], *self.flown.code.guard(memory, *given)

    def _cut(self, line: Line) -> None:
        """Cut a line of every state at a change of status, and compare both guards there."""
        count = len(line.length)
        places = np.linspace(0.0, 1.0, SCAN)
        statuses = np.stack([self._asked(line.at(np.full(count, place), 0.0))[2] for place in places])
        changes = statuses[1:] != statuses[:-1]
        crosses = changes.any(axis=0)
        # Of the changes along a line one, by turns another.
        wanted = np.arange(count) % np.maximum(changes.sum(axis=0), 1)
        first = np.argmax(np.cumsum(changes, axis=0) > wanted, axis=0)
        low, high, before = places[first], places[first + 1], statuses[first, np.arange(count)]
        for _ in range(HALVES):
            middle = 0.5 * (low + high)
            same = self._asked(line.at(middle, 0.0))[2] == before
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        after = self._asked(line.at(high, 0.0))[2]
        named = [_change(int(old), int(new)) for old, new in zip(before, after, strict=True)]
        crossed = collections.Counter((line.name, name) for name, yes in zip(named, crosses, strict=True) if yes)
        on_it = np.zeros(count, bool)
        for end in (low, high):
            for units in SIDES:
                on_it |= self._compared(line.at(np.clip(end + units * np.spacing(end), 0.0, 1.0), 0.0), crosses)
        beside = {
            sign * aside: self._compared(line.at(high, sign * aside), crosses)
            for aside in STEPS_ASIDE
            for sign in (-1.0, 1.0)
        }
        beyond = np.any(list(beside.values()), axis=0)
        listed = []
        for row in np.flatnonzero(on_it | beyond)[:LISTED]:
            by = [f"{aside:g}" for aside, rows in beside.items() if rows[row]]
            words = f"{self.flown.name}, {line.name}: {named[row]} at {high[row]:.17g} of {line.length[row]:.6g}"
            listed.append(words + (f"; differs {', '.join(by)} beside it" if by else ""))
        self.found = self.found._replace(
            crossed=self.found.crossed + crossed,
            differ_close=self.found.differ_close + int((on_it & ~beyond).sum()),
            differ_far=self.found.differ_far + int(beyond.sum()),
            listed=self.found.listed + listed,
        )

    def _compared(self, state: State, crosses: np.ndarray) -> np.ndarray:
        """Compare both guards at states of lines that cross: where statuses differ."""
        found, by_c, status = self._asked(state)
        new, by_python, told = jax.tree.map(np.asarray, self._python(state))
        same = crosses & (status == told)
        force, memory = self.found.force, self.found.memory
        if same.any():
            expected = memories_of(self.flown.made, self._law, new)["guard"]
            unused = () if new.observed is not None else ("seen_position", "seen_velocity")
            names = [name for name in expected.dtype.names or () if name not in unused]
            force = max(force, apart(by_c[same], by_python[same], 1.0))
            memory = max(memory, *(apart(found[name][same], expected[name][same], 1.0) for name in names))
        if (some := np.flatnonzero(same)[::STORED]).size:
            taken = jax.tree.map(lambda array: np.asarray(array)[some], (self._law, state, new, by_python, told))
            self.stored.append(of_guard(self.flown.made, *taken[:2], taken[2:]))
        modes = collections.Counter(MODES[mode] for mode in (told[crosses] & 3).tolist())
        self.found = self.found._replace(
            states=self.found.states + int(crosses.sum()), modes=self.found.modes + modes, force=force, memory=memory
        )
        return crosses & (status != told)


def _change(old: int, new: int) -> str:
    """Say what two statuses differ in."""
    flags = [name for bit, name in FLAGS.items() if (old ^ new) & bit]
    modes = [f"{MODES[old & 3]} to {MODES[new & 3]}"] if (old ^ new) & 3 else []
    return ", ".join(modes + flags)

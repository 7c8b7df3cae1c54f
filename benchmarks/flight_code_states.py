"""Random steps and closed loops by which the exported C is compared with Python.

Each random step starts from Python's memory, put into the C code's, so that differences do not add up; estimates are
wrong, jump, are no numbers or are far away. Closed loops are each on its own.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from compiled_step import estimates_of, memories_of
from flight_code_missions import Exported

from keepout.apps.flight_code import self_test
from keepout.apps.flight_code.missions import Coded, sizes_of
from keepout.core.flight import loop
from keepout.core.motion.chaser import ThrusterModel
from keepout.core.motion.disturbance import NoDisturbance

FLIGHTS = 64
AGAIN = 150
"""Steps after which the random flights begin anew."""
CLOSED = 3000
"""Steps of a closed loop."""
TOGETHER = 40
"""Steps of a closed loop by pulses for which rounding stays rounding."""
ASKED = 1e-11
"""How near the numbers of a step should be, over their size and 1e-3 of their unit."""
NUDGES = 16


def apart(a: Any, b: Any, least: float = 1e-3) -> float:
    """Give the largest difference over the larger number plus `least`; none of equal ones, and of no numbers."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    with np.errstate(invalid="ignore", over="ignore"):
        far = np.abs(a - b) / (least + np.maximum(np.abs(a), np.abs(b)))
    return float(np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, far).max())


def members_of(record: np.ndarray, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Give what records hold, those within them too, by name."""
    for name in record.dtype.names or ():
        if record[name].dtype.names:
            yield from members_of(record[name], f"{path}{name}.")
        else:
            yield f"{path}{name}", record[name]


def navigations_apart(made: Coded, a: np.ndarray, b: np.ndarray, least: float = 1e-3) -> dict[str, float]:
    """Give how far memories of navigation are apart; of covariances over the product of both standard deviations."""
    sizes = sizes_of(made)
    window = sizes["WINDOW"]
    rows = {"set.accelerations": max(window, sizes["LATENCY"]), "set.centres": window, "set.radii": window}
    if not made.mission.scenario.guard.delay:
        rows["pending"] = 0
    found, expected = {}, dict(members_of(b))
    for name, mine in members_of(a):
        count = mine.shape[1] if mine.ndim > 1 else 1
        used = rows.get(name, count)
        x, y = (part[:, count - used :] if used < count else part for part in (mine, expected[name]))
        if name == "settled.covariance":
            spread = np.sqrt(np.einsum("kii->ki", y))
            scale = spread[:, :, None] * spread[:, None, :]
            found[name] = float((np.abs(x - y) / scale).max())
        elif x.size:
            found[name] = apart(x, y, least)
    return found


def memories_apart(made: Coded, a: np.ndarray, b: np.ndarray, least: float = 1e-3) -> dict[str, float]:
    """Give how far parts of memories, records of C, are apart; what the mission does not use is left out."""
    if made.mission.setup.navigation is not None:
        found = navigations_apart(made, a["navigation"], b["navigation"], least)
        rest = [name for name in a.dtype.names or () if name != "navigation"]
        return {f"navigation.{name}": far for name, far in found.items()} | _others_apart(made, a[rest], b[rest], least)
    return _others_apart(made, a, b, least)


def _others_apart(made: Coded, a: np.ndarray, b: np.ndarray, least: float) -> dict[str, float]:
    guard = made.mission.setup.guard
    parts = ["law", "thrusters"] if guard is None else ["law", "guard", "thrusters"]
    unused = ["push"]  # a filter's, told anew at each step
    unused += [] if guard is not None and guard.braking.observer is not None else ["seen_position", "seen_velocity"]
    names = [(part, name) for part in parts for name in a[part].dtype.names or () if name not in unused]
    return {f"{part}.{name}": apart(a[part][name], b[part][name], least) for part, name in names}


class Step(NamedTuple):
    """A step of many random flights in Python: memories before it and after it, what it is told, its answer.

    The memories are those of law, guard and thrusters, and of navigation where sensors tell. `estimate` is what the
    guard goes by; `told` is the same or what sensors say, records. `given` is the force, what the thrusters give of it
    in the mean (N), each one's pulse and its on-time (s). `known` is what navigation knew, records.
    """

    before: Any
    estimate: Any
    told: np.ndarray
    order: Any
    given: tuple[np.ndarray, ...]
    status: np.ndarray
    after: Any
    known: np.ndarray | None = None


GIVEN = ("force", "mean_force", "pulse", "on_time")
"""Of a step's answer, as `Step.given` has them."""


def given_of(order: np.ndarray) -> tuple[np.ndarray, ...]:
    """Give the same of answers of C, records."""
    return tuple(order[name] for name in GIVEN)


def fired(thrusters: ThrusterModel, memory: Any, force: Any) -> tuple[Any, tuple[Any, ...]]:
    """Fire a force (N): the memory afterwards, and `GIVEN`."""
    after, _, given = self_test.fired(thrusters, memory, force)
    return after, (force, *given)


class Flights:
    """Flights of a mission in Python, `FLIGHTS` at once: everything that they do is compiled once."""

    def __init__(self, made: Coded) -> None:
        """Take the mission as the code flies it."""
        setup = made.mission.setup
        begun = setup.thrusters.initial_state(jax.random.key(0))
        self.made = made
        self.begin = jax.jit(jax.vmap(lambda estimate: (*loop.memories(setup, estimate), begun)))

        @jax.jit
        @jax.vmap
        def step(memory: Any, estimate: Any, truth: Any, push: Any) -> Any:
            *memory, thrusters = memory
            law, guard, order, force, status = loop.command(setup, *memory, estimate)
            thrusters, given = fired(setup.thrusters, thrusters, force)
            # The code knows no world: of pulses their mean force moves it.
            moved = setup.motion.step(truth, given[1] + push, NoDisturbance(), setup.period, setup.mass)
            return (law, guard, thrusters), (given, order, status), moved

        self.step = step

    def scattered(self, rng: np.random.Generator) -> Any:
        """Give states on all sides of the target."""
        initial = self.made.mission.initial
        start = jax.tree.map(lambda a: jnp.broadcast_to(a, (FLIGHTS, *jnp.shape(a))), initial)
        places = rng.normal(size=(FLIGHTS, 3))
        places *= rng.uniform(1.0, 14.0, (FLIGHTS, 1)) / np.linalg.norm(places, axis=1)[:, None]
        speeds = rng.normal(0, 0.03, (FLIGHTS, 3))
        return with_parts(start, position=jnp.asarray(places), velocity=jnp.asarray(speeds))

    def random(self, steps: int, rng: np.random.Generator) -> Iterator[Step]:
        """Fly random steps."""
        none = np.zeros((FLIGHTS, 3))
        for number in range(-(-steps // FLIGHTS)):
            if number % AGAIN == 0:
                state = self.scattered(rng)
                memory = self.begin(state)
            estimate, before = told(state, rng), memory
            memory, (given, order, status), state = self.step(memory, estimate, state, none)
            answer = order, tuple(map(np.asarray, given)), np.asarray(status)
            yield Step(before, estimate, estimates_of(estimate), *answer, memory)

    def begun(self, rng: np.random.Generator) -> tuple[Any, np.ndarray]:
        """Give states at which whole flights begin, and a constant force for each, N."""
        initial = self.made.mission.initial
        start = jax.tree.map(lambda a: jnp.broadcast_to(a, (FLIGHTS, *jnp.shape(a))), initial)
        moved = np.asarray(start.position) + rng.uniform(-1.0, 1.0, (FLIGHTS, 3))
        start = with_parts(start, position=jnp.asarray(moved))
        return start, rng.uniform(-0.002, 0.002, (FLIGHTS, 3))

    def under(self, state: Any, pushes: np.ndarray, rng: np.random.Generator | None = None) -> Iterator[Any]:
        """Fly under constant forces (N), told the truth: the states after each step.

        With `rng` positions are a last bit off after each step, as other rounding would have them.
        """
        memory = self.begin(state)
        while True:
            memory, _, state = self.step(memory, state, state, pushes)
            if rng is not None:
                position = np.asarray(state.position)
                state = with_parts(
                    state, position=position + rng.choice([-1, 1], position.shape) * np.spacing(position)
                )
            yield state


def with_parts(batch: Any, **parts: Any) -> Any:
    """Give a batch of values with other parts; made anew, one would ask each part for the shape of a single value's."""
    return eqx.tree_at(lambda one: tuple(getattr(one, name) for name in parts), batch, tuple(parts.values()))


def told(state: Any, rng: np.random.Generator) -> Any:
    """Give wrong estimates of states."""
    count = len(state.position)
    position = state.position + rng.normal(0, 0.005, (count, 3)) * (rng.random((count, 1)) < 0.3)
    position += rng.normal(0, 0.5, (count, 3)) * (rng.random((count, 1)) < 0.03)
    position = jnp.where(rng.random((count, 1)) < 0.01, position * 10.0 ** rng.uniform(0, 300, (count, 1)), position)
    position = jnp.where(rng.random((count, 1)) < 0.01, jnp.nan, position)
    return with_parts(state, position=position, velocity=state.velocity + rng.normal(0, 3e-4, (count, 3)))


def asked(flown: Exported, memory: np.ndarray, told: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Run a step of the C code: its answers, and what it knew by samples; the memories are changed in place."""
    if flown.made.mission.setup.navigation is None:
        return flown.code.step(memory, told), None
    known, order = flown.code.step_by_samples(memory, told)
    return order, known


def knowledge_apart(a: np.ndarray | None, b: np.ndarray | None) -> tuple[float, np.ndarray]:
    """Give how far records of what is known are apart, and where their counts and flags are others."""
    if a is None or b is None:
        return 0.0, np.zeros(1, bool)
    far = max(apart(mine, dict(members_of(b))[name]) for name, mine in members_of(a))
    return far, (a["outliers"] != b["outliers"]) | (a["contradicted"] != b["contradicted"])


class Compared(NamedTuple):
    """What random steps have shown.

    Attributes:
        steps: how many.
        differ: statuses that differ.
        force: largest difference of a force, over its size and 1e-3 N, and of an on-time, over its size and 1e-3 s.
        memory: likewise of a memory's parts.
        worst: the part of the memory that differs most.
        beyond: steps of which a number differs by more than `ASKED`.
        share: of these the largest difference, over what `NUDGES` nudges of the inputs' last bits do to the C code.
        kept: steps in Python, of which later tests take theirs.

    """

    steps: int
    differ: int
    force: float
    memory: float
    worst: str
    beyond: int
    share: float
    kept: list[Step]


def compared(flown: Exported, flights: Flights, steps: int, keep: int = 16) -> Compared:
    """Step both codes from the same memories."""
    made, total = flown.made, Compared(0, 0, 0.0, 0.0, "", 0, 0.0, [])
    every = max(steps // FLIGHTS // keep, 1) | 1  # some sensors speak in every second step only
    for number, row in enumerate(flights.random(steps, np.random.default_rng(1))):
        given, after = memories_of(made, *row.before), memories_of(made, *row.after)
        held, estimate = given.copy(), row.told
        order, known = asked(flown, held, estimate)
        wrong = (order["guard_status"] != row.status) | (order["control_status"] != np.asarray(row.order.status))
        knows, otherwise = knowledge_apart(known, row.known)
        wrong |= otherwise
        force, parts = _given_apart(given_of(order), row.given), memories_apart(made, held, after)
        parts["what is known"] = knows
        worst = max(parts, key=lambda name: parts[name])
        beyond, share = total.beyond, total.share
        if max(force, parts[worst]) > ASKED:
            for flight in range(len(wrong)):
                one = slice(flight, flight + 1)
                by_c, by_python = (tuple(part[one] for part in parts) for parts in (given_of(order), row.given))
                far = _far(made, (by_c, held[one]), (by_python, after[one]))
                if far > ASKED and not wrong[flight]:
                    beyond += 1
                    share = max(share, far / max(_nudged(flown, given[one], estimate[one]), 1e-16))
        total = Compared(
            steps=total.steps + FLIGHTS,
            differ=total.differ + int(wrong.sum()),
            force=max(total.force, force),
            memory=max(total.memory, parts[worst]),
            worst=worst if parts[worst] > total.memory else total.worst,
            beyond=beyond,
            share=share,
            kept=[*total.kept, row] if number % every == 0 else total.kept,
        )
    return total


def _given_apart(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> float:
    return max(apart(x, y) for x, y in zip(a, b, strict=True))


Ended = tuple[tuple[np.ndarray, ...], np.ndarray]
"""What a step gives, and its memory afterwards."""


def _far(made: Coded, a: Ended, b: Ended) -> float:
    return max(_given_apart(a[0], b[0]), *memories_apart(made, a[1], b[1]).values())


def _nudged(flown: Exported, memory: np.ndarray, estimate: np.ndarray) -> float:
    """Give the largest difference that a last bit more or less of every input makes to a step of the C code."""
    rng, most = np.random.default_rng(6), 0.0
    held = memory.copy()
    plain = given_of(asked(flown, held, estimate)[0])
    for _ in range(NUDGES):
        near, told = memory.copy(), estimate.copy()
        for _, part in [*members_of(near), *members_of(told)]:
            if part.dtype == np.float64:
                bits = rng.integers(-1, 2, np.shape(part))
                with np.errstate(invalid="ignore", over="ignore"):
                    part += np.nan_to_num(bits * np.spacing(np.abs(part)), posinf=0.0)
        given = given_of(asked(flown, near, told)[0])
        most = max(most, _far(flown.made, (given, near), (plain, held)))
    return most


def closed_loops(flown: Exported, flights: Flights, steps: int) -> list[tuple[float, float]]:
    """Fly whole flights by both codes, each on its own, and by Python a last bit beside itself.

    Where two ways are as good, or a delay is long for its observer, rounding grows as any difference does; Python is
    the measure of that.

    Returns:
        Of each flight how far from Python it ends, m: the C code's, and Python's with positions a last bit off after
        each step.

    """
    start, pushes = flights.begun(np.random.default_rng(2))
    by_c = flown.code.fly(estimates_of(start), pushes, steps)["position"]
    together = zip(flights.under(start, pushes), flights.under(start, pushes, np.random.default_rng(3)), strict=True)
    end, beside = next(itertools.islice(together, steps - 1, None))
    far, own = (
        np.linalg.norm(np.asarray(place) - np.asarray(end.position), axis=1) for place in (by_c, beside.position)
    )
    return [(float(one), float(itself)) for one, itself in zip(far, own, strict=True)]


def pulsed_loops(flown: Exported, flights: Flights, steps: int) -> tuple[float, float, float]:
    """Fly whole flights by pulses, by both codes and by Python from a last bit beside: how far apart they are, m.

    Below its least on-time a thruster does nothing, so that law and motion are parted there, and rounding grows as any
    difference does: by the first pulse that one fires and the other does not, flights are different ones. So Python is
    the measure of itself.

    Returns:
        Of `TOGETHER` steps the largest distance from Python; of all steps the median distances, of the C code from
        Python and of Python from itself.

    """
    start, pushes = flights.begun(np.random.default_rng(2))
    beside = with_parts(start, position=np.nextafter(np.asarray(start.position), np.inf))
    state = estimates_of(start)
    memory = flown.code.begin(state)
    early, together = 0.0, zip(flights.under(start, pushes), flights.under(beside, pushes), strict=True)
    for number, (by_python, by_itself) in zip(range(steps), together, strict=False):
        flown.code.move(state, flown.code.step(memory, state)["mean_force"] + pushes)
        truth = np.asarray(by_python.position)
        by_c, own = (np.linalg.norm(place - truth, axis=1) for place in (state["position"], by_itself.position))
        early = max(early, float(by_c.max())) if number < TOGETHER else early
    return early, float(np.median(by_c)), float(np.median(own))


def gathered(kept: list[Step], rows: int) -> tuple[Any, Any, Any, np.ndarray, np.ndarray]:
    """Gather states of random flights: memories of law and guard, estimates, the law's forces and disturbances (N)."""
    picked = [(*row.before[:2], row.estimate, row.order.force, row.order.disturbance_estimate) for row in kept]
    whole = jax.tree.map(lambda *parts: np.concatenate([np.asarray(part) for part in parts]), *picked)
    some = np.random.default_rng(4).choice(len(whole[3]), min(rows, len(whole[3])), replace=False)
    return jax.tree.map(lambda array: array[some], whole)

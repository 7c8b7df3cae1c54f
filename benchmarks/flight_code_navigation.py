"""What sensors say, to the exported C and to Python: random flights, and samples on the thresholds of filter and set.

Samples are lost, late, wrong, wrong for a while, no numbers or far away. Where along a ray of samples another number of
them is left out, or the set is contradicted, the ray is cut in halves down to two neighbouring numbers. On such a
threshold both codes round apart, and one may leave out what the other takes: that is counted, and must not be so beside
it.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from compiled_step import KNOWLEDGE, estimates_of, memories_of, samples_of
from flight_code_missions import Exported
from flight_code_states import FLIGHTS, Flights, Step, fired, knowledge_apart, navigations_apart, with_parts
from flight_code_stored import BEGINNING, of_navigation, stored_type

from keepout.apps.flight_code.missions import Coded
from keepout.core.flight import loop
from keepout.core.flight.navigation import Knowledge, Sample
from keepout.core.motion.disturbance import NoDisturbance

AGAIN = 150
"""Steps after which the random flights begin anew."""
SPELL = 12
"""Steps for which a sensor goes on being wrong, at most."""
HALVES, RAYS, STORED = 60, 4, 5
SIDES = (0, 1, -1, 3, -8)
"""Units in the last place by which samples on a threshold are moved."""
ASIDE = 1e-8
"""How far from a threshold counts and flags must agree, over the length of the ray."""


def known_of(knowledge: Knowledge) -> np.ndarray:
    """Give what is known, with a leading axis, as records."""
    told = np.zeros(len(knowledge.outliers), KNOWLEDGE)
    told["estimate"], told["known"] = estimates_of(knowledge.estimate), estimates_of(knowledge.known.state)
    told["disturbance"], told["outliers"] = knowledge.estimate.disturbance, knowledge.outliers
    told["errors"], told["contradicted"] = knowledge.known.errors, knowledge.known.contradicted
    return told


class SampledFlights(Flights):
    """Flights of a mission with sensors in Python, `FLIGHTS` at once."""

    def __init__(self, made: Coded) -> None:
        """Take the mission as the code flies it."""
        setup = made.mission.setup
        navigation = setup.navigation
        assert navigation is not None
        self.made, self.navigation, self.delay = made, navigation, navigation.delay
        thrusters = setup.thrusters.initial_state(jax.random.key(0))

        def begun(estimate: Any, samples: Any, under_way: Any) -> Any:
            knowing = navigation.begin(estimate, under_way)
            knowledge = navigation.know(knowing, samples)[1]
            law, guard = loop.memories(setup, knowledge.estimate, knowledge.known.state, under_way)
            return law, guard, thrusters, knowing

        self.begun_with = jax.jit(jax.vmap(begun, in_axes=(0, 0, None)))
        self.sensors = jax.jit(jax.vmap(lambda key, truth: navigation.suite.initial_state(key, truth)))
        self.sample = jax.jit(jax.vmap(lambda state, truth: navigation.suite.sample(state, truth)))
        self.know = jax.jit(jax.vmap(lambda state, samples: navigation.know(state, samples)))
        self.told = jax.jit(jax.vmap(lambda state, force: navigation.told(state, force)))

        @jax.jit
        @jax.vmap
        def step(memory: Any, samples: Any, truth: Any, acting: Any) -> Any:
            law, guard, thrusters, knowing = memory
            knowing, knowledge = navigation.know(knowing, samples)
            known = knowledge.known
            law, guard, order, force, status = loop.command(setup, law, guard, knowledge.estimate, known)
            knowing = navigation.told(knowing, force)
            thrusters, given = fired(setup.thrusters, thrusters, force)
            push = given[1] if acting is None else acting
            moved = setup.motion.step(truth, push, NoDisturbance(), setup.period, setup.mass)
            return (law, guard, thrusters, knowing), (given, order, status), knowledge, moved

        self.step = step

    def first(self, truth: Any, rng: np.random.Generator) -> Any:
        """Give estimates that are off by no more than the navigation is declared to begin with."""
        place, pace = np.asarray(self.navigation.initial_errors) / np.sqrt(3.0)
        shape = np.shape(truth.position)
        position = truth.position + rng.uniform(-place, place, shape)
        return with_parts(truth, position=position, velocity=truth.velocity + rng.uniform(-pace, pace, shape))

    def random(self, steps: int, rng: np.random.Generator) -> Iterator[Step]:
        """Fly random steps."""
        wrong = _Wrong(len(self.navigation.suite.sensors))
        for number in range(-(-steps // FLIGHTS)):
            if number % AGAIN == 0:
                truth = self.scattered(rng)
                keys = jax.random.split(jax.random.key(number), FLIGHTS)
                sensors = self.sensors(keys, truth)
                samples = self.sample(sensors, truth)[1]
                memory = self.begun_with(self.first(truth, rng), samples, jnp.zeros((8, 3)))
                late = [jnp.zeros((FLIGHTS, 3))] * self.delay
            before = memory
            sensors, samples = self.sample(sensors, truth)
            told = wrong.told(samples, rng)
            acting = late.pop(0) if self.delay else None
            memory, (given, order, status), knowledge, truth = self.step(memory, told, truth, acting)
            late += [given[1]] * bool(self.delay)
            answer = order, tuple(map(np.asarray, given)), np.asarray(status)
            yield Step(before, knowledge.known.state, samples_of(told), *answer, memory, known_of(knowledge))

    def beginnings(self, rng: np.random.Generator) -> np.ndarray:
        """Give records of beginnings, with forces under way."""
        truth = self.scattered(rng)
        sensors = self.sensors(jax.random.split(jax.random.key(1), FLIGHTS), truth)
        samples, sent = self.sample(sensors, truth)[1], rng.uniform(-0.05, 0.05, (8, 3))
        estimate = self.first(truth, rng)
        records = np.zeros(FLIGHTS, stored_type(self.made))
        records["kind"], records["under_way"], records["estimate"] = BEGINNING, sent, estimates_of(estimate)
        records["samples"] = samples_of(samples)
        records["after"] = memories_of(self.made, *self.begun_with(estimate, samples, jnp.asarray(sent)))
        for name in ("owed", "tail"):
            records["before"]["thrusters"][name] = 1.0  # of another flight
        return records


class _Wrong:
    """What goes wrong with samples, sensor by sensor and flight by flight; some of it for a while."""

    def __init__(self, sensors: int) -> None:
        self.left = np.zeros((sensors, FLIGHTS), int)
        self.silent = np.zeros((sensors, FLIGHTS), bool)
        self.off = np.zeros((sensors, FLIGHTS))

    def told(self, samples: tuple[Sample, ...], rng: np.random.Generator) -> tuple[Sample, ...]:
        """Give samples as they are told."""
        shape = self.left.shape
        begin = (self.left == 0) & (rng.random(shape) < 0.02)
        self.left = np.where(begin, rng.integers(1, SPELL, shape), np.maximum(self.left - 1, 0))
        self.silent = np.where(begin, rng.random(shape) < 0.3, self.silent)
        self.off = np.where(begin, 10.0 ** rng.uniform(-3, 3, shape) * rng.choice([-1.0, 1.0], shape), self.off)
        told = []
        for i, sample in enumerate(samples):
            value, spell = np.array(sample.value), self.left[i] > 0
            value += np.where(spell & ~self.silent[i], self.off[i], 0.0)[:, None]
            away = rng.random(FLIGHTS) < 0.02
            value += np.where(away[:, None], rng.normal(0, 0.5, value.shape), 0.0)
            far = rng.random(FLIGHTS) < 0.01
            value *= np.where(far, 10.0 ** rng.uniform(0, 300, FLIGHTS), 1.0)[:, None]
            value[rng.random(FLIGHTS) < 0.01, rng.integers(value.shape[1])] = np.nan
            came = np.asarray(sample.came) & ~(spell & self.silent[i]) & (rng.random(FLIGHTS) > 0.02)
            told.append(Sample(jnp.asarray(value), jnp.asarray(came)))
        return tuple(told)


def sampled_loops(flown: Exported, flights: SampledFlights, steps: int) -> float:
    """Fly whole flights by both codes, each on its own, with sensors of the same errors: how far apart they end, m."""
    truth = flights.begun(np.random.default_rng(2))[0]
    sensors = mine = flights.sensors(jax.random.split(jax.random.key(2), FLIGHTS), truth)
    samples, first = flights.sample(sensors, truth)[1], flights.first(truth, np.random.default_rng(3))
    memory = flights.begun_with(first, samples, jnp.zeros((8, 3)))
    held, state = flown.code.begin(estimates_of(first), None, samples_of(samples)), estimates_of(truth)
    late, pending = ([np.zeros((FLIGHTS, 3))] * flights.delay for _ in range(2))
    for _ in range(steps):
        there = with_parts(truth, **{name: jnp.asarray(state[name]) for name in state.dtype.names or ()})
        sensors, samples = flights.sample(sensors, truth)
        mine, told = flights.sample(mine, there)
        acting = late.pop(0) if flights.delay else None
        memory, (given, _, _), _, truth = flights.step(memory, samples, truth, acting)
        pending.append(flown.code.step_by_samples(held, samples_of(told))[1]["mean_force"])
        late += [np.asarray(given[1])] * bool(flights.delay)
        flown.code.move(state, pending.pop(0))
    return float(np.linalg.norm(state["position"] - np.asarray(truth.position), axis=1).max())


class Found(NamedTuple):
    """What samples on thresholds have shown.

    Attributes:
        states: how many were compared.
        crossed: rays that were cut at a threshold.
        on_it: states on a threshold of which one alone leaves out a sample, or finds that it contradicts the set.
        beside: the same a little beside one.
        known: largest difference of what is known, where counts and flags agree, over its size and 1e-3 of its unit.
        memory: likewise of what is remembered.
        worst: the part of the memory that differs most.
        records: some of them, for `flight_code_stored`.

    """

    states: int
    crossed: int
    on_it: int
    beside: int
    known: float
    memory: float
    worst: str
    records: list[np.ndarray]


def compared(flown: Exported, flights: SampledFlights, kept: list[Step], count: int) -> Found:
    """Compare navigations alone at no fewer than `count` samples on thresholds, from memories of random flights."""
    asked = _Asked(flown, flights)
    rng = np.random.default_rng(9)
    while asked.found.states < count:
        for row in kept:
            for _ in range(RAYS):
                asked.cut(row, rng)
            if asked.found.states >= count:
                break
    return asked.found


def _decided(known: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """Give what was decided of samples, (n, decisions): of records of what is known, and of memories afterwards."""
    held = memory["navigation"]
    counts = [held["settled"]["left_out"], held["set"]["contradictions"], held["set"]["elapsed"][:, None]]
    return np.column_stack([known["outliers"], known["contradicted"], *counts])


class _Asked:
    """Both navigations, and what they have answered."""

    def __init__(self, flown: Exported, flights: SampledFlights) -> None:
        self.flown, self.flights = flown, flights
        self.found = Found(0, 0, 0, 0, 0.0, 0.0, "", [])

    def cut(self, row: Step, rng: np.random.Generator) -> None:
        """Cut rays of samples of a step where one sensor is further and further off, and compare both codes there."""
        memory, told = memories_of(self.flown.made, *row.before), row.told.copy()
        flights, sensors = told.shape
        told["value"] = np.where(np.isfinite(told["value"]) & (np.abs(told["value"]) < 1e6), told["value"], 1.0)
        which = rng.integers(sensors, size=flights)
        told["came"][np.arange(flights), which] = True
        way = np.zeros((flights, sensors, 4))
        way[np.arange(flights), which] = rng.normal(size=(flights, 4)) * 10.0 ** rng.uniform(-2, 1, (flights, 1))
        force = np.where(np.isfinite(row.given[0]), row.given[0], 0.0)

        def at(place: np.ndarray) -> np.ndarray:
            moved = told.copy()
            moved["value"] += way * place[:, None, None]
            return moved

        def flags(place: np.ndarray) -> np.ndarray:
            held = memory.copy()
            return _decided(self.flown.code.navigate(held, at(place), force), held)

        places = np.linspace(0.0, 1.0, 9)
        answers = np.stack([flags(np.full(flights, place)) for place in places])
        changes = np.any(answers[1:] != answers[:-1], axis=2)
        crosses = changes.any(axis=0)
        first = np.argmax(changes, axis=0)
        low, high, begun = places[first], places[first + 1], answers[first, np.arange(flights)]
        for _ in range(HALVES):
            middle = 0.5 * (low + high)
            same = np.all(flags(middle) == begun, axis=1)
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        self.found = self.found._replace(crossed=self.found.crossed + int(crosses.sum()))
        for end in (low, high):
            for units in SIDES:
                self._compare(row, memory, at(end + units * np.spacing(end)), force, crosses, on_it=True)
        for aside in (-ASIDE, ASIDE):
            self._compare(row, memory, at(high + aside), force, crosses, on_it=False)

    def _compare(
        self, row: Step, memory: np.ndarray, told: np.ndarray, force: np.ndarray, crosses: np.ndarray, *, on_it: bool
    ) -> None:
        held = memory.copy()
        by_c = self.flown.code.navigate(held, told, force)
        knowing, knowledge = self.flights.know(row.before[3], self._samples(told))
        known = known_of(knowledge)
        after = memories_of(self.flown.made, *row.before[:3], self.flights.told(knowing, jnp.asarray(force)))
        other = np.any(_decided(by_c, held) != _decided(known, after), axis=1)
        # Of two things that contradict, one believed in the other's place leaves every count alike.
        other |= np.any(np.abs(by_c["errors"] - known["errors"]) > ASIDE + 1e-6 * known["errors"], axis=1)
        other &= crosses
        same = crosses & ~other
        found = self.found
        if not same.any():
            return
        far = knowledge_apart(by_c[same], known[same])[0]
        parts = navigations_apart(self.flown.made, held["navigation"][same], after["navigation"][same])
        worst = max(parts, key=lambda name: parts[name])
        some = np.flatnonzero(same)[::STORED]
        record = of_navigation(self.flown.made, memory[some], (told[some], force[some]), (known[some], after[some]))
        self.found = Found(
            states=found.states + int(crosses.sum()),
            crossed=found.crossed,
            on_it=found.on_it + (int(other.sum()) if on_it else 0),
            beside=found.beside + (0 if on_it else int(other.sum())),
            known=max(found.known, far),
            memory=max(found.memory, parts[worst]),
            worst=worst if parts[worst] > found.memory else found.worst,
            records=[*found.records, record],
        )

    def _samples(self, told: np.ndarray) -> tuple[Sample, ...]:
        sizes = [sample.value.shape[-1] for sample in self._shapes()]
        return tuple(
            Sample(jnp.asarray(told["value"][:, i, :size]), jnp.asarray(told["came"][:, i]))
            for i, size in enumerate(sizes)
        )

    def _shapes(self) -> tuple[Sample, ...]:
        truth = self.flown.made.mission.initial
        return jax.eval_shape(
            lambda key: self.flights.navigation.suite.sample(
                self.flights.navigation.suite.initial_state(key, truth), truth
            )[1],
            jax.random.key(0),
        )

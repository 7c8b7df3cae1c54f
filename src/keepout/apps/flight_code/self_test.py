"""The self-test of a mission's flight code: steps that Python has flown, what each was told and what it answered.

They begin half a minute before the flight is nearest to the target. What is told is wrong within what the guard is
declared, or within what the sensors' errors may be; some of it is no number, some of it jumps or does not come.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from keepout.apps.flight_code.mission_tables import value_text
from keepout.apps.flight_code.missions import Coded
from keepout.core.fields.field import values
from keepout.core.flight.navigation import Navigation
from keepout.core.motion.chaser import Firing, ThrusterModel
from keepout.core.motion.relative import MotionState
from keepout.flights.on_board import OnBoard, Order
from keepout.flights.thrusters.on_off import OnOffThrusters

STEPS = 64
"""Stored in the self-test."""
_BLIND, _JUMP, _SILENT = (20, 21), 40, (30, 31)
"""Of these the steps at which what is told is not a number, the one at which it jumps half a metre, and those at which
no sample comes."""


class Answer(NamedTuple):
    """What a step answers in Python: of `keepout_order` all in its order.

    Attributes:
        order: law's and guard's.
        mean_force: of what is fired, N, body axes.
        pulse: of each thruster, s; one of 0 s without a layout.
        on_time: likewise.

    """

    order: Order
    mean_force: np.ndarray
    pulse: np.ndarray
    on_time: np.ndarray


Said = tuple[tuple[bool, np.ndarray], ...]
"""Of each sensor whether a sample came, and its numbers."""


class Stored(NamedTuple):
    """The steps.

    Attributes:
        first: the estimate that they begin from.
        told: to each step: an estimate, or what the sensors say.
        answered: by each.

    """

    first: MotionState
    told: list[MotionState] | list[Said]
    answered: list[Answer]


def fired(thrusters: ThrusterModel, memory: Any, force: Any) -> tuple[Any, Firing, tuple[Array, Array, Array]]:
    """Fire a force (3,), N, for a control period.

    Returns:
        The memory afterwards, the firing, and of an `Answer` the mean force (N), pulses and on-times (s). A pulse is
        how long a thruster is commanded to be on: what the firing tells of it is late.

    """
    memory, firing = thrusters.fire(memory, force)
    if not isinstance(thrusters, OnOffThrusters):
        return memory, firing, (firing.force, jnp.zeros(1), jnp.zeros(1))
    assert firing.pulses is not None
    assert firing.on_time is not None
    pulse = thrusters.period - 2.0 * (firing.pulses.begin[len(thrusters.push) :] - thrusters.rise_delay)
    return memory, firing, (firing.force, pulse, firing.on_time)


class _States:
    """Steps that are told the state."""

    def __init__(self, made: Coded) -> None:
        self._entry = made.mission.scenario.guard
        self.board = OnBoard(made.mission.setup, made.mission.initial)

    def begin(self, truth: MotionState, rng: np.random.Generator) -> MotionState:
        """Begin from a state."""
        self.board.restart(truth, under_way=[])
        return truth

    def step(self, truth: MotionState) -> Any:
        """Step in a flight, told the truth; the force."""
        return self._stepped(truth)

    def disturbed(self, truth: MotionState, number: int, rng: np.random.Generator) -> tuple[MotionState, Any]:
        """Step as stored: what was told, and the force."""
        errors = [[self._entry.position_error], [self._entry.velocity_error]]
        noise = rng.uniform(-0.5, 0.5, (2, 3)) * errors * (number > 0)
        noise[0] += 0.5 if number == _JUMP else 0.0
        estimate = truth.moved(*jnp.asarray(noise))
        if number in _BLIND:
            estimate = dataclasses.replace(estimate, position=jnp.full(3, jnp.nan))
        return jax.tree.map(np.asarray, estimate), self._stepped(estimate)

    def _stepped(self, told: MotionState) -> Any:
        parts = (told.position, told.velocity, told.attitude, told.angular_velocity)
        return self.board.step(float(told.time), *(np.asarray(part) for part in parts))


class _Samples:
    """Steps that are told what the sensors say."""

    def __init__(self, made: Coded, navigation: Navigation) -> None:
        setup, suite = made.mission.setup, navigation.suite
        self._navigation, self._period = navigation, float(setup.period)
        self._begin = jax.jit(lambda key, truth: suite.initial_state(key, truth))
        self._sample = jax.jit(lambda states, truth: suite.sample(states, truth))
        self.board = OnBoard(setup, made.mission.initial, by_samples=True)
        self._sensors = self._begin(jax.random.key(0), made.mission.initial)

    def begin(self, truth: MotionState, rng: np.random.Generator) -> MotionState:
        """Begin from an estimate that is wrong within what the navigation is declared."""
        self._sensors = self._begin(jax.random.key(1), truth)
        noise = rng.uniform(-0.5, 0.5, (2, 3)) * np.asarray(self._navigation.initial_errors)[:, None]
        estimate = truth.moved(*jnp.asarray(noise))
        self.board.restart(estimate, under_way=[])
        return estimate

    def step(self, truth: MotionState) -> Any:
        """Step in a flight, told what the sensors say; the force."""
        return self._stepped(truth, self._said(truth))

    def disturbed(self, truth: MotionState, number: int, rng: np.random.Generator) -> tuple[Said, Any]:
        """Step as stored: what was told, and the force."""
        said = self._said(truth)
        if number in _SILENT:
            said = tuple((False, value) for _, value in said)
        if number in _BLIND:
            said = tuple((came, np.full_like(value, np.nan)) for came, value in said)
        if number == _JUMP:
            said = tuple((came, value + 0.5) for came, value in said)
        return said, self._stepped(truth, said)

    def _said(self, truth: MotionState) -> Said:
        self._sensors, samples = self._sample(self._sensors, truth)
        return tuple((bool(sample.came), np.asarray(sample.value)) for sample in samples)

    def _stepped(self, truth: MotionState, said: Said) -> Any:
        time, sensors = float(truth.time), self._navigation.suite.sensors
        ages = (sensor.latency * self._period for sensor in sensors)
        taken = [(time - age, value) if came else None for age, (came, value) in zip(ages, said, strict=True)]
        return self.board.step(time, samples=taken)


def stored_steps(made: Coded) -> Stored:
    """Fly steps in Python as the code flies them."""
    mission, setup, states = made.mission, made.mission.setup, [made.mission.initial]
    flown = _States(made) if setup.navigation is None else _Samples(made, setup.navigation)

    fire = jax.jit(lambda memory, force: fired(setup.thrusters, memory, force))

    @jax.jit
    def moved(state: MotionState, firing: Firing) -> MotionState:
        period, mass = setup.period, setup.mass
        return setup.motion.step(state, firing.force, setup.disturbance, period, mass, firing.pulses)

    begun = memory = setup.thrusters.initial_state(jax.random.key(0))
    # What is fired takes effect late, as the set of a suite must have it. Told states know of no delay: there the law's
    # observer would add up what the two codes round apart.
    delay = 0 if setup.navigation is None else mission.scenario.guard.delay
    nothing = [fire(begun, np.zeros(3))[1]] * delay
    under_way = list(nothing)
    for _ in range(mission.steps):
        memory, firing, _ = fire(memory, flown.step(states[-1]))
        under_way.append(firing)
        states.append(moved(states[-1], under_way.pop(0)))
    away = values(made.law.velocity.field, np.array([state.position for state in states]))
    state = states[max(int(np.argmin(away)) - STEPS // 2, 0)]
    rng, told, answered = np.random.default_rng(0), [], []
    first = flown.begin(state, rng)
    memory, under_way = begun, list(nothing)
    for number in range(STEPS):
        said, force = flown.disturbed(state, number, rng)
        told.append(said)
        memory, firing, given = fire(memory, force)
        under_way.append(firing)
        state = moved(state, under_way.pop(0))
        answered.append(Answer(flown.board.order, *map(np.asarray, given)))
    return Stored(first, told, answered)


def header(said: str, *lines: str) -> str:
    """Give a header that only one program includes."""
    head = [f"/* {said}; written by `keepout export --to c`. */", "#include <math.h>", "", '#include "keepout.h"', ""]
    return "\n".join([*head, *lines, ""])


def selftest_text(made: Coded) -> str:
    """Give selftest_steps.h."""
    first, told, answered = stored_steps(made)
    kind = "keepout_estimate selftest_told[SELFTEST_STEPS]"
    if made.mission.setup.navigation is not None:
        kind = "keepout_sample selftest_told[SELFTEST_STEPS][KEEPOUT_SENSORS]"
    return header(
        "Stored steps: what each is told, and what Python answers",
        f"#define SELFTEST_STEPS {STEPS}",
        "",
        f"static const keepout_estimate selftest_begin = {estimate_text(first)};",
        f"static const {kind} = {{",
        *[f"    {estimate_text(one) if isinstance(one, MotionState) else _said_text(one)}," for one in told],
        "};",
        "static const keepout_order selftest_orders[SELFTEST_STEPS] = {",
        *[f"    {{{', '.join(value_text(part) for part in (*order, *given))}}}," for order, *given in answered],
        "};",
    )


def _said_text(said: Said) -> str:
    return value_text([{"came": came, "value": value} for came, value in said])


def estimate_text(state: MotionState) -> str:
    """Give a state as a C initialiser of `keepout_estimate`."""
    parts = (state.time, state.position, state.velocity, state.attitude, state.angular_velocity)
    return "{" + ", ".join(value_text(part) for part in parts) + "}"

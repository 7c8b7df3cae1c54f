"""Segments put together are the flight; what is new in a segment leaves the memories as they are."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.flights import GOAL, KEY, Delayed, Halving, Spring, make_setup, start_state

from keepout.errors import FlightError
from keepout.flight import loop
from keepout.flight.faults import WrongEstimate
from keepout.flight.segment import begin, fly_segment, joined


def segments(setup, lengths):
    state, logs = begin(setup, start_state(setup), KEY), []
    for length in lengths:
        state, log = fly_segment(setup, state, length)
        logs.append(log)
    return state, joined(logs)


@pytest.mark.long
@pytest.mark.parametrize("faults", [Delayed(), WrongEstimate(0.01, 0.001, 0.02, 0.002)])
def test_segments_joined_are_one_flight_to_the_bit(faults):
    setup = make_setup(guard=Halving(), faults=faults)
    whole = loop.fly(setup, start_state(setup), 24, KEY)
    for lengths in ([10, 14, 1], [1] * 25):
        rows = segments(setup, lengths)[1]
        for name, one, other in zip(
            (f.name for f in dataclasses.fields(whole)), vars(whole).values(), vars(rows).values(), strict=True
        ):
            assert (one is None) == (other is None)
            np.testing.assert_array_equal(one, other, err_msg=f"{name} in {lengths}")


def test_a_new_goal_leaves_every_memory():
    setup = make_setup(guard=Halving(), faults=Delayed())
    state, _ = segments(setup, [10])
    moved = GOAL + jnp.array([3.0, 0.0, 0.0])
    other = dataclasses.replace(setup, controller=Spring(setup.motion, moved), goal=moved)
    _, log = fly_segment(other, state, 1)
    _, usual = fly_segment(setup, state, 1)
    for name in ("time", "position", "velocity", "estimated_position", "disturbance_estimate"):
        np.testing.assert_array_equal(getattr(log, name), getattr(usual, name))
    # The law's count and the command under way go on; only what follows from the goal is new.
    assert int(log.control_status[0]) == int(usual.control_status[0]) == 10 % 3
    np.testing.assert_array_equal(log.force, usual.force)
    assert not np.array_equal(log.commanded_force, usual.commanded_force)


def test_a_segment_has_a_step():
    setup = make_setup()
    with pytest.raises(FlightError, match="steps is 0"):
        fly_segment(setup, begin(setup, start_state(setup), KEY), 0)
    with pytest.raises(FlightError, match="steps is 6; longest is 5"):
        fly_segment(setup, begin(setup, start_state(setup), KEY), 6, longest=5)


def test_segments_of_any_length_share_a_program_that_has_room_for_them():
    setup = make_setup(guard=Halving(), faults=Delayed())
    compiled = []

    class Counting(Spring):
        def step(self, count, estimate):
            compiled.append(1)  # runs when traced, not when flown
            return super().step(count, estimate)

    counting = dataclasses.replace(setup, controller=Counting(setup.motion, GOAL))
    state, logs, traced = begin(counting, start_state(setup), KEY), [], 0
    for length in (1, 7, 4, 7, 2):
        state, log = fly_segment(counting, state, length, longest=7)
        assert len(log.time) == length
        logs.append(log)
        traced = len(compiled) if len(logs) == 1 else traced
        assert len(compiled) == traced > 0
    one, other = joined(logs), segments(setup, [21])[1]
    for name, rows in vars(one).items():
        if rows is not None:
            np.testing.assert_array_equal(rows, getattr(other, name), err_msg=name)
    with pytest.raises(FlightError, match="longest is 7"):
        fly_segment(counting, state, 8, longest=7)


def test_one_program_flies_every_goal_and_every_number_of_steps():
    setup = make_setup()
    state = begin(setup, start_state(setup), KEY)
    compiled = []

    class Counting(Spring):
        def step(self, count, estimate):
            compiled.append(1)  # runs when traced, not when flown
            return super().step(count, estimate)

    traced = None
    for shift in range(4):
        goal = GOAL + float(shift)
        led = dataclasses.replace(setup, controller=Counting(setup.motion, goal), goal=goal)
        for steps in (6, 3):
            state, log = fly_segment(led, state, steps)
            assert log.time.shape == (steps,)
            traced = len(compiled) if traced is None else traced
            assert len(compiled) == traced > 0


def test_one_program_flies_whole_flights_of_other_lengths():
    setup = make_setup()
    compiled = []

    class Counting(Spring):
        def step(self, count, estimate):
            compiled.append(1)
            return super().step(count, estimate)

    setup = dataclasses.replace(setup, controller=Counting(setup.motion, GOAL))
    first = loop.fly(setup, start_state(setup), 40, KEY)
    traced = len(compiled)
    assert traced > 0
    shorter = loop.fly(setup, start_state(setup), 20, KEY)
    assert len(compiled) == traced
    np.testing.assert_array_equal(shorter.position, first.position[:21])
    assert loop.room_for(41) == 64
    for rows in (1, 16, 17, 64, 65, 4096, 4097):
        assert loop.room_for(rows) >= max(rows, 16)

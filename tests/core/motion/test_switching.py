"""Disturbances that jump, against the closed form of a point mass under a square wave."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.flights import make_setup

from keepout.core.errors import ScenarioError
from keepout.core.motion.attitude import InertiallyFixed, Tumbling
from keepout.core.motion.disturbance import (
    CombinedDisturbance,
    ConstantDisturbance,
    SinusoidalDisturbance,
    SquareWaveDisturbance,
    resonant,
)
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion

pytestmark = pytest.mark.long

MASS = 20.0
# So far from the Earth that a chaser near the target's centre feels no gravity difference: a double integrator.
FREE = RelativeMotion(Orbit(1e16), InertiallyFixed())
AMPLITUDE = np.array([0.03, -0.01, 0.02])


def square_wave_truth(wave_period, delay, start, stop):
    """Integral and double integral over [start, stop] of a unit square wave, by its triangle wave."""

    def integral(time):
        phase = np.mod(time - delay, wave_period)
        return np.minimum(phase, wave_period - phase)

    half = 0.5 * wave_period
    first, last = np.floor((start - delay) / half), np.floor((stop - delay) / half)
    switches = delay + half * np.arange(first + 1, last + 1)
    times = np.concatenate([[start], switches[(switches > start) & (switches < stop)], [stop]])
    heights = integral(times) - integral(start)  # piecewise linear between its corners
    return heights[-1], np.sum(0.5 * (heights[1:] + heights[:-1]) * np.diff(times))


def steps(disturbance, period, number, motion=FREE):
    """Positions and velocities at the control instants, (number + 1, 3) each."""
    state = MOVING if motion is FREE else motion.initial_state(jnp.zeros(3), jnp.zeros(3))
    return tuple(np.asarray(rows)[: number + 1] for rows in _steps(disturbance, jnp.asarray(period), motion, state))


@eqx.filter_jit
def _steps(disturbance, period, motion, state):
    def advance(state, _):
        return motion.step(state, jnp.zeros(3), disturbance, period, MASS), (state.position, state.velocity)

    return jax.lax.scan(advance, state, length=MOST + 1)[1]


MOST = 240
"""Steps of every flight: those that are added are not looked at."""
MOVING = FREE.initial_state(np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("period", [1.0, 0.1, 2.0, 0.3])
def test_a_resonant_force_changes_the_velocity_by_its_full_strength_each_step(period):
    # Few steps, since summed periods carry rounding that moves the control instants against the switches.
    _, velocity = steps(resonant(AMPLITUDE, period), period, 100)
    expected = (-1.0) ** np.arange(100)[:, None] * AMPLITUDE * period / MASS
    np.testing.assert_allclose(np.diff(velocity[:101], axis=0), expected, rtol=1e-12, atol=1e-17)


def check_integrated_exactly(wave_period, delay, number, **most):
    position, velocity = steps(SquareWaveDisturbance(AMPLITUDE, wave_period, delay, **most), 1.0, number)
    gained, moved = square_wave_truth(wave_period, delay, 0.0, float(number))
    np.testing.assert_allclose(velocity[-1], AMPLITUDE / MASS * gained, atol=1e-13)
    np.testing.assert_allclose(position[-1], AMPLITUDE / MASS * moved, atol=1e-11)


@given(st.floats(2.0, 300.0), st.floats(0.0, 50.0))
def test_a_square_wave_is_integrated_exactly_wherever_it_switches(wave_period, delay):
    check_integrated_exactly(wave_period, delay, 150)


@pytest.mark.parametrize(("wave_period", "most"), [(0.37, 6), (1.0, 2), (0.5, 4)])
def test_several_switches_a_step(wave_period, most):
    check_integrated_exactly(wave_period, 0.11, 40, most_switches=most)


def test_sums_switch_at_every_parts_switches():
    slow, fast = SquareWaveDisturbance(AMPLITUDE, 7.3, 0.2), SquareWaveDisturbance(-2 * AMPLITUDE, 2.7, 0.9)
    smooth = SinusoidalDisturbance(np.full((1, 3), 0.01), np.full((1, 3), 0.05), np.zeros((1, 3)))
    both = CombinedDisturbance((smooth, slow, ConstantDisturbance([0.01, 0.0, 0.0]), fast))
    _, velocity = steps(both, 1.0, 60)
    expected = AMPLITUDE * square_wave_truth(7.3, 0.2, 0.0, 60.0)[0]
    expected = expected - 2 * AMPLITUDE * square_wave_truth(2.7, 0.9, 0.0, 60.0)[0]
    expected = expected + [0.6, 0.0, 0.0] + 0.01 / 0.05 * (1 - np.cos(0.05 * 60.0))
    np.testing.assert_allclose(velocity[-1], expected / MASS, atol=1e-11)  # the sine's own Runge–Kutta error


def test_a_tumbling_target_sees_the_same_push_as_fine_steps_that_end_at_the_switches():
    turning = Tumbling([0.002, -0.004, 0.003], np.diag([120.0, 90.0, 60.0]))
    wave = SquareWaveDisturbance(AMPLITUDE, 3.0, 0.25)
    coarse = steps(wave, 1.0, 60, RelativeMotion(Orbit(7e6), turning))
    fine = steps(wave, 0.25, 240, RelativeMotion(Orbit(7e6), turning))
    for one, other in zip(coarse, fine):
        np.testing.assert_allclose(one, other[::4], atol=1e-9)


def test_a_wave_with_more_switches_than_it_says_is_refused_and_never_flown_in_silence():
    wave = SquareWaveDisturbance(AMPLITUDE, 1.5)
    with pytest.raises(ScenarioError, match=r"disturbance: .* 1 s, .* at most 0.75 s"):
        make_setup(disturbance=CombinedDisturbance((ConstantDisturbance([0.0, 0.0, 0.0]), wave)))
    make_setup(disturbance=wave, period=0.75)
    make_setup(disturbance=SquareWaveDisturbance(AMPLITUDE, 1.5, most_switches=2))
    assert np.all(np.isnan(steps(wave, 1.0, 1)[1][-1]))
    with pytest.raises(ScenarioError, match="most_switches"):
        SquareWaveDisturbance(AMPLITUDE, 1.0, most_switches=0)

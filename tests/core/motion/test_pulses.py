"""Pulses within a control period against the motion integrated from switch to switch."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.motion.attitude import Tumbling
from keepout.core.motion.chaser import Pulses
from keepout.core.motion.disturbance import paper_disturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion

MASS = 20.0
LOW = Orbit(6_778_000.0, 0.01)
TUMBLE = Tumbling(angular_velocity=np.array([0.006, -0.005, 0.004]), inertia=np.diag([1.0, 2.0, 1.5]))
MOTIONS = {
    "geostationary": RelativeMotion(Orbit(42_164_000.0)),
    "low": RelativeMotion(LOW),
    "tumbling at 0.5 degrees a second": RelativeMotion(LOW, TUMBLE),
    "tumbling, four substeps": RelativeMotion(LOW, TUMBLE, substeps=4),
}


def pulses_of(seed, *, centred=True, count=6, force=0.1):
    """Random pulses in one second."""
    generator = np.random.default_rng(seed)
    length = generator.uniform(0.02, 1.0, count)
    begin = 0.5 * (1.0 - length)
    if not centred:
        begin = generator.uniform(0.0, 1.0, count) * (1.0 - length)
    push = generator.normal(size=(count, 3))
    push = force * push / np.linalg.norm(push, axis=1, keepdims=True)
    return Pulses(*(jnp.asarray(value) for value in (begin, begin + length, push, 1.0)))


@eqx.filter_jit
def held_step(motion, state, force, period):
    return motion.step(state, force, paper_disturbance(), period, MASS)


@eqx.filter_jit
def pulsed_step(motion, state, pulses):
    return motion.step(state, pulses.mean, paper_disturbance(), 1.0, MASS, pulses)


def from_switch_to_switch(motion, state, pulses, fine=4):
    """Integrate with the force that is on in each piece, and several steps in each piece."""
    begin, end = np.asarray(pulses.begin), np.asarray(pulses.end)
    edges = np.unique(np.concatenate([[0.0, 1.0], begin, end]))
    for low, high in itertools.pairwise(edges):
        on = (begin <= 0.5 * (low + high)) & (0.5 * (low + high) < end)
        force = jnp.asarray(on.astype(float) @ np.asarray(pulses.force))
        for _ in range(fine):
            state = held_step(motion, state, force, jnp.asarray((high - low) / fine))
    return state


@pytest.mark.long
@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("centred", [True, False])
def test_a_step_with_pulses_is_the_integration_from_switch_to_switch(name, centred):
    motion = MOTIONS[name]
    for seed in range(4):
        start = motion.initial_state([3.0, 10.0, 6.0], [0.05, -0.08, 0.02], time=100.0)
        pulses = pulses_of(seed, centred=centred)
        truth = from_switch_to_switch(motion, start, pulses)
        found = pulsed_step(motion, start, pulses)
        assert np.abs(found.position - truth.position).max() < 1e-8
        assert np.abs(found.velocity - truth.velocity).max() < 1e-9
        held = held_step(motion, start, pulses.mean, jnp.float64(1.0))
        if not centred:  # or the comparison would not see the pulses at all
            assert np.abs(held.position - truth.position).max() > 1e-5


@pytest.mark.long
def test_moments_are_the_integrals_of_the_force_about_its_mean():
    pulses = pulses_of(3, centred=False)
    time = np.linspace(0.0, 1.0, 200_001)
    on = (time[:, None] >= pulses.begin) & (time[:, None] < pulses.end)
    value = on.astype(float) @ np.asarray(pulses.force) - np.asarray(pulses.mean)
    for order in (1, 2, 3, 4):
        value = np.concatenate(
            [np.zeros((1, 3)), np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(time)[:, None], 0)]
        )
        found = jax.vmap(lambda t, order=order: pulses.moment(order, t))(jnp.asarray(time[::1000]))
        np.testing.assert_allclose(found, value[::1000], atol=2e-6)

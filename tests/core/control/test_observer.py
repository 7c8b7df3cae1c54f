"""Disturbance observers on a point mass that is moved exactly."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from keepout.core.control.observer import constant_observer, continuous, harmonic_observer
from keepout.core.errors import ControlError

MASS, PERIOD = 20.0, 1.0


def push(t):
    """The paper's disturbance, N."""
    return 0.01 * np.array([np.sin(0.02 * t), np.cos(0.02 * t), np.sin(0.01 * t)])


def impulse(t0, t1):
    def primitive(t):
        return 0.01 * np.array([-np.cos(0.02 * t) / 0.02, np.sin(0.02 * t) / 0.02, -np.cos(0.01 * t) / 0.01])

    return primitive(t1) - primitive(t0)


@eqx.filter_jit
def updated(observer, state, before, after, force):
    state = observer.update(state, before, after, jnp.zeros(3), force)
    return state, observer.estimate(state, after)


def run(observer, steps):
    """Errors of the estimate (N) at each sample under a changing force, with an exact velocity."""
    rng = np.random.default_rng(0)
    velocity = np.zeros(3)
    state = observer.initial_state(jnp.asarray(velocity))
    errors = []
    for k in range(steps):
        force = rng.uniform(-0.1, 0.1, 3)
        after = velocity + (force * PERIOD + impulse(k * PERIOD, (k + 1) * PERIOD)) / MASS
        state, estimate = updated(observer, state, velocity, after, force)
        velocity = after
        errors.append(np.asarray(estimate) - push((k + 1) * PERIOD))
    return np.array(errors)


def test_constant_model_leaves_two_percent():
    errors = run(constant_observer(mass=MASS, period=PERIOD), 400)
    worst = np.abs(errors[20:]).max() / 0.01
    assert 0.005 < worst <= 0.02


def test_harmonic_model_leaves_a_thousandth():
    errors = run(harmonic_observer((0.02, 0.01), mass=MASS, period=PERIOD), 400)
    assert np.abs(errors[200:]).max() / 0.01 <= 1e-3


def test_printed_generator_leaves_most_of_it():
    """A = I, as printed, is unstable and not the generator of the printed sinusoids."""
    one = np.eye(3)
    errors = run(continuous(one, one, 50.0 * one, mass=MASS, period=PERIOD), 400)
    assert np.abs(errors[100:]).max() / 0.01 > 0.5


@pytest.mark.parametrize("factors", [(0.1, 0.8, 0.84, 0.88, 0.92), (0.3, 0.4, 0.5, 0.6, 0.7)])
def test_error_shrinks_at_the_designed_rates(factors):
    observer = harmonic_observer((0.02, 0.01), mass=MASS, period=PERIOD, factors=factors)
    found = np.sort(np.abs(np.linalg.eigvals(np.asarray(observer.error_matrix()))))
    np.testing.assert_allclose(found, np.sort(np.repeat(factors, 3)), atol=1e-4)
    errors = np.linalg.norm(run(observer, 60), axis=1)
    slowest = max(factors)
    # Late in the transient the slowest factor governs.
    if slowest < 0.8:
        assert (errors[28] / errors[24]) ** 0.25 == pytest.approx(slowest, abs=0.05)


def test_sampled_continuous_form_is_exact_for_a_constant_push():
    one = np.eye(3)
    observer = continuous(np.zeros((3, 3)), one, 50.0 * one, mass=MASS, period=PERIOD)
    constant = np.array([0.01, -0.02, 0.005])
    velocity, state = np.zeros(3), observer.initial_state(jnp.zeros(3))
    for k in range(1, 4):
        after = velocity + constant / MASS
        state, estimate = updated(observer, state, velocity, after, np.zeros(3))
        velocity, left = after, constant - np.asarray(estimate)
        np.testing.assert_allclose(left, constant * np.exp(-2.5 * k), atol=1e-15)


def test_refuses_gains_that_diverge():
    with pytest.raises(ControlError, match="frequencies"):
        harmonic_observer((0.02, 0.02), mass=MASS, period=PERIOD)
    with pytest.raises(ControlError, match="factors"):
        harmonic_observer((0.02,), mass=MASS, period=PERIOD, factors=(0.1, 0.2, 1.2))

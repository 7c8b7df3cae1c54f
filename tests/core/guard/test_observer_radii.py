"""ρ, σ, U and the plan's radius with an observer, against a simulation that knows nothing of how they were derived.

The simulation below is the chaser, the estimate, the observer, the queue of commands and the plan, one axis, step by
step. It is linear, so its answers to single inputs tell the worst of all inputs.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.guarded_worlds import ASSUMED

from keepout.core.guard.braking import design, observed_radii

FINE = 40
"""Parts of a step in which a disturbance's push is looked at."""


def simulate(made, T, n, noise, pushes, planned):
    """Fly (inputs, steps) at once: errors told (…, 2) and displacements by pushes (…, 2); a plan is made at a step.

    Returns the true error from what is certified (inputs, times, 2) from the plan's making on, and what the guard sees:
    the predicted state less the plan's at each step after it.
    """
    inputs, steps = noise.shape[:2]
    observer = made.observer
    k_p, k_d, l_r, l_v = made.position_gain, made.velocity_gain, observer.position, observer.velocity

    def free(x, u=0.0):
        r, v = x[..., 0], x[..., 1]
        return np.stack([r + T * v + 0.5 * T**2 * u, v + T * u], axis=-1)

    x = np.zeros((inputs, 2))
    expected = x + noise[:, 0]
    queue = [np.zeros(inputs) for _ in range(n)]
    certified, seen, errors = {}, [], []
    plan = None
    for k in range(steps):
        told = x + noise[:, k]
        off = told - expected
        known = expected + np.stack([l_r * off[:, 0] + (1 - l_r) * T * off[:, 1], l_v * off[:, 1]], axis=-1)
        if k == 0:
            known = told
        u, ahead = np.zeros(inputs), known
        if k == planned:
            certified[k] = ahead
            for i, command in enumerate(queue):
                ahead = free(ahead, command)
                certified[k + i + 1] = ahead
            plan = free(ahead)
        else:
            for command in queue:
                ahead = free(ahead, command)
            if plan is not None:
                certified[k + n] = plan
                away = ahead - plan
                seen.append(away)
                u = -k_p * away[:, 0] - k_d * away[:, 1]
                plan = free(plan)
        if k in certified:
            errors.append(x - certified[k])
        queue.append(u)
        now = queue.pop(0)
        expected = free(known, now)
        x = free(x, now) + pushes[:, k]
    return np.stack(errors, axis=1), np.stack(seen, axis=1)


def impulses(made, T, n, before, after):
    """Answers to each single input: of noise in position and velocity, and of pushes likewise."""
    steps = before + after
    one = np.eye(2 * steps).reshape(2 * steps, steps, 2)
    none = np.zeros_like(one)
    return [simulate(made, T, n, *pair, before) for pair in ((one, none), (none, one))]


def wanted(made, errors, seen):
    """Position and velocity error, feedback, and distance seen from the plan, (inputs, times) each."""
    feedback = -made.position_gain * seen[..., 0] - made.velocity_gain * seen[..., 1]
    return errors[..., 0], errors[..., 1], feedback, seen[..., 0]


def worst_sums(made, a, before, after, fault_steps=1):
    """The worst of each of the four: by noise and disturbance at any time, and by one fault, over all times."""
    T, n = a.period, a.delay
    tau = (np.arange(FINE) + 0.5) / FINE * T
    kernel = np.stack([T - tau, np.ones(FINE)])
    noise, push = impulses(made, T, n, before, after)
    found = []
    for told, pushed in zip(wanted(made, *noise), wanted(made, *push), strict=True):
        steps = before + after
        told = np.abs(told).reshape(steps, 2, -1)
        line = np.einsum("sct,cf->stf", pushed.reshape(steps, 2, -1), kernel)
        each = np.abs(line).sum(axis=-1) * T / FINE
        total = a.disturbance * each.sum(axis=0) + a.position_error * told[:, 0].sum(axis=0)
        total = total + a.velocity_error * told[:, 1].sum(axis=0)
        windows = np.stack([each[i : i + fault_steps].sum(axis=0) for i in range(steps)])
        found.append((total.max(), (total + a.fault_push * windows.max(axis=0)).max()))
    return np.array(found).T


def stated(made, a):
    """What is stated of the four at samples, without what is added for the time between them."""
    between = a.disturbance + a.fault_push
    return np.array(
        [
            made.position_radius - a.period**2 / 8 * (made.reserve + between) - a.excursion,
            made.velocity_radius - 0.5 * between * a.period - a.velocity_excursion,
            made.reserve,
            made.observer.plan_radius,
        ]
    )


def assumed(**changes):
    return dataclasses.replace(ASSUMED, **{"position_error": 0.05, "velocity_error": 2e-3, **changes})


CASES = [
    {},
    {"delay": 1},
    {"delay": 2},
    {"position_error": 0.2, "velocity_error": 0.01},
    {"position_error": 0.05, "velocity_error": 0.0},
    {"position_error": 0.0, "velocity_error": 2e-3, "delay": 3},
    {"period": 0.5, "delay": 2},
    {"fault_force": 0.03, "fault_steps": 4, "delay": 1},
]


@pytest.mark.long
@pytest.mark.parametrize("changes", CASES, ids=str)
def test_each_radius_is_the_least_upper_bound(changes):
    a = assumed(**changes)
    made = design(a)
    before, after = (90, 180) if a.position_error < 0.1 else (150, 330)
    without, with_fault = worst_sums(made, a, before, after, max(a.fault_steps, 1))
    bound = stated(made, a)
    worst = with_fault if a.fault_force else without
    assert np.all(worst <= bound * (1 + 1e-3)), worst / bound
    assert np.all(worst >= 0.98 * bound), worst / bound


@pytest.mark.long
@given(
    poles=st.tuples(st.floats(0.0, 0.9), st.floats(0.0, 0.9)),
    gains=st.tuples(st.floats(0.1, 1.0), st.floats(0.1, 1.0)),
    errors=st.tuples(st.sampled_from([0.0, 0.01, 0.3]), st.sampled_from([0.0, 1e-3, 0.02])),
    delay=st.integers(0, 3),
    before=st.integers(0, 30),
    fault_steps=st.integers(1, 5),
)
def test_no_gains_pass_what_is_stated_of_them(poles, gains, errors, delay, before, fault_steps):
    a = assumed(position_error=errors[0], velocity_error=errors[1], delay=delay)
    a = dataclasses.replace(a, fault_force=0.01, fault_steps=fault_steps)
    made = observed_radii(a, (*poles, *gains))
    _, worst = worst_sums(made, a, before, 60, fault_steps)
    # The sums over parts of a step are not quite the integrals.
    assert np.all(worst <= stated(made, a) * (1 + 2e-3)), worst / stated(made, a)


def test_pulses_and_force_errors_widen_the_tube_by_what_they_are():
    a = assumed()
    for plain in (a, ASSUMED):
        pulsed = design(dataclasses.replace(plain, excursion=2e-3, velocity_excursion=5e-4))
        assert pulsed.position_radius - design(plain).position_radius == pytest.approx(2e-3, rel=1e-9)
        assert pulsed.velocity_radius - design(plain).velocity_radius == pytest.approx(5e-4, rel=1e-9)
    right = dataclasses.replace(a, mass_error=0.1)
    wrong = dataclasses.replace(right, force_error=4e-3)
    assert wrong.disturbance - right.disturbance == pytest.approx(4e-3 / (a.mass * 0.9), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("delay", [0, 2])
def test_a_fault_of_a_perfect_estimate_adds_its_worst_steps(delay):
    a = dataclasses.replace(ASSUMED, fault_force=0.04, fault_steps=3, delay=delay)
    made = design(a)
    T, push = a.period, a.fault_push
    closed = np.array([[1, T], [0, 1]]) - np.outer([T**2 / 2, T], [made.position_gain, made.velocity_gain])
    tau = (np.arange(400) + 0.5) / 400 * T
    powers, now = [], np.eye(2)
    for _ in range(delay):
        powers.append(now)
        now = np.array([[1, T], [0, 1]]) @ now
    for _ in range(400):
        powers.append(now)
        now = closed @ now
    each = np.array([np.abs(p[0] @ np.stack([T - tau, np.ones(400)])).mean() * T for p in powers])
    worst = max(each[i : i + 3].sum() for i in range(len(each)))
    bow = T**2 / 8 * (made.reserve + a.disturbance + push)
    assert made.position_radius - bow == pytest.approx(a.disturbance * each.sum() + push * worst, rel=1e-3)

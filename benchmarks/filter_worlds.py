"""How good the filter is: whether its errors are as large as it says, and what it finds in bounded noise.

    python benchmarks/filter_worlds.py [--json]

Samples at 1 Hz within ± 0.05 m and ± 2 mm/s. The first table: means, over 1000 flights of 240 s through worlds that are
as the filter believes, of the normalised innovations squared (NIS) and the normalised errors squared (NEES), over their
degrees of freedom, with the 95 % band of the mean and the share of times that are within their own band. The second:
root mean squares an axis, over 64 flights from 300 s to 900 s, under the paper's disturbance.
"""

import json
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import command, show
from scipy import stats

from keepout.core.control.observer import PAPER_FREQUENCIES
from keepout.core.flight.navigation import Sample
from keepout.core.motion.disturbance import NoDisturbance, paper_disturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.navigation.estimators import kalman_filter
from keepout.flights.navigation.suites import close

MASS, PERIOD, BOUND = 20.0, 1.0, 0.0173
NEAR = RelativeMotion(Orbit(6_778_137.0))
START = np.array([8.0, -5.0, 3.0, 0.02, -0.01, 0.03])
ERRORS = np.array([0.5, 0.02])
FAR_OFF, TOO_FAST = 0.05, 2e-3
FLIGHTS, STEPS = 1000, 240


def suite():
    """Give the sensors; the worlds draw their samples themselves."""
    return close(FAR_OFF, TOO_FAST).sensors


def filter_of(sensors, frequencies=PAPER_FREQUENCIES, **changes):
    """Give the filter of these worlds."""
    numbers = {"mass": MASS, "period": PERIOD, "disturbance_bound": BOUND} | changes
    return kalman_filter(NEAR, sensors, frequencies=frequencies, **numbers)


def ball(key, radius):
    """Draw evenly from a ball."""
    direction, size = jax.random.split(key)
    towards = jax.random.normal(direction, (3,))
    return radius * towards / jnp.linalg.norm(towards) * jax.random.uniform(size) ** (1 / 3)


def gaussian(key, radius):
    """Draw from the Gaussian distribution of the same covariance."""
    return radius / np.sqrt(5.0) * jax.random.normal(key, (3,))


def normalised(noise):
    """Fly 1000 worlds that are as the filter believes.

    Returns the innovations of position and velocity (flights, steps, 2) and the errors of the whole state (flights,
    steps), normalised and squared.
    """
    sensors = suite()
    filtering = filter_of(sensors, outlier_probability=1e-300)
    n = 21
    root = np.linalg.cholesky(np.asarray(filtering.process_noise))

    def flight(key):
        keys = jax.random.split(key, 4)
        memory = filtering.initial_state(NEAR.initial_state(START[:3], START[3:]), jnp.asarray(ERRORS))
        truth = eqx.tree_at(
            lambda m: (m.position, m.velocity),
            memory.settled.motion,
            (jnp.asarray(START[:3]) + noise(keys[0], ERRORS[0]), jnp.asarray(START[3:]) + noise(keys[1], ERRORS[1])),
        )
        push = jax.vmap(lambda k: noise(k, BOUND))(jax.random.split(keys[2], 5))

        def step(carry, given):
            k, key = given
            truth, push, belief = carry
            keys = jax.random.split(key, 4)
            force = 0.02 * jnp.sin(jnp.array([0.1, 0.07, 0.03]) * k)
            w = root @ jax.random.normal(keys[0], (n,))
            mean = filtering.model.mean(push)
            truth = filtering.motion.step(truth, force + mean, NoDisturbance(), PERIOD, MASS)
            truth = eqx.tree_at(
                lambda m: (m.position, m.velocity), truth, (truth.position + w[:3], truth.velocity + w[3:6])
            )
            push = filtering.model.moved(push) + w[6:].reshape(5, 3)
            belief = filtering.predicted(belief, force)
            samples = (
                Sample(truth.position + noise(keys[1], FAR_OFF), k % 2 == 0),
                Sample(truth.velocity + noise(keys[2], TOO_FAST), jnp.asarray(True)),
            )
            innovation = samples[1].value - belief.motion.velocity  # the position's sample is checked by the errors
            S = belief.covariance[3:6, 3:6] + sensors[1].covariance(jnp.zeros(3))
            place = samples[0].value - belief.motion.position
            S0 = belief.covariance[:3, :3] + sensors[0].covariance(jnp.zeros(3))
            both = jnp.stack([place @ jnp.linalg.solve(S0, place), innovation @ jnp.linalg.solve(S, innovation)])
            belief, _ = filtering.updated(belief, samples)
            error = jnp.concatenate(
                [
                    truth.position - belief.motion.position,
                    truth.velocity - belief.motion.velocity,
                    (push - belief.disturbance).reshape(-1),
                ]
            )
            return (truth, push, belief), (both, error @ jnp.linalg.solve(belief.covariance, error))

        given = (jnp.arange(STEPS), jax.random.split(keys[3], STEPS))
        return jax.lax.scan(step, (truth, push, memory.settled), given)[1]

    both, errors = jax.jit(jax.vmap(flight))(jax.random.split(jax.random.key(3), FLIGHTS))
    return np.asarray(both), np.asarray(errors)


def band(degrees):
    """Give the 95 % band of a mean of squares with so many degrees of freedom in all."""
    return np.array(stats.chi2.ppf([0.025, 0.975], degrees)) / degrees


def accuracy(frequencies):
    """Fly 64 worlds with the paper's disturbance, noise even in balls; give root mean squares and samples left out.

    The errors of position (m), velocity (m/s) and disturbance (N) are an axis', from 300 s on.
    """
    push, flights, steps = paper_disturbance(), 64, 900

    @jax.jit
    def errors(filtering, keys):
        def flight(key):
            start = NEAR.initial_state(START[:3], START[3:])

            def step(carry, key):
                truth, memory = carry
                keys = jax.random.split(key)
                samples = (
                    Sample(truth.position + ball(keys[0], FAR_OFF), jnp.asarray(True)),
                    Sample(truth.velocity + ball(keys[1], TOO_FAST), jnp.asarray(True)),
                )
                memory, estimate, left_out = filtering.correct(memory, samples)
                force = -MASS * (NEAR.drift_acceleration(truth) + 1e-3 * (truth.position - START[:3]))
                force = jnp.clip(force - MASS * 0.06 * truth.velocity, -0.1, 0.1)
                ahead = push.force(truth.time + 0.5 * PERIOD)  # the mean over a period, to (ωT)²/24
                row = (truth.position - estimate.position, truth.velocity - estimate.velocity)
                row += (ahead - estimate.disturbance, left_out)
                truth = NEAR.step(truth, force, push, PERIOD, MASS)
                return (truth, filtering.advance(memory, force)), row

            memory = filtering.initial_state(start, jnp.asarray(ERRORS))
            return jax.lax.scan(step, (start, memory), jax.random.split(key, steps))[1]

        return jax.vmap(flight)(keys)

    keys = jax.random.split(jax.random.key(2), flights)
    *rest, left_out = errors(filter_of(suite(), frequencies), keys)
    return [float(np.sqrt(np.mean(np.square(e[:, 300:])))) for e in rest], int(np.sum(left_out))


def consistency():
    """Give the rows of the first table."""
    rows = []
    for noise in (gaussian, ball):
        both, errors = normalised(noise)
        for name, values, degrees, together in (
            ("NIS position", both[:, ::2, 0], 3, both[:, ::2, 0].size),
            ("NIS velocity", both[:, :, 1], 3, both[:, :, 1].size),
            ("NEES", errors, 21, FLIGHTS),  # errors of one flight remember
        ):
            low, high = band(degrees * together)
            below, above = band(degrees * FLIGHTS)
            each_time = values.mean(axis=0) / degrees
            inside = float(np.mean((each_time > below) & (each_time < above)))
            row = {"noise": noise.__name__, "what": name, "mean": float(values.mean() / degrees)}
            rows.append(row | {"band_low": float(low), "band_high": float(high), "times_inside": inside})
    return rows


def found():
    """Give the rows of the second table."""
    rows = []
    for model, frequencies in (("constant and the paper's two", PAPER_FREQUENCIES), ("constant", ())):
        (position, velocity, force), _ = accuracy(frequencies)
        rows.append({"model": model, "position_m": position, "velocity_mps": velocity, "disturbance_N": force})
    return rows


def main():
    """Print both tables."""
    parser = command(__doc__)
    arguments = parser.parse_args()
    tables = {"consistency": consistency(), "accuracy": found()}
    if arguments.json:
        sys.stdout.write(json.dumps(tables, indent=2) + "\n")
        return
    for rows in tables.values():
        show([{k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows], rows[0])


if __name__ == "__main__":
    main()

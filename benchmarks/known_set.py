"""The set-membership estimate of the worked suites in flight: how wide, whether it holds the truth, what it costs.

    python benchmarks/known_set.py [--flights N] [--steps N] [--suites close near far] [--json]

Flights begin some metres from the target and drift under a sinusoidal push of up to D; the law is a weak brake. The
caps are those of `keepout.flights.navigation.known_set.design`; `inside` counts the steps in which the truth is within
both radii.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import command, tell

from keepout.core.motion import rotation
from keepout.core.motion.relative import MotionState
from keepout.flights.navigation.known_set import SetMembership, design
from keepout.flights.navigation.suites import SUITES

DISTURBANCE, MASS, PERIOD = 9e-4, 20.0, 1.0
RANGE, SPEED = 60.0, 0.3
INITIAL = (0.05, 0.002)
BEGUN = 5
"""Steps that the first estimate is still seen in, and which are left out of the means."""


def state(position: jax.Array, velocity: jax.Array) -> MotionState:
    return MotionState(jnp.zeros(()), position, velocity, rotation.identity(), jnp.zeros(3))


def fly(estimate: SetMembership, key: jax.Array, steps: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Radii (steps, 2), whether the truth is within both, and whether samples contradicted."""
    place, way, sensors = jax.random.split(key, 3)
    direction = jax.random.normal(way, (3,))
    direction = direction / jnp.linalg.norm(direction)
    start = state(5.0 * jax.random.normal(place, (3,)), jnp.zeros(3))

    def step(carry: Any, number: jax.Array) -> Any:
        truth, lines, known = carry
        lines, samples = estimate.suite.sample(lines, truth)
        known, found = estimate.correct(known, samples, truth)
        off = truth.position - found.state.position, truth.velocity - found.state.velocity
        inside = jnp.all(jnp.linalg.norm(jnp.stack(off), axis=-1) <= found.errors)
        force = MASS * jnp.clip(-0.2 * truth.velocity, -5e-3, 5e-3)
        total = force / MASS + DISTURBANCE * jnp.cos(0.02 * number) * direction
        moved = truth.position + PERIOD * truth.velocity + 0.5 * PERIOD**2 * total
        truth = state(moved, truth.velocity + PERIOD * total)
        return (truth, lines, estimate.advance(known, force)), (found.errors, inside, found.contradicted)

    carry = start, estimate.suite.initial_state(sensors, start), estimate.initial_state(start, jnp.asarray(INITIAL))
    return jax.lax.scan(step, carry, jnp.arange(float(steps)))[1]


def row(name: str, flights: int, steps: int) -> dict[str, Any]:
    """Measure one suite."""
    suite = SUITES[name]()
    estimate, caps = design(
        suite,
        disturbance=DISTURBANCE,
        mass=MASS,
        period=PERIOD,
        range_limit=RANGE,
        speed_limit=SPEED,
        initial_errors=INITIAL,
    )
    keys = jax.random.split(jax.random.key(0), flights)
    run = eqx.filter_jit(lambda keys: jax.vmap(lambda key: fly(estimate, key, steps))(keys))
    begun = time.perf_counter()
    compiled = run.lower(keys).compile()
    compile_seconds = time.perf_counter() - begun
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        radii, inside, contradicted = jax.block_until_ready(compiled(keys))
        times.append(time.perf_counter() - begun)
    radii = np.asarray(radii)[:, BEGUN:]
    return {
        "suite": name,
        "flights": flights,
        "window": estimate.window,
        "cap_position_m": caps[0],
        "cap_velocity_mps": caps[1],
        "mean_m_mps": radii.mean(axis=(0, 1)).tolist(),
        "percentile_95_m_mps": np.percentile(radii, 95, axis=(0, 1)).tolist(),
        "inside": float(np.mean(inside)),
        "contradicted": float(np.mean(contradicted)),
        "probability_beyond": suite.probability_beyond(steps),
        "compile_s": compile_seconds,
        "flight_step_us": min(times) / flights / steps * 1e6,
    }


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--flights", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--suites", nargs="+", choices=list(SUITES), default=list(SUITES))
    arguments = parser.parse_args()
    rows = [row(name, arguments.flights, arguments.steps) for name in arguments.suites]
    tell(rows, arguments)


if __name__ == "__main__":
    main()

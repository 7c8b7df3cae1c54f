"""A gain tuned by the flight's own derivative: `jax.grad` through law, thrusters, motion and disturbance."""

import equinox as eqx
import jax
import jax.numpy as jnp

import keepout
from keepout.core.flight import loop


def main(steps: int = 120, rounds: int = 12, start: float = 1.0) -> list[tuple[float, float]]:
    scenario = keepout.Scenario().replace(
        duration=float(steps),
        control={"guidance": "straight", "observer": "off"},
        guard={"enabled": False},
        start={"position": (0.3, -9.5, -4.0)},
    )
    mission = keepout.prepare(scenario)

    def cost(logarithm):
        """Weigh the squared distance from the goal against the squared force, for a tracking gain λ = e^logarithm."""
        gain = jnp.exp(logarithm)
        setup = eqx.tree_at(lambda setup: setup.controller.tracking.gain, mission.setup, gain)
        log = loop.trace(setup, mission.initial, steps, jax.random.key(0))
        return jnp.sum((log.position - setup.goal) ** 2) + 60.0 * jnp.sum(log.force**2)

    slope = jax.jit(jax.value_and_grad(cost))
    at, told = jnp.log(start), []
    for _ in range(rounds):
        value, change = slope(at)
        told.append((float(jnp.exp(at)), float(value)))
        at = at - 0.5 * change
    return told


if __name__ == "__main__":
    for gain, value in main():
        print(f"gain {gain:.3f} /s, cost {value:.5f}")

"""Policies as plain callables under the guard: a random one in JAX, and a learned network that runs in NumPy."""

import jax
import numpy as np

import keepout


def random_policy(away, velocity, time):
    """Full thrust in a random direction, another one each second."""
    return jax.random.uniform(jax.random.fold_in(jax.random.key(0), time.astype(int)), (3,), minval=-0.1, maxval=0.1)


class Network:
    """Stands for what a reinforcement learner gives you: weights, and a call from observation to action in [−1, 1]."""

    def __init__(self, seed: int = 0) -> None:
        generator = np.random.default_rng(seed)
        self.first, self.last = generator.normal(size=(32, 6)), generator.normal(size=(3, 32))

    def __call__(self, away, velocity, time):
        observation = np.concatenate([away / 10.0, velocity / 0.1])
        return 0.1 * np.tanh(self.last @ np.tanh(self.first @ observation))


def main(duration: float = 400.0) -> dict[str, keepout.Flight]:
    near, control = {"position": (0.0, 3.0, 0.0)}, {"guidance": "straight"}
    scenario = keepout.Scenario().replace(name="policy", duration=duration, start=near, control=control)
    mission = keepout.prepare(scenario)
    laws = {
        "random": keepout.PolicyLaw(scenario.goal.position, random_policy),
        "network": keepout.PolicyLaw(scenario.goal.position, Network(), on_host=True),
    }
    return {name: mission.with_law(law).fly() for name, law in laws.items()}


if __name__ == "__main__":
    for name, flight in main().items():
        print(name, flight.summary()["contact_verdict"], flight.summary()["guard_interventions"])

"""A disturbance of your own: plumes that come in pulses. It states its bound, on which guard and audit rely."""

import jax
import jax.numpy as jnp

import keepout


class Plume(keepout.Disturbance):
    """A push along one direction that swells and falls off once in `every` seconds."""

    strength: jax.Array  # N; an array, so that every strength is flown by one compiled program
    every: float = 60.0  # s

    def force(self, time):
        swell = jnp.sin(jnp.pi * time / self.every) ** 2
        return self.strength * swell * jnp.array([0.0, 0.6, 0.8])

    @property
    def bound(self):
        return float(self.strength)


def main(duration: float = 400.0, strength: float = 0.012) -> keepout.Flight:
    scenario = keepout.Scenario().replace(name="plume", duration=duration, control={"guidance": "straight"})
    mission = keepout.prepare(scenario)
    return mission.with_disturbance(Plume(jnp.array(strength))).fly()


if __name__ == "__main__":
    flight = main()
    print(flight.summary()["contact_verdict"], flight.summary()["start_certified"], flight.summary()["delta_v_mps"])

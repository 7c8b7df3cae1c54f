"""Thrusters of your own: they fire in steps of a smallest push, as pulsed ones do. Law and guard do not know."""

import jax.numpy as jnp

import keepout


class Pulsed(keepout.ThrusterModel):
    """Each axis gives a whole number of smallest pushes, at most its limit."""

    limit: float = 0.1  # N, an axis
    smallest: float = 0.004  # N

    def apply(self, command):
        return jnp.clip(jnp.round(command / self.smallest) * self.smallest, -self.limit, self.limit)

    def saturated(self, command):
        return jnp.any(jnp.abs(command) >= self.limit)


def main(duration: float = 400.0) -> keepout.Flight:
    scenario = keepout.Scenario().replace(name="pulsed", duration=duration, control={"guidance": "straight"})
    mission = keepout.prepare(scenario).with_thrusters(Pulsed())
    return mission.fly()


if __name__ == "__main__":
    flight = main()
    print(flight.summary()["contact_verdict"], flight.summary()["assumptions_broken"])

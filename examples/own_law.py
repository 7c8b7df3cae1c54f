"""A PID law of your own under Keepout's guard: it knows of no target, and the guard keeps it off."""

import jax.numpy as jnp

import keepout


class Pid(keepout.Law):
    """Force = mass (−k_p e − k_i ∫e − k_d v); what it remembers is the integral."""

    destination: jnp.ndarray  # m, body frame
    gains: tuple[float, float, float] = (1.5e-3, 1e-6, 0.09)  # 1/s², 1/s³, 1/s

    @property
    def goal(self):
        return self.destination

    def initial_state(self, state):
        return jnp.zeros(3)

    def step(self, state, estimate):
        error = estimate.position - self.goal
        error = error * jnp.minimum(1.0, 4.0 / jnp.maximum(jnp.linalg.norm(error), 1e-9))  # no faster when far away
        integral = state + error
        k_p, k_i, k_d = self.gains
        wanted = -20.0 * (k_p * error + k_i * integral + k_d * estimate.velocity)
        return integral, keepout.Command.of_force(jnp.clip(wanted, -0.1, 0.1))


def main(duration: float = 400.0) -> keepout.Flight:
    scenario = keepout.Scenario().replace(name="pid", duration=duration, control={"guidance": "straight"})
    mission = keepout.prepare(scenario).with_law(Pid(jnp.array(scenario.goal.position)))
    return mission.fly()


if __name__ == "__main__":
    flight = main()
    print(flight.summary()["contact_verdict"], flight.summary()["guard_interventions"], "steps of the guard")

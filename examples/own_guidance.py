"""A guidance of your own: over a point above the target, then to the goal. Law and guard stay Keepout's."""

import jax.numpy as jnp

import keepout


class Over(keepout.Guidance):
    """Towards a point on the way until the chaser is beside it, then towards the goal; a pure function of position."""

    goal: jnp.ndarray  # m, body frame
    over: jnp.ndarray  # m
    speed: float = 0.1  # m/s

    def desired_velocity(self, position):
        # How much of the way across is done, from 0 at the point to 1 at the goal, says where to look next.
        across = self.goal - self.over
        done = jnp.clip(jnp.dot(position - self.over, across) / jnp.dot(across, across) + 0.25, 0.0, 1.0)
        away = self.over + done * across - position
        return self.speed * away / jnp.sqrt(jnp.sum(away * away) + 1.0)


def main(duration: float = 600.0) -> keepout.Flight:
    scenario = keepout.Scenario().replace(name="over", duration=duration)
    goal = jnp.array(scenario.goal.position)
    return keepout.prepare(scenario, guidance=Over(goal, jnp.array([0.0, 0.0, 9.0]))).fly()


if __name__ == "__main__":
    flight = main()
    print(flight.summary()["contact_verdict"], f"{flight.summary()['final_error_m']:.2f} m from the goal")

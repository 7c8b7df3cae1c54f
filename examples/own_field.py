"""A field of your own: any JAX function with a Lipschitz bound that you state. The guard keeps its own field."""

import jax.numpy as jnp

import keepout

HALF = jnp.array([2.0, 1.5, 1.0])  # m, of the built-in box


def ellipsoid(point):
    """Under-state the distance to the box by that to an ellipsoid round it: never above it, 1-Lipschitz."""
    axes = jnp.sqrt(3.0) * HALF
    stretched = jnp.sqrt(jnp.sum((point / axes) ** 2) + 1e-12)
    return jnp.min(axes) * (stretched - 1.0)


def main(grid: keepout.FieldModel, duration: float = 500.0) -> keepout.Flight:
    scenario = keepout.Scenario.parse(
        {
            "name": "own-field",
            "duration": duration,
            "target": {"source": "box"},
            "start": {"position": [0.0, 6.0, 1.0]},
            "goal": {"position": [0.0, -6.0, -1.0]},
        }
    )
    mission = keepout.prepare(scenario, model=grid)
    field = keepout.stated_field(ellipsoid, 1.0, lower=[-8.0] * 3, upper=[8.0] * 3)
    return mission.with_field(field).fly()


if __name__ == "__main__":
    from keepout.core.guard.field import guard_field

    flight = main(guard_field(keepout.Target.load("box"), 0.5))
    print(flight.summary()["contact_verdict"], f"clearance {flight.summary()['minimum_clearance_m']:.2f} m")

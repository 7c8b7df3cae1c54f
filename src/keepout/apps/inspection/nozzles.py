"""Where plumes leave the chaser and which way: its thrusters, which of them a force fires, and which fired in a flight.

Ideal thrusters are a pair an axis at the chaser's centre. Those of a layout sit where it says and push as it says; its
chaser's axes are parallel to the body's (`flights/thrusters/layout.py`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.flight.record import FlightRecord
from keepout.core.flight.setup import Faults
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.chaser import ThrusterModel
from keepout.flights.thrusters.of_scenario import errors, layout
from keepout.flights.thrusters.on_off import Allocation

_SILENT = 1e-9
"""Newtons: a thruster that gives less has no plume."""
_ROUNDS = 3
"""Times that a force is divided anew without the thrusters that are barred, before nothing is left of it."""


def _pairs() -> Float[Array, "6 3"]:
    return jnp.concatenate([jnp.eye(3), -jnp.eye(3)])


class Nozzles(eqx.Module):
    """The thrusters as plumes see them; ideal ones by default, in the order +x, +y, +z, −x, −y, −z.

    Attributes:
        position: of each from the chaser's centre, m, body axes.
        direction: of the force that each puts on the chaser, unit vectors; its plume goes the other way.
        force: of each while it is on, N; 1 for ideal ones, which give any.
        wide: by how much a thruster's direction may be wrong, rad.
        excursion: by how much pulses lead the chaser away from the path under their mean force, m.
        limit: at which a commanded force is cut off in each axis, N.
        allocation: which fire for a force; None for ideal ones.

    """

    position: Float[Array, "n 3"] = eqx.field(default_factory=lambda: jnp.zeros((6, 3)))
    direction: Float[Array, "n 3"] = eqx.field(default_factory=_pairs)
    force: Float[Array, " n"] = eqx.field(default_factory=lambda: jnp.ones(6))
    wide: float = 0.0
    excursion: float = 0.0
    limit: float = 0.0
    allocation: Allocation | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> "Nozzles":
        """Take them from a scenario."""
        whole = layout(scenario)
        if whole is None:
            return cls()
        return cls(
            jnp.asarray(whole.position),
            jnp.asarray(whole.direction),
            jnp.asarray(whole.force),
            whole.misalignment,
            errors(scenario).excursion,
            scenario.chaser.force_limit,
            Allocation.of(whole),
        )

    def gives(self, force: Float[Array, "3"]) -> Float[Array, " n"]:
        """Say how much of a force (N, body axes) each gives, N."""
        if self.allocation is None:
            return jnp.maximum(self.direction @ force, 0.0)
        return self.force * self.allocation.shares(jnp.clip(force, -self.limit, self.limit))

    def without(self, force: Float[Array, "3"], barred: Bool[Array, " n"]) -> Float[Array, "3"]:
        """Give what is left of a force without some thrusters: none of them fires for it.

        Thrusters of one direction fire together, so with one of them all are left out.
        """
        if self.allocation is None:
            return jnp.where(barred, 0.0, self.gives(force)) @ self.direction
        group, count = self.allocation.group, self.allocation.largest.shape[0]
        barred = jnp.zeros(count, bool).at[group].max(barred)[group]

        def fires_barred(left: Float[Array, "3"]) -> Bool[Array, ""]:
            return jnp.any(barred & (self.gives(left) > _SILENT))

        left = force
        for _ in range(_ROUNDS):
            kept = jnp.where(barred, 0.0, self.gives(left)) @ self.direction
            left = jnp.where(fires_barred(left), kept, left)
        return jnp.where(fires_barred(left), 0.0, left)

    def fired(self, record: FlightRecord, scenario: Scenario) -> Bool[np.ndarray, "steps n"]:
        """Say which fired in each step of a flight.

        Ideal ones by the force that was given. Those of a layout as they were told to: the record holds the mean force
        of their pulses alone, so the commands are run through the scenario's faults and thrusters again.
        """
        if self.allocation is None:
            return (record.force[:-1] @ np.asarray(self.direction).T) > _SILENT
        on_time = _on_times(
            Surroundings(scenario).faults,
            Surroundings(scenario).thrusters,
            jnp.asarray(record.guarded_force),
            jnp.asarray(record.time),
            jax.random.key(scenario.seed),
        )
        return np.asarray(on_time)[:-1] > 0.0


@kept_jit
def _on_times(
    faults: Faults,
    thrusters: ThrusterModel,
    commands: Float[Array, "rows 3"],
    times: Float[Array, " rows"],
    key: Array,
) -> Float[Array, "rows n"]:
    """Give the on-time of each thruster in each period, s; what is drawn of their forces changes none."""

    def period(state, told):
        broken, memory = state
        broken, arrived = faults.command(broken, *told)
        memory, firing = thrusters.fire(memory, arrived)
        assert firing.on_time is not None
        return (broken, memory), firing.on_time

    begun = faults.initial_state(key), thrusters.initial_state(key)
    return jax.lax.scan(period, begun, (commands, times))[1]

"""A recorded flight told in inertial axes: where target and chaser are about the Earth, and how the target is turned.

The record holds the chaser in the target's body frame. The target's orbit is the record's own where perturbations
bend it, and else the scenario's Kepler ellipse. Keepout's inertial axes are written as EME2000: a scenario's
inclination, node and perigee are read as angles in that frame.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from keepout.core.errors import ExchangeError
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.epoch import format_instant, leap_second_between, parse_instant
from keepout.core.mission.orbit_bounds import orbit_of
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.rotation import matrix, vvlh_axes

FRAME = "EME2000"
CENTRE = "EARTH"
TIME_SYSTEM = "UTC"


@dataclass(frozen=True, eq=False)
class InertialFlight:
    """A flight about the Earth: EME2000 axes, metres, metres a second, UTC.

    Attributes:
        epochs: of the rows, ns since 1970-01-01 of the clock.
        target_position: of the target's centre of mass.
        target_velocity: of the same.
        chaser_position: of the chaser's centre.
        chaser_velocity: of the same.
        turn: rotations body ← EME2000.
        vvlh: rotations VVLH ← EME2000.
        centre_of_mass: of the target, in the body frame, m.

    """

    epochs: Int[np.ndarray, "n"]
    target_position: Float[np.ndarray, "n 3"]
    target_velocity: Float[np.ndarray, "n 3"]
    chaser_position: Float[np.ndarray, "n 3"]
    chaser_velocity: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "n 3 3"]
    vvlh: Float[np.ndarray, "n 3 3"]
    centre_of_mass: Float[np.ndarray, "3"]

    @property
    def quaternion(self) -> Float[np.ndarray, "n 4"]:
        """Quaternions (Q1, Q2, Q3, QC) that turn the axes of EME2000 into those of the body."""
        return Rotation.from_matrix(np.swapaxes(self.turn, 1, 2)).as_quat()


def instants(record: FlightRecord, scenario: Scenario) -> Int[np.ndarray, "n"]:
    """Give the UTC instants of a flight's rows, ns, from its scenario's epoch and its times.

    Raises:
        ExchangeError: a leap second lies within the flight.

    """
    epochs = parse_instant(scenario.epoch) + np.round(record.time * 1e9).astype(np.int64)
    day = leap_second_between(int(epochs[0]), int(epochs[-1]))
    if day is not None:
        raise ExchangeError(
            f"epoch: {scenario.epoch}; the flight, which ends at {format_instant(int(epochs[-1]))}, holds the leap "
            f"second before {day}; an epoch from which it holds none is valid"
        )
    return epochs


def inertial_flight(record: FlightRecord, scenario: Scenario) -> InertialFlight:
    """Tell a recorded flight in inertial axes.

    Raises:
        ExchangeError: a leap second lies within the flight.

    """
    epochs = instants(record, scenario)
    if record.target_orbit is None:
        position, velocity = jax.jit(jax.vmap(orbit_of(scenario.orbit).inertial_state))(jnp.asarray(record.time))
    else:
        position, velocity = record.target_orbit[:, :3], record.target_orbit[:, 3:]
    vvlh = np.asarray(jax.jit(jax.vmap(vvlh_axes))(jnp.asarray(position), jnp.asarray(velocity)))
    turn = np.asarray(jax.jit(jax.vmap(matrix))(jnp.asarray(record.attitude))) @ vvlh
    position, velocity = np.asarray(position), np.asarray(velocity)
    centre = np.asarray(scenario.target.centre_of_mass, float)
    away = record.position - centre
    drift = record.velocity + np.cross(record.angular_velocity, away)
    return InertialFlight(
        epochs,
        position,
        velocity,
        position + np.einsum("nji,nj->ni", turn, away),
        velocity + np.einsum("nji,nj->ni", turn, drift),
        turn,
        vvlh,
        centre,
    )

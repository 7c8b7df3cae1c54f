"""The attitude of the body frame over a flight, against VVLH and against the stars."""

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from keepout.core.flight.record import FlightRecord
from keepout.core.mission.orbit_bounds import orbit_of, sun_of
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.rotation import vvlh_axes

Quaternions = Float[np.ndarray, "rows 4"]


def to_vvlh(record: FlightRecord) -> Quaternions:
    """Rotations VVLH ← body as unit quaternions, scalar first, each on the side of the one before."""
    return _continuous(Rotation.from_quat(record.attitude, scalar_first=True).inv())


def to_inertial(record: FlightRecord, scenario: Scenario) -> Quaternions:
    """Rotations ECI ← body as unit quaternions, scalar first: by the recorded orbit, or the scenario's Kepler orbit."""
    if record.target_orbit is None:
        orbit = jax.tree.map(np.asarray, orbit_of(scenario.orbit))
        axes = np.asarray(_on_ellipse(orbit, record.time))
    else:
        axes = np.asarray(_on_states(record.target_orbit))
    body_from_vvlh = Rotation.from_quat(record.attitude, scalar_first=True)
    return _continuous((body_from_vvlh * Rotation.from_matrix(axes)).inv())


def toward_sun(record: FlightRecord, scenario: Scenario) -> Float[np.ndarray, "rows 3"]:
    """Give unit vectors to the scenario's sun, in body axes."""
    inertial_from_body = Rotation.from_quat(to_inertial(record, scenario), scalar_first=True)
    return inertial_from_body.inv().apply(np.asarray(sun_of(scenario)))


@jax.jit
def _on_ellipse(orbit: Orbit, times: Float[Array, "rows"]) -> Float[Array, "rows 3 3"]:
    return jax.vmap(lambda time: vvlh_axes(*orbit.inertial_state(time)))(times)


@jax.jit
def _on_states(states: Float[Array, "rows 6"]) -> Float[Array, "rows 3 3"]:
    return jax.vmap(lambda state: vvlh_axes(state[:3], state[3:]))(states)


def _continuous(rotations: Rotation) -> Quaternions:
    """Quaternions of one sign: the page blends each with the next."""
    found = rotations.as_quat(scalar_first=True)
    turned = np.sum(found[1:] * found[:-1], axis=1) < 0.0
    return found * np.where(np.concatenate([[False], np.cumsum(turned) % 2 == 1]), -1.0, 1.0)[:, None]

"""The attitude of the body frame over a flight, against VVLH and against the stars."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from keepout.flight.record import FlightRecord
from keepout.mission.orbit_bounds import orbit_of
from keepout.mission.scenario import Scenario
from keepout.motion.frames import vvlh_axes

Quaternions = Float[np.ndarray, "rows 4"]


def to_vvlh(record: FlightRecord) -> Quaternions:
    """Rotations VVLH ← body as unit quaternions, scalar first, each on the side of the one before."""
    return _continuous(Rotation.from_quat(record.attitude, scalar_first=True).inv())


def to_inertial(record: FlightRecord, scenario: Scenario) -> Quaternions:
    """Rotations ECI ← body as unit quaternions, scalar first: by the recorded orbit, or the scenario's Kepler orbit."""
    if record.target_orbit is None:
        position, velocity = jax.vmap(orbit_of(scenario.orbit).inertial_state)(jnp.asarray(record.time))
    else:
        orbit = jnp.asarray(record.target_orbit)
        position, velocity = orbit[:, :3], orbit[:, 3:]
    axes = np.asarray(jax.vmap(vvlh_axes)(position, velocity))
    body_from_vvlh = Rotation.from_quat(record.attitude, scalar_first=True)
    return _continuous((body_from_vvlh * Rotation.from_matrix(axes)).inv())


def _continuous(rotations: Rotation) -> Quaternions:
    """Quaternions of one sign: the page blends each with the next."""
    found = rotations.as_quat(scalar_first=True)
    turned = np.sum(found[1:] * found[:-1], axis=1) < 0.0
    return found * np.where(np.concatenate([[False], np.cumsum(turned) % 2 == 1]), -1.0, 1.0)[:, None]

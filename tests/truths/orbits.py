"""Paths of targets on bent orbits: SciPy's, from formulas written here."""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from keepout.core.mission.bounds import orbit_of

MU, EARTH, OBLATE = 3.986004418e14, 6378137.0, 1.08262668e-3
EARTH_SPIN = np.array([0.0, 0.0, 7.292115e-5])


def true_path(scenario):
    """ECI states of the target every second of its duration, (times, 6)."""
    oblate, drag = OBLATE if scenario.orbit.j2 else 0.0, scenario.drag

    def derivative(_, y):
        r, v = y[:3], y[3:]
        R = np.linalg.norm(r)
        u = (r[2] / R) ** 2
        bulge = -1.5 * oblate * MU * EARTH**2 / R**5 * r * np.array([1 - 5 * u, 1 - 5 * u, 3 - 5 * u])
        air = v - np.cross(EARTH_SPIN, r)
        density = drag.density * np.exp(-(R - EARTH - drag.altitude) / drag.scale_height)
        push = -0.5 * density * drag.target_area_to_mass * np.linalg.norm(air) * air
        return np.concatenate([v, -MU * r / R**3 + bulge + push + sunlight(r, scenario.sun.target_area_to_mass)])

    toward = np.asarray(scenario.sun.direction or (1.0, 0.0, 0.0))
    toward = toward / np.linalg.norm(toward)

    def sunlight(r, area_to_mass):
        share = 1.0
        if r @ toward < 0.0:
            beside = np.linalg.norm(np.cross(r, toward))
            share = np.interp(beside, [EARTH - 1e4, EARTH + 1e4], [0.0, 1.0])
        return -4.56e-6 * area_to_mass * share * toward

    start = np.concatenate(orbit_of(scenario.orbit).inertial_state(jnp.zeros(())))
    times = np.arange(0.0, scenario.duration + 0.5)
    solution = solve_ivp(derivative, (0.0, times[-1]), start, "DOP853", times, rtol=1e-13, atol=1e-7, max_step=30.0)
    return solution.y.T

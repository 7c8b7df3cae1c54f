"""The truth that `adversary.py` flies: chaser and target as two bodies about the Earth, in inertial axes, in NumPy.

Nothing of Keepout's motion, flight loop or distances is used. Target and chaser are integrated one by one by classical
Runge–Kutta steps in ECI; the target turns as the scenario says; the chaser's force is held in the target's turning
axes, as the guard assumes. Arrays of flights have the flights along their first axis, and all flights share one clock.
"""

import igl
import numpy as np

GRAVITY = 3.986004418e14
"""Gravitational parameter of the Earth, m³/s²."""
SUBSTEPS = 4
"""Runge–Kutta steps in a control period; forces and disturbances may change from one to the next."""


class Truth:
    """A target on its orbit, tabulated for as long as is flown, and chasers beside it.

    The table's rows are half a Runge–Kutta step of the chaser apart, so that each of its stages finds a row.

    Attributes:
        position: of the target's centre of mass, ECI, m.
        velocity: likewise, m/s.
        axes: rotation body ← ECI.
        rate: angular velocity of the body, body axes, rad/s.

    """

    def __init__(self, scenario, steps):
        """Tabulate the target for so many control periods of a scenario without perturbations."""
        self.step = scenario.control.period / SUBSTEPS
        self.offset = np.asarray(scenario.target.centre_of_mass)
        rows, half = 2 * SUBSTEPS * steps + 1, 0.5 * self.step
        orbit = np.empty((rows, 6))
        orbit[0] = _on_ellipse(scenario.orbit)
        for row in range(rows - 1):
            orbit[row + 1] = _runge_kutta(_fall, orbit[row], half)
        self.position, self.velocity = orbit[:, :3], orbit[:, 3:]
        self.axes, self.rate = _turning(scenario.attitude, self.position, self.velocity, half)

    def seen(self, place, row):
        """Give positions (m) and velocities (m/s) in the body frame of chasers at `place`, their ECI states."""
        axes, away = self.axes[row], place[:, :3] - self.position[row]
        from_centre = away @ axes.T
        velocity = (place[:, 3:] - self.velocity[row]) @ axes.T - np.cross(self.rate[row], from_centre)
        return from_centre + self.offset, velocity

    def placed(self, position, velocity, row):
        """Give the ECI states of chasers at positions (m) and velocities (m/s) of the body frame."""
        axes, from_centre = self.axes[row], position - self.offset
        moving = velocity + np.cross(self.rate[row], from_centre)
        return np.hstack([from_centre @ axes + self.position[row], moving @ axes + self.velocity[row]])

    def flown(self, place, row, push, back=False):
        """Give the ECI states a Runge–Kutta step later, or earlier: under `push`, accelerations held in body axes."""
        sign = -1 if back else 1

        def slope(state, later):
            pushed = push @ self.axes[row + sign * later]
            return np.hstack([state[:, 3:], _gravity(state[:, :3]) + pushed])

        h = sign * self.step
        first = slope(place, 0)
        second = slope(place + 0.5 * h * first, 1)
        third = slope(place + 0.5 * h * second, 1)
        last = slope(place + h * third, 2)
        return place + h / 6.0 * (first + 2.0 * second + 2.0 * third + last)


def _gravity(position):
    return -GRAVITY * position / np.linalg.norm(position, axis=-1, keepdims=True) ** 3


def _fall(state):
    return np.concatenate([state[3:], _gravity(state[:3])])


def _runge_kutta(slope, state, h):
    first = slope(state)
    second = slope(state + 0.5 * h * first)
    third = slope(state + 0.5 * h * second)
    last = slope(state + h * third)
    return state + h / 6.0 * (first + 2.0 * second + 2.0 * third + last)


def _on_ellipse(orbit):
    """Give the state at the true anomaly of the start, in the axes of the ellipse: perigee along x, normal along z."""
    parameter = orbit.semi_major_axis * (1.0 - orbit.eccentricity**2)
    cosine, sine = np.cos(orbit.true_anomaly), np.sin(orbit.true_anomaly)
    radius, speed = parameter / (1.0 + orbit.eccentricity * cosine), np.sqrt(GRAVITY / parameter)
    return np.array(
        [radius * cosine, radius * sine, 0.0, -speed * sine, speed * (orbit.eccentricity + cosine), 0.0],
    )


def _orbital_axes(position, velocity):
    """Give VVLH ← ECI: z to the Earth, y against the orbit's normal."""
    down = -position / np.linalg.norm(position, axis=-1, keepdims=True)
    across = -np.cross(position, velocity)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([np.cross(across, down), across, down], axis=-2)


def _turning(attitude, position, velocity, h):
    """Give rotation body ← ECI and angular velocity at each row."""
    rows = len(position)
    orbital = _orbital_axes(position, velocity)
    if attitude.kind == "vvlh":
        momentum = np.cross(position, velocity) / np.sum(position**2, axis=1, keepdims=True)
        return orbital, np.einsum("nij,nj->ni", orbital, momentum)
    axes, rate = np.empty((rows, 3, 3)), np.zeros((rows, 3))
    axes[0] = orbital[0]
    if attitude.kind == "inertial":
        return np.broadcast_to(axes[0], axes.shape), rate
    if attitude.gravity_gradient:
        raise ValueError("attitude.gravity_gradient: this truth turns a body freely")
    inertia = np.asarray(attitude.inertia)
    rate[0] = attitude.angular_velocity

    def slope(state):
        turn = state[9:]
        turned = -np.cross(turn, state[:9].reshape(3, 3), axisb=0, axisc=0)
        return np.concatenate([turned.ravel(), np.linalg.solve(inertia, -np.cross(turn, inertia @ turn))])

    state = np.concatenate([axes[0].ravel(), rate[0]])
    for row in range(1, rows):
        state = _runge_kutta(slope, state, h)
        axes[row], rate[row] = state[:9].reshape(3, 3), state[9:]
    return axes, rate


class Surface:
    """A mesh, and exact distances to it by libigl."""

    def __init__(self, vertices, faces):
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)

    def nearest(self, points):
        """Give each point's distance (m) to the surface, and the nearest point of it."""
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        squared, _, nearest = self._tree.squared_distance(self.vertices, self.faces, flat)
        return np.sqrt(squared).reshape(points.shape[:-1]), nearest.reshape(points.shape)


class AxisThrusters:
    """On/off thrusters in pairs along each axis, each fired once a period in its middle; one may stick.

    Thruster i of 12 pushes along direction i // 2 of +x, −x, +y, −y, +z, −z, as those of layout "12" do.

    Args:
        flights: how many chasers.
        force: of each thruster, N.
        scale: true force of each over that, (flights, 12).
        period: s.
        least_on_time: s; a shorter pulse is given so long, or not at all if less than half of it.

    """

    DIRECTIONS = np.repeat(np.vstack([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]], 2, axis=0)

    def __init__(self, flights, force, scale, period, least_on_time):
        self.force, self.scale, self.period, self.least = force, scale, period, least_on_time
        self.stuck = np.full(flights, -1)
        self.on, self.known = np.zeros(flights, bool), np.zeros(flights, bool)

    def give(self, wanted):
        """Give the mean force in each Runge–Kutta step of a period, (SUBSTEPS, flights, 3) N, for forces wanted."""
        flight = np.flatnonzero(self.stuck >= 0)
        which = self.stuck[flight]
        known = self.known[flight]
        works = np.ones((len(wanted), 12))
        works[flight[known], which[known]] = 0.0
        held = flight[known & self.on[flight]]
        wanted = wanted.copy()
        wanted[held] -= self.force * self.DIRECTIONS[self.stuck[held]]
        asked = np.maximum(wanted @ self.DIRECTIONS.T, 0.0)
        able = np.repeat(works.reshape(-1, 6, 2).sum(axis=2), 2, axis=1) * self.force
        time = self.period * np.minimum(asked / np.maximum(able, 1e-300), 1.0) * works
        time = np.where(time <= 0.5 * self.least, 0.0, np.clip(time, self.least, self.period))
        time[flight, which] = np.where(self.on[flight], self.period, 0.0)
        begin, end = 0.5 * (self.period - time), 0.5 * (self.period + time)
        ticks = np.linspace(0.0, self.period, SUBSTEPS + 1)[:, None, None]
        shares = np.maximum(np.minimum(end, ticks[1:]) - np.maximum(begin, ticks[:-1]), 0.0) * SUBSTEPS / self.period
        return (shares * (self.force * self.scale)) @ self.DIRECTIONS

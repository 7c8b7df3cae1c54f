"""Bounds on how a target moves over a flight: its orbit, how fast its frame or body turns, what perturbations add.

Without perturbations they are closed forms of the Kepler ellipse. With them the target's orbit is still a known path:
it is integrated in fine steps over the flight, and what can lie between two of them is added by bounds on its rates. A
body that gravity turns is integrated likewise. Every symbol below is the largest (or least, where said) value over the
flight; docs/motion.md derives them.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.errors import ScenarioError
from keepout.core.mission.entries import DragEntry, OrbitEntry
from keepout.core.mission.epoch import parse_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.motion import orbit as orbits
from keepout.core.motion.relative import MotionState, RelativeMotion

_OUTWARD = 1.0 + 1e-6
"""Covers what Runge–Kutta steps lose of a target's orbit, 1e-8 at most, and of its turning: tests/core/mission."""
_MOST_STEPS = 200_000
_LOWEST = 6.39e6
"""Metres from the Earth's centre below which a perturbed orbit is refused."""
_STRONGEST = 12.0
"""More than gravity and perturbations together give above that, m/s²; checked."""

_OBLATENESS = orbits.EARTH_J2 * orbits.EARTH_GRAVITATIONAL_PARAMETER * orbits.EARTH_EQUATORIAL_RADIUS**2


@dataclass(frozen=True)
class OrbitBounds:
    """Bounds that hold over a whole flight.

    Attributes:
        rate: of VVLH against inertial space, rad/s.
        acceleration: its derivative, rad/s².
        lowest_radius: least distance of the target from the Earth's centre, m.
        air_speed: largest speed of the target against the air, m/s; 0 without perturbations.
        valid_until: time, s since the epoch, until which they hold; infinite without perturbations.

    """

    rate: float
    acceleration: float
    lowest_radius: float
    air_speed: float = 0.0
    valid_until: float = math.inf


@dataclass(frozen=True)
class DifferentialBounds:
    """Bound of the perturbations' differential acceleration: `constant` + `gradient` ‖r‖ + `per_speed` ‖v‖.

    Attributes:
        constant: m/s².
        gradient: of the chaser's distance from the target, 1/s².
        per_speed: of its speed relative to the target, 1/s.

    """

    constant: float = 0.0
    gradient: float = 0.0
    per_speed: float = 0.0


def orbit_of(entry: OrbitEntry) -> orbits.Orbit:
    """Build the Kepler ellipse that the target is on at the epoch."""
    return orbits.Orbit(**entry.model_dump(exclude={"j2"}))


def perturbations(scenario: Scenario) -> tuple[orbits.Perturbation, ...]:
    """Build what bends the scenario's orbits away from Kepler's."""
    drag, sun = scenario.drag, scenario.sun
    found: list[orbits.Perturbation] = [orbits.J2()] if scenario.orbit.j2 else []
    if drag.density > 0.0:
        found.append(orbits.Drag(**drag.model_dump()))
    if sun.target_area_to_mass or sun.chaser_area_to_mass:
        found.append(orbits.SolarPressure(direction=sun_of(scenario), **sun.model_dump(exclude={"direction"})))
    return tuple(found)


def sun_of(scenario: Scenario) -> tuple[float, float, float]:
    """Give the unit vector from the Earth to the scenario's sun, ECI: as told, or as it is at the epoch."""
    given = scenario.sun.direction
    direction = orbits.sun_direction(parse_instant(scenario.epoch)) if given is None else np.asarray(given)
    x, y, z = (direction / np.linalg.norm(direction)).tolist()
    return x, y, z


def orbit_bounds(scenario: Scenario) -> OrbitBounds:
    """Bound the target's orbit over the scenario's flight, whose last control period may end after its duration.

    Raises:
        ScenarioError: perturbations bring the target down to the Earth.

    """
    parts = perturbations(scenario)
    if parts:
        flown = max(scenario.duration, scenario.steps * scenario.control.period)
        known = scenario.orbit, scenario.drag, scenario.sun.target_area_to_mass
        return _perturbed(*known, parts, flown)  # pyright: ignore[reportArgumentType]: frozen models have a hash
    mu = orbits.EARTH_GRAVITATIONAL_PARAMETER
    a, e = scenario.orbit.semi_major_axis, scenario.orbit.eccentricity
    # Largest true-anomaly rate, at perigee, and a bound on its derivative 2 μ e (1+e)³ / (a³ (1−e²)³).
    rate = math.sqrt(mu / (a * (1.0 - e * e)) ** 3) * (1.0 + e) ** 2
    acceleration = 2.0 * mu * e * (1.0 + e) ** 3 / (a * (1.0 - e * e)) ** 3
    return OrbitBounds(rate, acceleration, a * (1.0 - e))


def differential_bounds(
    scenario: Scenario, orbit: OrbitBounds, *, nearest: float, angular_rate: float, fastest: float
) -> DifferentialBounds:
    """Bound the difference of the perturbations' accelerations of chaser and target.

    J2 is half the second derivative of 1/r along the pole, so its gradient is a fourth derivative of 1/r, at most
    ½ 4!/r⁵. Drag −½ B ρ w ‖w‖ changes with place by the density's scale height and by the air's turning, and with
    velocity by B ρ ‖w‖; what remains is the difference of the B at the same place. Sunlight changes with place at the
    shadow's edge only, by all of itself over the edge's width.

    Args:
        scenario: its orbit and drag.
        orbit: its bounds.
        nearest: least distance from the Earth's centre of any point between target and chaser, m.
        angular_rate: largest inertial rate of the body frame, rad/s.
        fastest: largest speed of the chaser relative to the target, m/s.

    """
    by_place = 12.0 * _OBLATENESS / nearest**5 if scenario.orbit.j2 else 0.0
    drag, sun = scenario.drag, scenario.sun
    by_place += orbits.SOLAR_PRESSURE * sun.chaser_area_to_mass / orbits.PENUMBRA
    pushed = orbits.SOLAR_PRESSURE * abs(sun.chaser_area_to_mass - sun.target_area_to_mass)
    if drag.density == 0.0:
        return DifferentialBounds(constant=pushed, gradient=by_place)
    turning = angular_rate + orbits.EARTH_ROTATION_RATE
    density = _density(drag, nearest)
    wind = orbit.air_speed + fastest + turning * (orbit.lowest_radius - nearest)
    per_speed = drag.chaser_area_to_mass * density * wind
    by_place += 0.5 * drag.chaser_area_to_mass * density * wind**2 / drag.scale_height
    return DifferentialBounds(
        constant=pushed + 0.5 * abs(drag.chaser_area_to_mass - drag.target_area_to_mass) * density * wind**2,
        gradient=by_place + per_speed * turning,
        per_speed=per_speed,
    )


def _density(drag: DragEntry, radius: float) -> float:
    """Give the air's density at a distance from the Earth's centre, kg/m³; it falls with the distance."""
    return drag.density * math.exp(-(radius - orbits.EARTH_EQUATORIAL_RADIUS - drag.altitude) / drag.scale_height)


@functools.lru_cache(maxsize=8)
def _perturbed(
    entry: OrbitEntry, drag: DragEntry, area: float, parts: tuple[orbits.Perturbation, ...], duration: float
) -> OrbitBounds:
    """Bound a perturbed orbit over `duration` s; `area` is that of the target in sunlight over its mass, m²/kg."""
    mu, spin = orbits.EARTH_GRAVITATIONAL_PARAMETER, orbits.EARTH_ROTATION_RATE
    steps = min(max(math.ceil(duration), 1), _MOST_STEPS)
    half = 0.5 * duration / steps
    position, velocity = _path(entry, parts, duration / steps, steps)
    shone = orbits.SOLAR_PRESSURE * area
    distance, speed = np.linalg.norm(position, axis=1), np.linalg.norm(velocity, axis=1)
    momentum = np.linalg.norm(np.cross(position, velocity), axis=1)
    radial = np.abs(np.einsum("ij,ij->i", position, velocity)) / distance
    lowest = float(distance.min())
    # Within half a step of a sample, as long as no acceleration is more than `_STRONGEST`.
    fastest = float(speed.max()) * _OUTWARD + half * _STRONGEST
    floor = lowest / _OUTWARD - half * fastest
    ceiling = float(distance.max()) * _OUTWARD + half * fastest
    if not floor >= _LOWEST:
        raise ScenarioError(
            f"orbit: drag or j2 bring the target to {lowest:.4g} m from the Earth's centre within "
            f"{duration:g} s; it must stay above {_LOWEST:.4g} m"
        )
    wind = fastest + spin * ceiling
    oblate = 3.0 * _OBLATENESS / floor**4 if entry.j2 else 0.0
    dragged = 0.5 * drag.target_area_to_mass * _density(drag, floor) * wind**2
    pull = mu / floor**2 + oblate + dragged + shone
    if pull > _STRONGEST:
        raise ScenarioError(
            f"drag: the target would feel {dragged:.3g} m/s2 at {floor:.4g} m from the Earth's centre; give thinner air"
        )
    bent = oblate + dragged + shone
    # r a for the largest push a: J2's falls with r, the others are taken at their largest everywhere.
    turning = floor * oblate + ceiling * (dragged + shone)
    least_momentum = float(momentum.min()) / _OUTWARD - half * ceiling * bent
    most_momentum = float(momentum.max()) * _OUTWARD + half * ceiling * bent
    climbing = float(radial.max()) * _OUTWARD + half * (pull + most_momentum**2 / floor**3)
    along, across = most_momentum / floor**2, turning / least_momentum
    gradient = 12.0 * _OBLATENESS / floor**5 if entry.j2 else 0.0
    per_speed = drag.target_area_to_mass * _density(drag, floor) * wind
    gradient += dragged / drag.scale_height + per_speed * spin + shone / orbits.PENUMBRA
    bending = gradient * fastest + per_speed * pull + bent * across
    along_change = bent / floor + 2.0 * along * climbing / floor
    across_change = (climbing * bent + ceiling * bending) / least_momentum + (ceiling * bent / least_momentum) ** 2
    return OrbitBounds(
        rate=math.hypot(along, across),
        acceleration=math.hypot(along_change, across_change),
        lowest_radius=floor,
        air_speed=wind,
        valid_until=duration + half,
    )


def _path(
    entry: OrbitEntry, parts: tuple[orbits.Perturbation, ...], step: float, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the target's ECI positions (m) and velocities (m/s), (steps + 1, 3) each, by classical Runge–Kutta."""

    def derivative(state: jax.Array) -> jax.Array:
        mu = jnp.asarray(orbits.EARTH_GRAVITATIONAL_PARAMETER)
        return jnp.concatenate([state[3:], orbits.target_acceleration(state[:3], state[3:], mu, parts)])

    @eqx.filter_jit
    def path(start: jax.Array) -> jax.Array:
        def advance(state: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            first = derivative(state)
            second = derivative(state + 0.5 * step * first)
            third = derivative(state + 0.5 * step * second)
            fourth = derivative(state + step * third)
            return state + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth), state

        return jax.lax.scan(advance, start, length=steps + 1)[1]

    states = np.asarray(path(jnp.concatenate(orbit_of(entry).inertial_state(jnp.zeros(())))))
    return states[:, :3], states[:, 3:]


def turning_freely(angular_velocity: np.ndarray, inertia: np.ndarray) -> tuple[float, float]:
    """Bound ‖ω‖ (rad/s) and ‖ω̇‖ (rad/s²) of a body without torque.

    Energy and momentum are kept, so ‖ω‖² ≤ 2E/I_min and ‖ω̇‖ ≤ ‖L‖‖ω‖/I_min.
    """
    least = float(np.linalg.eigvalsh(inertia)[0])
    rate = math.sqrt(max(angular_velocity @ inertia @ angular_velocity, 0.0) / least)
    return rate, float(np.linalg.norm(inertia @ angular_velocity)) * rate / least


def turned_by_gravity(
    motion: RelativeMotion, *, period: float, steps: int, lowest_radius: float
) -> tuple[float, float]:
    """Bound ‖ω‖ (rad/s) and ‖ω̇‖ (rad/s²) of a body that gravity turns, over a flight.

    The target's motion is known: it is integrated once, with the flight's own steps. Between two of them ω changes by
    at most half a period of the largest ω̇, and ‖ω̇‖ ≤ (τ + I_max ‖ω‖²)/I_min with τ = 3 μ (I_max − I_min)/(2 R³), the
    largest gravity-gradient torque.

    Args:
        motion: whose `attitude_motion` is a `Tumbling` with `gravity_gradient`.
        period: between steps, s.
        steps: of the flight.
        lowest_radius: of the target's orbit, m.

    """
    leaves, structure = jax.tree.flatten(motion)
    numbers = tuple((np.shape(leaf), *np.ravel(leaf).tolist()) for leaf in leaves)
    return _turned(structure, numbers, period, steps, lowest_radius)


@functools.lru_cache(maxsize=64)
def _turned(
    structure: Any, numbers: tuple[tuple, ...], period: float, steps: int, lowest_radius: float
) -> tuple[float, float]:
    """Bound how a motion turns that is given by what can be looked up: its structure, each leaf's shape and numbers.

    One flight asks several times, and an integration takes some 10 µs a step.
    """
    leaves = [jnp.reshape(jnp.asarray(values), shape) for shape, *values in numbers]
    motion: RelativeMotion = jax.tree.unflatten(structure, leaves)
    inertia = np.asarray(motion.attitude_motion.inertia)  # pyright: ignore[reportAttributeAccessIssue]
    least, _, most = np.linalg.eigvalsh(inertia)
    torque = 1.5 * orbits.EARTH_GRAVITATIONAL_PARAMETER / lowest_radius**3 * (most - least)
    beside = motion.initial_state(np.zeros(3), np.zeros(3))
    sampled = float(np.max(np.asarray(_rates(motion, beside, jnp.asarray(period), steps)))) * _OUTWARD

    def change(rate: float) -> float:
        return (torque + most * rate**2) / least

    # The largest rate x between two samples obeys x ≤ sampled + ½ T ω̇(x); the least x that allows no more is the bound.
    rate = sampled
    for _ in range(100):
        rate = sampled + 0.5 * period * change(rate) * _OUTWARD
        if not math.isfinite(rate):
            break
    if not sampled + 0.5 * period * change(rate) <= rate * _OUTWARD:
        return math.inf, math.inf
    return rate * _OUTWARD, change(rate * _OUTWARD)


@eqx.filter_jit
def _rates(motion: RelativeMotion, start: MotionState, period: jax.Array, steps: int) -> jax.Array:
    return motion.of_target(lambda state: jnp.linalg.norm(state.angular_velocity), start, period, steps)

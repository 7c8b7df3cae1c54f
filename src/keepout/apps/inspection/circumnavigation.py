"""Natural-motion circumnavigation: an ellipse about the target that needs no thrust, checked by the exact motion.

Seen from VVLH, Hill's equations let a chaser circle the target once an orbit on an ellipse twice as long along the
orbit as it is high, in a plane that may be tilted: with a the height and b the motion across the orbit,

    R = a cos φ,    T = −2a sin φ,    N = b cos(φ + β),    φ = n t + φ₀.

Where β is 90° the ellipse encircles the orbit's direction too, so that a drift along the orbit leads past the target.
The velocity is corrected until the exact motion comes back to its place after one orbit of the target, which on an
eccentric orbit Hill's equations do not do. Sizes and tilts are tried side by side, and an ellipse is used only where
the exact drift is proved to keep the stand-off (`passive`). From where the mission starts two burns and
a coast between them lead onto it (`transfer`).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.apps.inspection.passive import (
    VVLH_FROM_RTN,
    Distance,
    coast_matrix,
    drift,
    passive_safety,
    rows,
    states_at_times,
)
from keepout.core.control.law import Command, Law
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Point, Points
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.attitude import VVLHFixed
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.motion.rotation import matrix

TILTS = ((0.0, 0.0), *((share, math.radians(beta)) for share in (1.0, math.sqrt(3.0)) for beta in (0, 90, 180, 270)))
"""Motions across the orbit that are tried: b/a, and β in rad. √3 with 0 or 180° is a circle."""
Sizes = float | Float[np.ndarray, " k"]
_SIZES = 16
"""Heights tried for each tilt: from one that is surely too low to one that is surely enough, then between two."""
_AFAR = 1e5
"""Metres from which the target's reach along an axis is looked at."""
_CORRECTIONS = 3
_BAND = 0.5
"""Metres from the reference at which thrusting begins; an ellipse is sized to keep so much more than the stand-off."""
_RETURN = 500.0
"""Seconds in which the chaser is to drift back from the edge of the band; from beyond it faster, by the square."""
_PERIODS = 5.0
"""Control periods in which the velocity is brought to that of the way back."""
_DONE = 0.1
"""Share of the velocity of the way back within which thrusting ends."""
_LONGEST = 0.1
"""Share of the mission's duration that the coast may take."""
_TRIED = 24
"""Lengths of it that are tried, from the shortest that the speed limit allows."""
_PLACES = 90
"""Of the ellipse to which it may lead."""


@dataclass(frozen=True, eq=False)
class Circumnavigation:
    """A drift about a target, at every control period.

    Attributes:
        height: a, m.
        across: b, m.
        tilt: β, rad.
        times: (k,) s of the mission, a control period apart.
        position: (k, 3) body frame, m.
        velocity: (k, 3) as seen by one who turns with the body, m/s.
        clearance: a lower bound on the distance of the chaser's centre from the mesh over all of it, m, without push.
        turns: about the target.

    """

    height: float
    across: float
    tilt: float
    times: Float[np.ndarray, " k"]
    position: Float[np.ndarray, "k 3"]
    velocity: Float[np.ndarray, "k 3"]
    clearance: float
    turns: float

    def law(self, scenario: Scenario) -> "CoastingLaw":
        """Make the law that keeps a chaser on it."""
        chaser = scenario.chaser.mass, scenario.chaser.force_limit
        of = self.times[0], self.position, self.velocity, scenario.control.period, *chaser
        return CoastingLaw(*map(jnp.asarray, of))


def hill_states(mean_motion: float, height: Sizes, across: Sizes, tilt: Sizes, phase: Sizes) -> tuple[Points, Points]:
    """Give positions (m) and velocities (m/s) in VVLH on an ellipse of Hill's equations at phases φ, or on one each.

    Args:
        mean_motion: n, 1/s.
        height: a, half of the ellipse's height, m.
        across: b, amplitude across the orbit, m.
        tilt: β, by which the motion across is ahead, rad.
        phase: φ, rad.

    """
    n, a, b = mean_motion, height, across
    place = np.stack([a * np.cos(phase), -2.0 * a * np.sin(phase), b * np.cos(phase + tilt)], axis=-1)
    rate = np.stack([-a * np.sin(phase), -2.0 * a * np.cos(phase), -b * np.sin(phase + tilt)], axis=-1)
    return place @ VVLH_FROM_RTN.T, n * rate @ VVLH_FROM_RTN.T


def circumnavigations(scenario: Scenario, distance: Distance) -> tuple[Circumnavigation, ...]:
    """Give the smallest ellipse of each tilt that keeps the stand-off, by the exact motion; the nearest one first.

    Args:
        scenario: orbit, attitude, `inspect.stand_off` and duration, for which it is to last.
        distance: exact and unsigned, to the target's mesh, m.

    Raises:
        InspectionError: no ellipse keeps the stand-off within the range of the bounds.

    """
    low, high = _heights(distance, scenario)
    heights = np.repeat(np.geomspace(low, high, _SIZES)[:, None], len(TILTS), axis=1)
    _, _, enough = _tried(scenario, distance, heights)
    first = np.where(enough.any(axis=0), np.argmax(enough, axis=0), _SIZES - 1)
    below = np.take_along_axis(heights, np.maximum(first - 1, 0)[None], axis=0)[0]
    heights = np.linspace(below, np.take_along_axis(heights, first[None], axis=0)[0], _SIZES)
    states, clearance, enough = _tried(scenario, distance, heights)
    motion, period, found = Surroundings(scenario).motion, scenario.control.period, []
    seconds = scenario.steps * period
    for tilt in np.flatnonzero(enough.any(axis=0)):
        size = int(np.argmax(enough[:, tilt]))
        index = size * len(TILTS) + tilt
        one = rows(states, slice(index, index + 1))
        path, rate = drift(motion, one, period, scenario.steps)
        height, (share, beta) = float(heights[size, tilt]), TILTS[tilt]
        times, turns = period * np.arange(path.shape[1]), seconds * float(motion.orbit.mean_motion) / (2.0 * math.pi)
        kept = float(clearance[size, tilt])
        found.append(Circumnavigation(height, height * share, beta, times, path[0], rate[0], kept, turns))
    if not found:
        raise InspectionError(
            f"circumnavigation: no ellipse of height {low:.3g} to {high:.3g} m keeps inspect.stand_off "
            f"{scenario.inspect.stand_off:g} m and {_BAND:g} m more for {seconds:g} s"
        )
    return tuple(sorted(found, key=lambda one: float(np.mean(distance(one.position[:: len(one.times) // 200 + 1])))))


def _heights(distance: Distance, scenario: Scenario) -> tuple[float, float]:
    """Give a height below which an ellipse surely comes too near, and one from which on it surely does not, m."""
    stand_off, mass = scenario.inspect.stand_off, np.asarray(scenario.target.centre_of_mass, float)
    at_centre = float(distance(mass[None])[0])
    # From so far away the distance is that to the box along the axis, but for a part in ten thousand.
    reach = _AFAR - distance(mass + _AFAR * np.concatenate([np.eye(3), -np.eye(3)]))
    return max(0.5 * stand_off, 0.5 * at_centre), 1.01 * (float(np.linalg.norm(np.abs(reach))) + stand_off) + 1.0


def _tried(
    scenario: Scenario, distance: Distance, heights: Float[np.ndarray, "sizes tilts"]
) -> tuple[MotionState, Float[np.ndarray, "sizes tilts"], Bool[np.ndarray, "sizes tilts"]]:
    """Give the first states of ellipses (one after the other), bounds on how near they come, and if that is enough."""
    motion, height = Surroundings(scenario).motion, heights.ravel()
    (share, beta), phase = np.tile(TILTS, (len(heights), 1)).T, np.zeros(len(height))
    position, velocity = hill_states(float(motion.orbit.mean_motion), height, height * share, beta, phase)
    states = in_body(scenario, position, _closed(motion, position, velocity))
    radius, asked = scenario.chaser.radius, scenario.inspect.stand_off + _BAND
    least = asked - radius
    seconds = scenario.steps * scenario.control.period
    kept = passive_safety(scenario, distance, states, seconds, push=0.0, enough=least, too_little=least)
    clearance = (kept.clearance + radius).reshape(heights.shape)
    return states, clearance, clearance >= asked


def _closed(motion: RelativeMotion, position: Points, velocity: Points) -> Points:
    """Change velocities along the orbit (VVLH, m/s) until the exact motion comes back along it after one orbit."""
    turning = replace(motion, attitude_motion=VVLHFixed(), centre_of_mass=np.zeros(3))
    period = 2.0 * math.pi / float(motion.orbit.mean_motion)
    count = max(math.ceil(period * float(motion.orbit.mean_motion) / 0.009), 64)
    for _ in range(_CORRECTIONS):
        states = jax.vmap(lambda r, v: turning.initial_state(r, v, 0.0))(jnp.asarray(position), jnp.asarray(velocity))
        path, _ = drift(turning, states, period / count, count)
        along = (path[:, -1, 0] - path[:, 0, 0]) / (3.0 * period)
        velocity = velocity + np.stack([along, *np.zeros((2, len(path)))], 1)
    return velocity


def _axes(scenario: Scenario) -> tuple[Float[np.ndarray, "3 3"], Point, Point]:
    """Give at the mission's start the rotation from VVLH to the body frame, its rate (rad/s) and the origin (m)."""
    motion = Surroundings(scenario).motion
    target = states_at_times(scenario, np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))
    one = rows(target, 0)
    turn = matrix(one.attitude)
    turning = one.angular_velocity - turn @ motion.orbital_frame(one).angular_velocity
    return np.asarray(turn), np.asarray(turning), np.asarray(motion.centre_of_mass)


def in_body(scenario: Scenario, position: Points, velocity: Points) -> MotionState:
    """Give states in the body frame at the mission's start from positions (m) and velocities (m/s) in VVLH.

    Positions in VVLH are told from the target's centre of mass.
    """
    turn, turning, origin = _axes(scenario)
    from_mass = position @ turn.T
    moving = velocity @ turn.T - np.cross(turning, from_mass)
    return states_at_times(scenario, np.zeros(len(position)), from_mass + origin, moving)


class CoastingLaw(Law):
    """Lets the chaser drift, and steers it back where it is more than `_BAND` from a reference.

    Attributes:
        begun: time of the reference's first sample, s.
        position: (k, 3) of it, a control period apart, m.
        velocity: (k, 3) m/s.
        period: s.
        mass: kg.
        force_limit: of an axis, N.

    """

    begun: Float[Array, ""]
    position: Float[Array, "k 3"]
    velocity: Float[Array, "k 3"]
    period: Float[Array, ""]
    mass: Float[Array, ""]
    force_limit: Float[Array, ""]

    @property
    def goal(self) -> Float[Array, "3"]:
        """Where the reference ends, m."""
        return self.position[-1]

    def initial_state(self, state: MotionState) -> Bool[Array, ""]:
        """Remember that it is not thrusting."""
        return jnp.zeros((), bool)

    def step(self, state: Bool[Array, ""], estimate: MotionState) -> tuple[Bool[Array, ""], Command]:
        """Give no force within the band, and what leads back from beyond it."""
        index = jnp.round((estimate.time - self.begun) / self.period).astype(jnp.int32)
        index = jnp.clip(index, 0, len(self.position) - 1)
        off, faster = estimate.position - self.position[index], estimate.velocity - self.velocity[index]
        away = jnp.linalg.norm(off)
        missing = -off / _RETURN * jnp.maximum(away / _BAND, 1.0) ** 2 - faster
        # Once it drifts back as it should it is left alone, also while it is still outside the band.
        steering = ((away > _BAND) | state) & (jnp.linalg.norm(missing) > _DONE * _BAND / _RETURN)
        back = self.mass * missing / (_PERIODS * self.period)
        limited = jnp.clip(back, -self.force_limit, self.force_limit)
        return steering, Command.of_force(jnp.where(steering, limited, 0.0))


@dataclass(frozen=True)
class Transfer:
    """Two burns and a coast.

    Attributes:
        first: of the burns, m/s.
        second: m/s.
        seconds: that the coast takes.
        keeps_stand_off: whether it is proved to.

    """

    first: float
    second: float
    seconds: float
    keeps_stand_off: bool

    @property
    def delta_v(self) -> float:
        """Of both burns, m/s."""
        return self.first + self.second

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        return {
            "burn_mps": self.delta_v,
            "transfer_s": self.seconds,
            "transfer_keeps_stand_off": self.keeps_stand_off,
        }


def transfer(scenario: Scenario, distance: Distance, ellipse: Circumnavigation) -> Transfer:
    """Give the cheapest transfer from a scenario's start onto an ellipse, to any place of it.

    The coast follows from Hill's equations, in closed form. That it keeps the stand-off is proved by the exact motion,
    for a target that begins to turn as it does when the mission starts.

    Of the coasts tried, those that keep the stand-off go before those that do not. None takes more than a tenth of the
    mission, or begins faster than the chaser may fly.

    Args:
        scenario: its start, orbit, attitude, duration and `inspect.stand_off`.
        distance: exact and unsigned, to the target's mesh, m.
        ellipse: of the same scenario.

    """
    limit = scenario.chaser.speed_limit
    n = float(Surroundings(scenario).motion.orbit.mean_motion)
    turn, turning, origin = _axes(scenario)
    from_mass = np.asarray(scenario.start.position, float) - origin
    velocity = np.asarray(scenario.start.velocity, float) + np.cross(turning, from_mass)
    start, moving = turn.T @ from_mass, turn.T @ velocity
    ends, rates = hill_states(n, ellipse.height, ellipse.across, ellipse.tilt, np.linspace(0.0, 2.0 * np.pi, _PLACES))
    longest = _LONGEST * scenario.duration
    shortest = float(np.clip(np.linalg.norm(ends - start, axis=1).min() / limit, scenario.control.period, longest))
    found = []
    for seconds in np.geomspace(shortest, longest, _TRIED).tolist():
        whole = coast_matrix(n, seconds)
        leaving = np.linalg.solve(whole[:3, 3:], (ends - whole[:3, :3] @ start).T).T
        arriving = whole[3:, :3] @ start + leaving @ whole[3:, 3:].T
        first, second = np.linalg.norm(leaving - moving, axis=1), np.linalg.norm(rates - arriving, axis=1)
        keeps = _keeps(scenario, distance, start, leaving, seconds)
        # The longest is told, too, if the start is too far for it.
        slow = (np.linalg.norm(leaving, axis=1) <= limit) | math.isclose(seconds, longest)
        found += [Transfer(float(first[k]), float(second[k]), seconds, bool(keeps[k])) for k in np.flatnonzero(slow)]
    return min(found, key=lambda one: (not one.keeps_stand_off, one.delta_v))


def _keeps(
    scenario: Scenario, distance: Distance, position: Point, velocity: Points, seconds: float
) -> Bool[np.ndarray, " n"]:
    """Prove of coasts from a place (VVLH) that they keep the stand-off, from the mission's start on."""
    asked = scenario.inspect.stand_off - scenario.chaser.radius
    states = in_body(scenario, np.tile(position, (len(velocity), 1)), velocity)
    told = passive_safety(scenario, distance, states, seconds, push=0.0, enough=asked, too_little=asked)
    return told.clearance >= asked

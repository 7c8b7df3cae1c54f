"""Passive safety: a chaser whose thrust stops touches nothing for a stated time; how fast legs may then be flown.

What is proved, for each state: the nominal drift (exact relative motion, no force) keeps clear of the mesh by more than
chaser radius and tube, and of zones, the tube being how far errors of the state and a push that nobody commanded can
lead away (`Spread`). Between the samples of the drift the audit's parabolas and their error hold (`audit/tube.py`);
distances are 1-Lipschitz. Where a drift leaves the range in which gravity is bounded, nothing is proved.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.apps.inspection.zones import Nearest, with_zones
from keepout.core.audit.tube import Tube, lengths
from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.errors import InspectionError, require_finite
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.distance import Points
from keepout.core.mission.bounds import perturbations
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER
from keepout.core.motion.relative import MotionState, RelativeMotion

VVLH_FROM_RTN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Rotation that takes radial, along-track and normal components to VVLH."""
_STEEPEST, _TURNING = 7.08, 12.4
"""Bounds of ‖Φ_vv‖ = ‖Φ_rv'‖ and, over n, of ‖Φ_vr‖ = ‖Φ_rr'‖, by the sums of their entries' squares."""
_CELLS = 2000
"""Of the integral K."""
_TOGETHER = 512
"""Drifts that are propagated and looked at together."""
_RUN = 64
"""Steps that one program takes."""
_TURN = 0.009
"""Radians that the body frame turns in a step, at most: a step a second at half a degree a second."""
_LONGEST_STEP = 60.0
_INTEGRATION = 1e-4
"""Metres: more than the Runge–Kutta steps lose in a day (tests/apps/inspection/test_passive.py)."""
_HALVINGS = 12
_TOLERANCE = 0.02
"""Metres to which the bound of a drift's clearance is driven."""
_MOST_STEPS = 100_000
Distance = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]
Course = Float[np.ndarray, "_ 3"]
"""Corners of a leg, m: those of one list differ in number."""
_SPEEDS = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125, 0.09375, 0.0625, 0.046875, 0.03125)
"""Shares of the speed limit at which a leg is judged."""
_APART = 0.2
"""Metres from one judged state of a piece to the next, at most."""


def coast_matrix(mean_motion: float, seconds: float | Float[np.ndarray, "*times"]) -> Float[np.ndarray, "*times 6 6"]:
    """Give the matrix from a state (position m, velocity m/s; VVLH) to the state `seconds` later, without force.

    Hill's equations, also called those of Clohessy and Wiltshire, in closed form: coasting near a target on a circular
    orbit. Linear in the distance, so a plan's first draft only: what is flown or proved uses the exact relative motion
    (`motion/relative.py`), from which it departs by about 1.5 n² r²/a (a: the orbit's radius) in acceleration. With R
    outwards, T along the velocity, N along the orbit normal, VVLH has x = T, y = −N, z = −R.

    Args:
        mean_motion: n of the circular orbit, rad/s.
        seconds: any shape.

    """
    n, t = mean_motion, np.asarray(seconds, float)
    s, c = np.sin(n * t), np.cos(n * t)
    rtn = np.zeros((*t.shape, 6, 6))
    rtn[..., 0, 0], rtn[..., 0, 3], rtn[..., 0, 4] = 4.0 - 3.0 * c, s / n, 2.0 * (1.0 - c) / n
    rtn[..., 1, 0], rtn[..., 1, 1] = 6.0 * (s - n * t), 1.0
    rtn[..., 1, 3], rtn[..., 1, 4] = -2.0 * (1.0 - c) / n, (4.0 * s - 3.0 * n * t) / n
    rtn[..., 2, 2], rtn[..., 2, 5] = c, s / n
    rtn[..., 3, 0], rtn[..., 3, 3], rtn[..., 3, 4] = 3.0 * n * s, c, 2.0 * s
    rtn[..., 4, 0], rtn[..., 4, 3], rtn[..., 4, 4] = 6.0 * n * (c - 1.0), -2.0 * s, 4.0 * c - 3.0
    rtn[..., 5, 2], rtn[..., 5, 5] = -n * s, c
    turn = np.kron(np.eye(2), VVLH_FROM_RTN)
    return turn @ rtn @ turn.T


@dataclass(frozen=True)
class Spread:
    """Bounds from which the growth follows; `Spread.of` takes them from a scenario.

    Let δ be the difference of two motions, and η its rate as seen from inertial space, in body axes. Then

        |δ|' ≤ |η|,    |η|' ≤ γ |δ| + c |η| + a,

    a bounding the push, γ the gradient of differential gravity and what perturbations add to it, c what drag adds: the
    turning of the frame moves neither norm. The larger solution with equality bounds both (Müller's theorem). That
    grows like a hyperbolic cosine. On a circular orbit without perturbations Hill's equations with their matrices Φ are
    exact but for ε = the change of the gradient of gravity over the range, and

        |δ(t)| ≤ A(t) + ∫ ‖Φ_rv(t − s)‖ (a + ε |δ(s)|) ds,   so   sup |δ| ≤ (A + a K) / (1 − ε K),   K = ∫ ‖Φ_rv‖,

    A being what the errors at the start grow to. It counts the turning where the first bound does not, and is the
    smaller one from about a third of an orbit on. The smaller of the two is used.

    Attributes:
        push: largest acceleration that nobody commanded, m/s².
        gradient: γ, 1/s².
        per_speed: c, 1/s.
        frame_rate: largest inertial rate of the body frame, rad/s.
        range_limit: of the chaser from the target, m: within it the gradient holds.
        mean_motion: of a circular orbit without perturbations, rad/s; 0 for any other.

    """

    push: float
    gradient: float
    per_speed: float
    frame_rate: float
    range_limit: float
    mean_motion: float = 0.0

    @classmethod
    def of(cls, scenario: Scenario, push: float | None = None) -> "Spread":
        """Take the bounds from a scenario: its orbit, attitude, perturbations, and its disturbance or a push, N.

        Raises:
            InspectionError: a push that is negative or not a number.

        """
        if push is not None:
            require_finite(push, f"passive safety: push is {push} N", InspectionError)
        bounds, orbit = Surroundings(scenario).flight_bounds, scenario.orbit
        circular = orbit.eccentricity == 0.0 and not perturbations(scenario)
        return cls(
            push=(bounds.disturbance_force if push is None else push) / bounds.mass,
            gradient=bounds.gravity_gradient,
            per_speed=2.0 * bounds.angular_rate if scenario.drag.density > 0.0 else 0.0,
            frame_rate=bounds.angular_rate,
            range_limit=bounds.range_limit,
            mean_motion=math.sqrt(EARTH_GRAVITATIONAL_PARAMETER / orbit.semi_major_axis**3) if circular else 0.0,
        )

    def radius(
        self, times: Float[np.ndarray, " k"], *, position_error: float = 0.0, velocity_error: float = 0.0
    ) -> Float[np.ndarray, " k"]:
        """Bound how far the chaser is from its nominal drift, m, at times (s, from 0 on, ascending) after the start.

        Args:
            times: since the thrust stopped.
            position_error: of the state that the nominal drift starts from, in norm, m.
            velocity_error: likewise, in the body frame, m/s.

        Raises:
            InspectionError: an error that is negative or not a number.

        """
        for name, value in (("position_error", position_error), ("velocity_error", velocity_error)):
            require_finite(value, f"passive safety: {name} is {value}", InspectionError)
        found = self._by_norms(times, position_error, velocity_error + self.frame_rate * position_error)
        if self.mean_motion:
            faster = velocity_error + (self.frame_rate + self.mean_motion) * position_error
            found = np.minimum(found, self._by_hill(times, position_error, faster))
        return np.maximum.accumulate(found)

    def _by_norms(self, times: Float[np.ndarray, " k"], apart: float, faster: float) -> Float[np.ndarray, " k"]:
        """Solve u' = w, w' = γ u + c w + a from (apart, faster)."""
        half = 0.5 * self.per_speed
        root = math.sqrt(half * half + self.gradient)
        if root * float(np.max(times, initial=0.0)) < 1e-6:
            return apart + faster * times + 0.5 * (1.0 + 1e-5) * self.push * times**2
        up, down = half + root, half - root
        with np.errstate(over="ignore"):
            quick, slow = np.exp(up * times), np.exp(down * times)
            answer = (quick - slow) / (up - down)
            own = (up * slow - down * quick) / (up - down)
            slow_sum = times if down == 0.0 else np.expm1(down * times) / down
            summed = (np.expm1(up * times) / up - slow_sum) / (up - down)
        return apart * own + faster * answer + self.push * summed

    def _by_hill(self, times: Float[np.ndarray, " k"], apart: float, faster: float) -> Float[np.ndarray, " k"]:
        last = float(np.max(times, initial=0.0))
        if last == 0.0:
            return np.full(len(times), apart)
        n, cell = self.mean_motion, last / _CELLS
        grid = np.linspace(0.0, last, _CELLS + 1)
        whole = coast_matrix(n, grid)
        answer = np.linalg.norm(whole[:, :3, 3:], ord=2, axis=(1, 2))
        own = np.linalg.norm(whole[:, :3, :3], ord=2, axis=(1, 2))
        most = np.maximum(answer[:-1], answer[1:]) + 0.5 * _STEEPEST * cell
        kernel = np.concatenate([[0.0], np.cumsum(most) * cell])
        start = np.maximum.accumulate(own + 0.5 * _TURNING * n * cell) * apart
        start[1:] += np.maximum.accumulate(most) * faster
        radius = (EARTH_GRAVITATIONAL_PARAMETER / n**2) ** (1.0 / 3.0) - self.range_limit
        changed = 6.0 * EARTH_GRAVITATIONAL_PARAMETER / radius**4 * self.range_limit
        left = 1.0 - changed * kernel
        bound = np.where(left > 0.0, (start + self.push * kernel) / np.maximum(left, 1e-300), np.inf)
        return bound[np.minimum(np.ceil(times / cell).astype(int), _CELLS)]


@dataclass(frozen=True, eq=False)
class PassiveSafety:
    """What is known of drifts, one entry a state.

    Attributes:
        clearance: a lower bound on the distance from the chaser's surface to mesh and zones over the whole drift, m,
            whatever the push within its bound; −inf where a drift may leave the range in which gravity is bounded.
        found: the least value found of what `clearance` bounds; at most a tolerance above it where steps are fine.
        spread: radius of the tube at the end, m.

    """

    clearance: Float[np.ndarray, " n"]
    found: Float[np.ndarray, " n"]
    spread: float

    @property
    def safe(self) -> Bool[np.ndarray, " n"]:
        """Whether each drift is proved to touch nothing and to enter no zone."""
        return self.clearance > 0.0


def passive_safety(
    scenario: Scenario,
    distance: Distance,
    states: MotionState,
    seconds: float,
    *,
    push: float | None = None,
    position_error: float = 0.0,
    enough: float = math.inf,
    too_little: float = 0.0,
) -> PassiveSafety:
    """Bound how near drifts from many states come to a mesh, and to the scenario's zones.

    Args:
        scenario: gives motion, chaser, what bounds them, and zones (`with_zones`). Corridors do not count.
        distance: exact and unsigned, to the target's mesh, m.
        states: with a leading axis; from `states_of_record` or `states_at_times`.
        seconds: for which each drifts.
        push: largest norm of a force that nobody commanded and that is not of the motion, N, for as long as the drift
            lasts; None: of the scenario's disturbance, whose swings then count as if they never turned round.
        position_error: of each state, m.
        enough: a clearance, m, above which nobody asks how large it is.
        too_little: a clearance, m, below which nobody asks how small it is: `clearance` is then a coarse bound.

    Raises:
        InspectionError: seconds that are not positive and finite, or more steps than can be flown.

    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise InspectionError(f"passive safety: {seconds} s; it must be positive and finite")
    # A drift may begin at the end of the mission, and goes on after it.
    lasting = scenario.model_copy(update={"duration": scenario.duration + seconds})
    motion, around = Surroundings(scenario).motion, Surroundings(lasting)
    spread, bounds = Spread.of(lasting, push), around.flight_bounds
    step = min(_LONGEST_STEP, _TURN / max(bounds.angular_rate, 1e-12))
    count = math.ceil(seconds / step - 1e-9)
    if count > _MOST_STEPS:
        raise InspectionError(
            f"passive safety: {seconds:g} s at {step:.3g} s a step are {count} steps; at most {_MOST_STEPS}"
        )
    times = np.linspace(0.0, seconds, count + 1)
    radius = spread.radius(times, position_error=position_error)
    keep = scenario.chaser.radius + _INTEGRATION
    # What the nominal drift can be between its samples: no pulses, and of what pushes, only what is of the motion.
    pushed = bounds.disturbance_force if motion.perturbations else 0.0
    still = replace(bounds, disturbance_force=pushed, excursion=0.0, velocity_excursion=0.0)
    parts = []
    for begin in range(0, len(states.time), _TOGETHER):
        some = rows(states, slice(begin, begin + _TOGETHER))
        position, velocity = drift(motion, some, seconds / count, count)
        tube = Tube.of(times, position, velocity, np.zeros_like(position), still)
        farthest = lengths(position).max(axis=1) + radius[-1]
        within = ~tube.beyond.any(axis=1) & (farthest <= bounds.range_limit)
        within &= np.asarray(some.time) + seconds <= bounds.valid_until
        near = with_zones(distance, around, np.asarray(some.time))
        parts.append(_least(tube, radius, near, within, (too_little + keep, enough + keep)))
    lower, upper = (np.concatenate(part) for part in zip(*parts, strict=True))
    return PassiveSafety(lower - keep, upper - keep, float(radius[-1]))


def drift(
    motion: RelativeMotion, states: MotionState, step: float, count: int
) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n k 3"]]:
    """Let states drift: positions (m) and velocities (m/s) after 0 … `count` steps of `step` seconds, body frame."""
    drifts = len(states.time)
    size = next(size for size in (8, _TOGETHER, drifts) if size >= drifts)
    at = rows(states, np.concatenate([np.arange(drifts), np.zeros(size - drifts, int)]))
    positions, velocities = [np.asarray(at.position)[:, None]], [np.asarray(at.velocity)[:, None]]
    for _ in range(-(-count // _RUN)):
        at, position, velocity = _drift(motion, at, jnp.asarray(step, jnp.float64))
        positions.append(np.asarray(position))
        velocities.append(np.asarray(velocity))
    position, velocity = np.concatenate(positions, axis=1), np.concatenate(velocities, axis=1)
    return position[:drifts, : count + 1], velocity[:drifts, : count + 1]


def rows(states: MotionState, which: int | slice | np.ndarray) -> MotionState:
    """Give some of the states. NumPy takes them: JAX would compile a program for each number of them."""
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[which]), states)


@kept_jit
def _drift(
    motion: RelativeMotion, states: MotionState, step: Float[Array, ""]
) -> tuple[MotionState, Float[Array, "n k 3"], Float[Array, "n k 3"]]:
    """Take `_RUN` steps: one program for drifts of all lengths."""

    def one(state: MotionState) -> tuple[MotionState, Float[Array, "k 3"], Float[Array, "k 3"]]:
        def advance(at: MotionState, _: None) -> tuple[MotionState, tuple[Array, Array]]:
            after = motion.step(at, jnp.zeros(3), NoDisturbance(), step, 1.0)
            return after, (after.position, after.velocity)

        last, (position, velocity) = jax.lax.scan(advance, state, length=_RUN)
        return last, position, velocity

    return eqx.filter_vmap(one)(states)


def states_of_record(record: FlightRecord, every: int = 1) -> MotionState:
    """Give the true states at the samples of a flight, or at each `every`-th of them."""

    def column(name: str) -> Array:
        return jnp.asarray(np.asarray(getattr(record, name), np.float64)[::every])

    names = ["time", "position", "velocity", "attitude", "angular_velocity"]
    if record.target_orbit is not None:
        names.append("target_orbit")
    return eqx.filter_vmap(MotionState)(*(column(name) for name in names))


def states_at_times(
    scenario: Scenario, times: Float[np.ndarray, " n"], position: Points, velocity: Points
) -> MotionState:
    """Give states of a plan: the target as it is at each time (s, from 0 on), the chaser where it is planned to be.

    Args:
        scenario: as flown.
        times: in any order; each is taken to the nearest control period.
        position: of the chaser, body frame, m.
        velocity: likewise, m/s.

    """
    period = scenario.control.period
    index = np.rint(np.asarray(times) / period).astype(int)
    motion = Surroundings(scenario).motion
    at, parts = motion.initial_state(motion.centre_of_mass, jnp.zeros(3)), []
    for _ in range(int(index.max(initial=0)) // _RUN + 1):
        at, run = _target(motion, at, jnp.asarray(period, jnp.float64))
        parts.append(run)
    target = rows(jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), index)
    moved = (jnp.asarray(position, jnp.float64), jnp.asarray(velocity, jnp.float64))
    return eqx.tree_at(lambda state: (state.position, state.velocity), target, moved)


@kept_jit
def _target(motion: RelativeMotion, begin: MotionState, period: Float[Array, ""]) -> tuple[MotionState, MotionState]:
    """Give the target's state after `_RUN` periods, and those before it; the chaser's place does not matter."""
    states = motion.of_target(lambda state: state, begin, period, _RUN)
    return jax.tree.map(lambda leaf: leaf[-1], states), jax.tree.map(lambda leaf: leaf[:-1], states)


def _least(
    tube: Tube,
    radius: Float[np.ndarray, " k"],
    near: Nearest,
    within: Bool[np.ndarray, " n"],
    limits: tuple[float, float],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Bound the least of (distance − tube radius) over each drift, from below and above.

    Runs of steps are halved, then parts of a step, until the bound of a piece is above the tolerance below the least
    value found, or above the second of the limits, or a value below the first was found. Drifts that are not `within`
    the range of the bounds are not looked at: −inf.
    """
    drifts, samples = tube.position.shape[:2]
    travel = np.zeros((drifts, samples))
    np.cumsum(tube.speed * np.diff(tube.time), axis=1, out=travel[:, 1:])
    lower, upper = np.where(within, np.inf, -np.inf), np.full(drifts, np.inf)
    too_little, enough = limits

    def open_still(which: np.ndarray, bound: np.ndarray, last: np.ndarray | bool = False) -> np.ndarray:
        settled = (bound >= np.minimum(upper[which] - _TOLERANCE, enough)) | (upper[which] < too_little) | last
        np.minimum.at(lower, which[settled], bound[settled])
        return ~settled

    which = np.flatnonzero(within)
    steps = [(which[:0], which[:0])]
    first, end = np.zeros(which.size, int), np.full(which.size, samples - 1)
    while which.size:
        single = end - first == 1
        steps.append((which[single], first[single]))
        which, first, end = which[~single], first[~single], end[~single]
        middle = (first + end) // 2
        since = tube.time[middle]
        about = np.maximum(since - tube.time[first], tube.time[end] - since)
        found, least = near(tube.position[which, middle], which, since, about) if which.size else (since, since)
        np.minimum.at(upper, which, found - radius[middle])
        at = travel[which, middle]
        reach = np.maximum(at - travel[which, first], travel[which, end] - at)
        kept = open_still(which, least - reach - radius[end])
        which = np.tile(which[kept], 2)
        first, end = np.append(first[kept], middle[kept]), np.append(middle[kept], end[kept])
    which, first = (np.concatenate(part) for part in zip(*steps, strict=True))
    begin, until = np.zeros(which.size), np.ones(which.size)
    for halving in range(_HALVINGS + 1):
        if not which.size:
            break
        point, error, ball = tube.piece(which, first, begin, until)
        step, middle = tube.time[first + 1] - tube.time[first], 0.5 * (begin + until)
        found, least = near(point, which, tube.time[first] + middle * step, 0.5 * (until - begin) * step)
        np.minimum.at(upper, which, found + error - radius[first + 1])
        # What the parabolas leave open does not shrink with the piece.
        alone = (halving == _HALVINGS) | (ball - error <= 0.05 * error)
        kept = open_still(which, least - ball - radius[first + 1], alone)
        which, first = np.repeat(which[kept], 2), np.repeat(first[kept], 2)
        begin, until, middle = begin[kept], until[kept], middle[kept]
        begin, until = np.stack([begin, middle], axis=-1).ravel(), np.stack([middle, until], axis=-1).ravel()
    return lower, upper


@dataclass(frozen=True)
class DriftsPlanned:
    """What passive safety made of a plan.

    Attributes:
        legs: of the order that was judged, with those to views that were left out.
        safe: of them that are passively safe at some speed.
        slowed: of these that are safe only below the speed limit.
        views_left_out: views in the order to which no leg was safe.
        candidates_left_out: places tried for views at which rest is not safe.

    """

    legs: int = 0
    safe: int = 0
    slowed: int = 0
    views_left_out: int = 0
    candidates_left_out: int = 0

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        names = "legs", "legs_passive_safe", "legs_slowed", "views_left_out_passive", "candidates_left_out_passive"
        return dict(zip(names, astuple(self), strict=True))


@dataclass(eq=False)
class DriftsFlown:
    """Legs as they were begun.

    Attributes:
        legs: flown, with those to hold points.
        slowed: of them that were flown below the speed limit, since no greater speed was safe.
        unsafe: of them for which no speed was found safe; they were flown at the slowest speed that is tried.

    """

    legs: int = 0
    slowed: int = 0
    unsafe: int = 0

    def summary(self) -> dict[str, Any]:
        """Give the figures as plain numbers for JSON."""
        return {"legs_flown": self.legs, "legs_flown_slowed": self.slowed, "legs_flown_unsafe": self.unsafe}


@dataclass(frozen=True, eq=False)
class Drifting:
    """Judges places and legs by the drifts that begin there.

    A leg is judged at its speed from states all along its course. Near its ends, where the chaser gains and loses that
    speed, it is judged at every lower speed that is tried too, and from rest at the place that it leads to. The states
    of a straight piece lie `_APART` from each other at most, and each stands for all that are nearer to it than half of
    that: the tube of its drift (`Spread`) holds theirs. So no place of the course is left out. Of speeds only those
    tried are judged, and a turn from one leg to the next is not.

    Attributes:
        scenario: as flown; `inspect.passive_safety` is how long a drift lasts.
        distance: exact and unsigned, to the target's mesh, m.
        changing: metres from either end of a leg within which it may be flown more slowly than on the rest.

    """

    scenario: Scenario
    distance: Distance
    changing: float = 1.5

    @classmethod
    def of(cls, scenario: Scenario, distance: Distance) -> "Drifting | None":
        """Give the judge of a scenario; None where passive safety is not asked for."""
        return cls(scenario, distance) if scenario.inspect.passive_safety > 0.0 else None

    @property
    def slowest(self) -> float:
        """The least speed at which a leg is judged, m/s."""
        return _SPEEDS[-1] * self.scenario.chaser.speed_limit

    def at_rest(self, places: Points, time: float) -> Bool[np.ndarray, " n"]:
        """Say of places whether a drift from rest there at a time (s) is safe."""
        times = np.full(len(places), time)
        return self._safe(times, np.asarray(places, dtype=float), np.zeros((len(places), 3)), 0.0)

    def speeds(self, courses: Sequence[Course], times: Float[np.ndarray, "legs 2"]) -> Float[np.ndarray, " legs"]:
        """Give the greatest safe speed of each leg, m/s; 0 where none is.

        Args:
            courses: corners of the legs, m.
            times: at which each begins and ends, s: the target is taken as it is in between.

        """
        found, speeds = np.zeros(len(courses)), self.scenario.chaser.speed_limit * np.array(_SPEEDS)
        if not courses:
            return found
        along = [_along(course, *when) for course, when in zip(courses, times.tolist(), strict=True)]
        which = np.repeat(np.arange(len(along)), [len(one[0]) for one in along])
        place, ahead, at, gone, left = (np.concatenate(part) for part in zip(*along, strict=True))
        changing = np.minimum(gone, left) <= self.changing

        def safe(states: Bool[np.ndarray, " n"], speed: float) -> Bool[np.ndarray, " legs"]:
            answer = np.ones(len(courses), dtype=bool)
            answer[which[states][~self._safe(at[states], place[states], speed * ahead[states], 0.5 * _APART)]] = False
            return answer

        up_to = [safe(left <= 0.5 * _APART, 0.0)]
        for speed in reversed(speeds):
            up_to.append(up_to[-1] & safe(changing & up_to[-1][which], speed))
        for speed, near_ends in zip(speeds, reversed(up_to[1:]), strict=True):
            open_ = near_ends & (found == 0.0)
            found[open_ & safe(~changing & open_[which], speed)] = speed
        return found

    def _safe(
        self, times: Float[np.ndarray, " n"], places: Points, velocities: Points, position_error: float
    ) -> Bool[np.ndarray, " n"]:
        if not len(places):
            return np.zeros(0, dtype=bool)
        scenario, states = self.scenario, states_at_times(self.scenario, times, places, velocities)
        asked = {"push": 0.0, "position_error": position_error, "enough": 0.0}
        return passive_safety(scenario, self.distance, states, scenario.inspect.passive_safety, **asked).safe


def drift_speed(
    scenario: Scenario,
    distance: Distance,
    course: Course,
    times: tuple[float, float],
    *,
    seconds: float,
    limit: float,
) -> tuple[float, float]:
    """Give the greatest speed up to which every drift from a course is safe, m/s, and the least that is tried.

    Safe is each speed tried up to that, all along the course: a law that slows down for a rule of speeds, or early
    before a place, flies at any of them.

    Args:
        scenario: as flown.
        distance: exact and unsigned, to the target's mesh, m.
        course: corners, m.
        times: at which it begins and ends, s.
        seconds: that a drift lasts.
        limit: the greatest speed tried, m/s; 0 is given where none is safe.

    """
    # The legs say when zones end, and need not agree with the limit.
    asked = {"inspect": {"passive_safety": seconds}, "chaser": {"speed_limit": limit}}
    parts = {name: getattr(scenario, name).model_copy(update=numbers) for name, numbers in asked.items()}
    drifting = Drifting(scenario.model_copy(update=parts), distance, changing=math.inf)
    return float(drifting.speeds([course], np.array([times]))[0]), drifting.slowest


def _along(course: Course, begin: float, end: float) -> tuple[np.ndarray, ...]:
    """Give states along a course, each place of a piece half of `_APART` or less from one of the piece.

    Returns:
        Places (n, 3) m, unit vectors (n, 3) along the course, 0 where it goes nowhere, times (n,) s, and what of the
        course is before and after each, (n,) m.

    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
    whole = float(along[-1])
    if whole == 0.0:
        return course[:1], np.zeros((1, 3)), np.array([begin]), np.zeros(1), np.zeros(1)
    places, ahead, done = [], [], []
    for (low, high), (a, b) in zip(pairwise(along.tolist()), pairwise(course), strict=True):
        if high > low:
            count = math.ceil((high - low) / _APART - 1e-9)
            share = (np.arange(count) + 0.5) / count
            places.append(a + share[:, None] * (b - a))
            ahead.append(np.tile((b - a) / (high - low), (count, 1)))
            done.append(low + share * (high - low))
    gone = np.concatenate(done)
    return np.concatenate(places), np.concatenate(ahead), begin + (end - begin) * gone / whole, gone, whole - gone

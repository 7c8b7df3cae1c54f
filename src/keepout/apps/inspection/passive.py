"""Passive safety: a chaser whose thrust stops now touches nothing for a stated time.

What is proved, for each state: the nominal drift (exact relative motion, no force) keeps clear of the mesh by more than
chaser radius and tube, the tube being how far errors of the state and a push that nobody commanded can lead away
(`spread`). Between the samples of the drift the audit's parabolas and their error hold (`audit/tube.py`); distance to
the mesh is 1-Lipschitz. Where a drift leaves the range in which gravity is bounded, nothing is proved.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.apps.inspection.spread import Spread
from keepout.core.audit.tube import Tube, lengths
from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.errors import InspectionError
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.relative import MotionState, RelativeMotion

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
_MOST_STEPS = 100_000


@dataclass(frozen=True, eq=False)
class PassiveSafety:
    """What is known of drifts, one entry a state.

    Attributes:
        clearance: a lower bound on the distance from the chaser's surface to the mesh over the whole drift, m, whatever
            the push within its bound; −inf where a drift may leave the range in which gravity is bounded.
        found: the least value found of what `clearance` bounds; at most a tolerance above it where steps are fine.
        time: of that, s after the thrust stops.
        spread: radius of the tube at the end, m.

    """

    clearance: Float[np.ndarray, " n"]
    found: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    spread: float

    @property
    def safe(self) -> Bool[np.ndarray, " n"]:
        """Whether each drift is proved to touch nothing."""
        return self.clearance > 0.0


def passive_safety(
    scenario: Scenario,
    distance: Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]],
    states: MotionState,
    seconds: float,
    *,
    push: float | None = None,
    position_error: float = 0.0,
    velocity_error: float = 0.0,
    enough: float = math.inf,
    too_little: float = 0.0,
    tolerance: float = 0.02,
) -> PassiveSafety:
    """Bound how near drifts from many states come to a mesh.

    Args:
        scenario: gives motion, chaser, and what bounds them.
        distance: exact and unsigned, to the target's mesh, m.
        states: with a leading axis; from `states_of_record` or `states_at_times`.
        seconds: for which each drifts.
        push: largest norm of a force that nobody commanded and that is not of the motion, N, for as long as the drift
            lasts; None: of the scenario's disturbance, whose swings then count as if they never turned round.
        position_error: of each state, m.
        velocity_error: of each state, m/s.
        enough: a clearance, m, above which nobody asks how large it is.
        too_little: a clearance, m, below which nobody asks how small it is: `clearance` is then a coarse bound.
        tolerance: to which the bound is driven otherwise, m.

    Raises:
        InspectionError: seconds that are not positive and finite, or more steps than can be flown.

    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise InspectionError(f"passive safety: {seconds} s; it must be positive and finite")
    # A drift may begin at the end of the mission, and goes on after it.
    lasting = scenario.model_copy(update={"duration": scenario.duration + seconds})
    motion, bounds, spread = (
        Surroundings(scenario).motion,
        Surroundings(lasting).flight_bounds,
        Spread.of(lasting, push),
    )
    step = min(_LONGEST_STEP, _TURN / max(bounds.angular_rate, 1e-12))
    count = math.ceil(seconds / step - 1e-9)
    if count > _MOST_STEPS:
        raise InspectionError(
            f"passive safety: {seconds:g} s at {step:.3g} s a step are {count} steps; at most {_MOST_STEPS}"
        )
    times = np.linspace(0.0, seconds, count + 1)
    radius = spread.radius(times, position_error=position_error, velocity_error=velocity_error)
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
        parts.append(_least(tube, radius, distance, within, (too_little + keep, enough + keep), tolerance))
    lower, upper, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    return PassiveSafety(lower - keep, upper - keep, at, float(radius[-1]))


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
    scenario: Scenario,
    times: Float[np.ndarray, " n"],
    position: Float[np.ndarray, "n 3"],
    velocity: Float[np.ndarray, "n 3"],
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

    def advance(at: MotionState, _: None) -> tuple[MotionState, MotionState]:
        after = motion.step(at, jnp.zeros(3), NoDisturbance(), period, 1.0)
        return eqx.tree_at(lambda s: (s.position, s.velocity), after, (at.position, at.velocity)), at

    return jax.lax.scan(advance, begin, length=_RUN)


def _least(
    tube: Tube,
    radius: Float[np.ndarray, " k"],
    distance: Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]],
    within: Bool[np.ndarray, " n"],
    limits: tuple[float, float],
    tolerance: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Bound the least of (distance − tube radius) over each drift, from below and above, and say when it is.

    Runs of steps are halved, then parts of a step, until the bound of a piece is above the tolerance below the least
    value found, or above the second of the limits, or a value below the first was found. Drifts that are not `within`
    the range of the bounds are not looked at: −inf.
    """
    drifts, samples = tube.position.shape[:2]
    travel = np.zeros((drifts, samples))
    np.cumsum(tube.speed * np.diff(tube.time), axis=1, out=travel[:, 1:])
    lower, upper, when = np.where(within, np.inf, -np.inf), np.full(drifts, np.inf), np.zeros(drifts)
    too_little, enough = limits

    def improve(which: np.ndarray, value: np.ndarray, time: np.ndarray) -> None:
        order = np.lexsort((value, which))
        index, best = np.unique(which[order], return_index=True)
        best = order[best]
        better = value[best] < upper[index]
        upper[index[better]], when[index[better]] = value[best][better], time[best][better]

    def open_still(which: np.ndarray, bound: np.ndarray, last: np.ndarray | bool = False) -> np.ndarray:
        settled = (bound >= np.minimum(upper[which] - tolerance, enough)) | (upper[which] < too_little) | last
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
        found = distance(tube.position[which, middle]) if which.size else np.empty(0)
        improve(which, found - radius[middle], tube.time[middle])
        at = travel[which, middle]
        reach = np.maximum(at - travel[which, first], travel[which, end] - at)
        kept = open_still(which, found - reach - radius[end])
        which = np.tile(which[kept], 2)
        first, end = (
            np.concatenate([first[kept], middle[kept]]),
            np.concatenate([middle[kept], end[kept]]),
        )
    which, first = (np.concatenate(part) for part in zip(*steps, strict=True))
    begin, until = np.zeros(which.size), np.ones(which.size)
    for halving in range(_HALVINGS + 1):
        if not which.size:
            break
        point, error, ball = tube.piece(which, first, begin, until)
        found = distance(point)
        lasts = np.diff(tube.time)[first]
        improve(which, found + error - radius[first + 1], tube.time[first] + 0.5 * (begin + until) * lasts)
        # What the parabolas leave open does not shrink with the piece.
        alone = (halving == _HALVINGS) | (ball - error <= 0.05 * error)
        kept = open_still(which, found - ball - radius[first + 1], alone)
        which, first = np.repeat(which[kept], 2), np.repeat(first[kept], 2)
        middle = 0.5 * (begin[kept] + until[kept])
        begin, until = (
            np.stack([begin[kept], middle], axis=-1).ravel(),
            np.stack([middle, until[kept]], axis=-1).ravel(),
        )
    return lower, upper, when

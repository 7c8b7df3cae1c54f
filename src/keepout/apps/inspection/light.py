"""Where a scenario's light comes from, in the body frame, and what it shows of a mesh: in a frame, at times, and ever.

The sun stands at infinity: its direction is one for the whole target. It counts as shining only while the Earth hides
none of its disc. The Earth is a ball of its equatorial radius, which hides more than the Earth does but for the air,
whose bending of the light is left out.

Between two times that follow each other a unit counts as lit if it is at both. The step is at most a hundred and
twentieth of the time looked at, and shorter where the sun turns fast: what is lit for less than that is not resolved.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8

from keepout.apps.inspection.seeing.patches import Marks, Units
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules, in_frame, lit_units
from keepout.core.errors import InspectionError
from keepout.core.geometry.distance import Point, Points
from keepout.core.mission.epoch import parse_instant
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import EARTH_EQUATORIAL_RADIUS, sun_direction
from keepout.core.motion.relative import MotionState, RelativeMotion
from keepout.core.motion.rotation import matrix, vvlh_axes

SUN_RADIUS = 0.00474
"""Half the angle across the sun's disc, rad: in January, when it is widest."""
_LONGEST = 1e7
"""Seconds beyond which nobody asks for the sun."""
_BLOCK = 1024
"""Control periods that are integrated together."""
_STEPS, _MOST_STEPS = 120, 1200
"""Of the time looked at: so many where the light turns slowly, and at most."""
_TURN = math.radians(1.25)
"""By which the sun turns in a step, rad, where `_MOST_STEPS` allow it."""
_ROOM = 4e8
"""Steps times units, at most, where these are more than `_STEPS`."""
_AT_ONCE = 1e-6
"""Seconds: nearer times are one."""
_SAME = 1e-9
"""Change of the sun's direction below which it counts as fixed."""
_COARSE_TURN = np.radians(2.0)
"""Angle that the sun may turn, in body axes, between two directions that are looked at, rad."""
_COARSE = 120.0
"""Seconds between the times at which the sun's turn is looked at."""
_MOST = 720
"""Directions that are looked at, at most."""


@dataclass(frozen=True, eq=False)
class Light:
    """The light that a scenario names."""

    scenario: Scenario

    @property
    def matters(self) -> bool:
        """Whether a patch must be lit to count as seen."""
        return self.scenario.light.kind != "none"

    def sun(self, time: float) -> Point | None:
        """Give the unit vector towards the light at a time (s), body frame.

        None where light does not matter, and while the Earth hides any of the sun.

        Raises:
            InspectionError: a time before the start, or none at all.

        """
        if not self.matters:
            return None
        direction = self.suns([time])[0]
        return None if np.isnan(direction[0]) else direction

    def suns(self, times: Sequence[float] | Float[np.ndarray, " n"]) -> Points:
        """Give the same for many times at once, (n, 3); rows of nan where `sun` gives None.

        Raises:
            InspectionError: a time before the start, or none at all.

        """
        times = np.asarray(times, dtype=np.float64).reshape(-1)
        if not np.all((times >= 0.0) & (times <= _LONGEST)):
            wrong = times[~((times >= 0.0) & (times <= _LONGEST))][0]
            raise InspectionError(f"time: {wrong:g} s; the light is known from 0 to {_LONGEST:g} s")
        entry = self.scenario.light
        if entry.kind == "none":
            return np.full((len(times), 3), np.nan)
        if entry.direction is not None and entry.kind == "fixed":
            return np.tile(_unit(entry.direction), (len(times), 1))
        if not len(times):
            return np.empty((0, 3))
        toward, position, body_from_inertial = self._inertial(times)
        found = np.einsum("nij,nj->ni", body_from_inertial, toward)
        found /= np.linalg.norm(found, axis=1, keepdims=True)
        found[~shines(position, toward)] = np.nan
        return found

    def _inertial(self, times: Float[np.ndarray, " n"]) -> tuple[Points, Points, Float[np.ndarray, "n 3 3"]]:
        """Give the sun's direction and the target's position (m), both ECI, and the rotation body ← ECI."""
        scenario, motion = self.scenario, self._motion
        if scenario.sun.direction is None:
            start = parse_instant(scenario.epoch)
            toward = np.array([sun_direction(start + round(time * 1e9)) for time in times]).reshape(-1, 3)
        else:
            toward = np.tile(_unit(scenario.sun.direction), (len(times), 1))
        # Filled up, so that few programs serve any number of times.
        padded = np.pad(times, (0, (1 << (len(times) - 1).bit_length()) - len(times)), mode="edge")
        if scenario.attitude.kind == "tumbling" or motion.perturbations:
            position, turn = self._integrated(padded)
        else:
            fixed = scenario.attitude.kind == "inertial"
            # A body that does not turn keeps the axes that it has at the start.
            position, turn = _on_ellipse(motion, jnp.asarray(padded), jnp.asarray(0.0 * padded if fixed else padded))
        return toward, np.asarray(position)[: len(times)], np.asarray(turn)[: len(times)]

    @functools.cached_property
    def _motion(self) -> RelativeMotion:
        return Surroundings(self.scenario).motion

    @functools.cached_property
    def _blocks(self) -> list[MotionState]:
        """States at whole control periods, `_BLOCK` rows each: as far as anybody has asked so far."""
        return []

    def _integrated(self, times: Float[np.ndarray, " n"]) -> tuple[Array, Array]:
        """Give positions and turns as the flight loop integrates them: by whole control periods, and then the rest.

        The chaser that is integrated along stands for none: neither orbit nor attitude depends on it.
        """
        motion, period, blocks = self._motion, self.scenario.control.period, self._blocks
        whole = np.floor(times / period + 1e-9).astype(int)
        while len(blocks) * _BLOCK <= int(whole.max(initial=0)):
            last = jax.tree.map(lambda leaf: leaf[-1], blocks[-1]) if blocks else None
            start = motion.initial_state(np.zeros(3), np.zeros(3)) if last is None else _stepped(motion, last, period)
            blocks.append(jax.tree.map(np.asarray, _rows(motion, start, period)))
        states = jax.tree.map(lambda *leaves: np.concatenate(leaves)[whole], *blocks)
        return _after(motion, states, jnp.asarray(np.maximum(times - whole * period, 0.0)))


def _unit(given: Sequence[float]) -> Point:
    """Give a vector the length 1, however long or short it is: squares of its numbers may over- or underflow."""
    vector = np.asarray(given, dtype=np.float64)
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)


def shines(position: Points, toward: Points) -> Bool[np.ndarray, " n"]:
    """Whether the Earth hides nothing of the sun's disc at ECI positions (m), for unit vectors towards the sun."""
    radius = np.linalg.norm(position, axis=1)
    nadir = -position / radius[:, None]
    apart = np.arctan2(np.linalg.norm(np.cross(nadir, toward), axis=1), np.einsum("ni,ni->n", nadir, toward))
    return apart >= np.arcsin(np.minimum(EARTH_EQUATORIAL_RADIUS / radius, 1.0)) + SUN_RADIUS


@eqx.filter_jit
def _on_ellipse(
    motion: RelativeMotion, times: Float[Array, " n"], axes_at: Float[Array, " n"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Give ECI positions (m) on the unperturbed orbit, and VVLH's axes at other times, as rotations VVLH ← ECI."""
    position, _ = jax.vmap(motion.orbit.inertial_state)(times)
    return position, jax.vmap(vvlh_axes)(*jax.vmap(motion.orbit.inertial_state)(axes_at))


@eqx.filter_jit
def _stepped(motion: RelativeMotion, state: MotionState, period: float | Float[Array, ""]) -> MotionState:
    return motion.step(state, jnp.zeros(3), NoDisturbance(), period, 1.0)


@eqx.filter_jit
def _rows(motion: RelativeMotion, start: MotionState, period: float) -> MotionState:
    """Give a state and those at the next control periods, `_BLOCK` in all."""
    return jax.lax.scan(lambda state, _: (_stepped(motion, state, period), state), start, length=_BLOCK)[1]


@eqx.filter_jit
def _after(
    motion: RelativeMotion, states: MotionState, durations: Float[Array, " n"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Give ECI positions (m) of the target and rotations body ← ECI, each so long (s) after its state."""

    def one(state: MotionState, duration: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        later = _stepped(motion, state, duration)
        orbit = later.target_orbit
        r, v = motion.orbit.inertial_state(later.time) if orbit is None else (orbit[:3], orbit[3:])
        return r, matrix(later.attitude) @ vvlh_axes(r, v)

    return jax.vmap(one)(states, durations)


@dataclass(eq=False)
class Camera:
    """What a camera sees of one mesh, frame by frame; what is lit is kept as long as the sun stays.

    Attributes:
        sight: lines of sight about it.
        rules: when a patch counts as seen.
        light: where the sun is.

    """

    sight: Sightlines
    rules: SeeingRules
    light: Light
    _sun: Point | None = None
    _lit: Int8[np.ndarray, " units"] = field(default_factory=lambda: np.zeros(0, np.int8))

    def units(self, time: float, place: Point, boresight: Point, among: Marks | None = None) -> Units:
        """Give the units wholly seen, by all the rules, in a frame.

        Args:
            time: of the frame, s.
            place: (3,) of the camera, m, body frame.
            boresight: (3,) unit vector.
            among: (2 n,) units that are asked for; by default all that are counted.

        """
        sun = self.light.sun(time)
        if self.light.matters and sun is None:
            return np.zeros(0, dtype=np.int64)
        units = in_frame(self.sight, self.rules, place, boresight, among=among)
        return units if sun is None else units[self.lit(sun, units)]

    def lit(self, sun: Point, units: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether units are wholly lit from a direction (unit vector), at a fit incidence."""
        if self._sun is None or not np.array_equal(self._sun, sun):
            self._sun, self._lit = sun, np.full(self.sight.patches.units, -1, dtype=np.int8)
        fresh = units[self._lit[units] < 0]
        if len(fresh):
            among = np.zeros(self.sight.patches.units, dtype=bool)
            among[fresh] = True
            self._lit[fresh] = lit_units(self.sight, self.rules, sun, among=among)[fresh]
        return self._lit[units] == 1


@dataclass(frozen=True, eq=False)
class LitTimes:
    """What is lit when.

    Attributes:
        times: (t,) s; one, with all that is ever lit, where the light does not change.
        lit: (t, units).
        changes: whether the light changes.

    """

    times: Float[np.ndarray, " t"]
    lit: Bool[np.ndarray, "t units"]
    changes: bool

    @classmethod
    def of(cls, camera: Camera, wanted: Marks, begin: float, end: float, shortest: float) -> "LitTimes":
        """Look at the light from `begin` to `end` (s), at steps of at least `shortest` (s).

        Args:
            camera: its light, lines of sight and rules.
            wanted: (units,) that are asked for.
            begin: s.
            end: s.
            shortest: s.

        """
        light, sight, rules = camera.light, camera.sight, camera.rules
        if not light.matters:
            return cls(np.array([begin]), wanted[None].copy(), False)
        most = math.floor((end - begin) / shortest) if end > begin else 0
        steps = max(_STEPS, _turns(light, begin, end, min(most, _MOST_STEPS)))
        steps = min(steps, most, max(_STEPS, int(_ROOM / len(wanted))))
        count = max(2, steps + 1) if end > begin else 1
        times = np.linspace(begin, max(end, begin), count)
        suns = light.suns(times)
        dark = np.isnan(suns[:, 0])
        if not dark.any() and np.ptp(suns, axis=0).max() < _SAME:
            return cls(times[:1], lit_units(sight, rules, suns[0], among=wanted)[None], False)
        nothing = np.zeros_like(wanted)
        lit = np.array([nothing if dark[n] else lit_units(sight, rules, suns[n], among=wanted) for n in range(count)])
        return cls(times, lit, True)

    def at(self, time: float) -> Marks:
        """Give what is lit at a time, s: at the looked-at times before and after it, or at that of them which it is."""
        if not self.changes:
            return self.lit[0]
        if not self.times[0] <= time <= self.times[-1]:
            return np.zeros(self.lit.shape[1], dtype=bool)
        after = int(np.searchsorted(self.times, time))
        if self.times[after] - time < _AT_ONCE:
            return self.lit[after]
        return self.lit[after] & self.lit[max(after - 1, 0)]

    def windows(self, units: Units) -> list[tuple[float, float]]:
        """Give the times, s, from and to, in which all of some units are lit."""
        if not self.changes:
            return [(-math.inf, math.inf)]
        together = np.concatenate([[False], self.lit[:, units].all(axis=1), [False]])
        edges = np.flatnonzero(together[1:] != together[:-1]).reshape(-1, 2)
        return [(float(self.times[first]), float(self.times[last - 1])) for first, last in edges]


def _turns(light: Light, begin: float, end: float, steps: int) -> int:
    """Give how many equal steps there would have to be for the sun to turn by `_TURN` in none; `steps` at most."""
    if steps < 1:
        return 0
    suns = light.suns(np.linspace(begin, end, steps + 1))
    across = np.linalg.norm(np.cross(suns[1:], suns[:-1]), axis=1)
    angles = np.arctan2(across, np.einsum("ni,ni->n", suns[1:], suns[:-1]))
    angles = angles[np.isfinite(angles)]
    return min(steps, math.ceil(steps * float(angles.max()) / _TURN)) if len(angles) else 0


def ever_lit(camera: Camera, units: Marks, duration: float, *, begin: float = 0.0) -> Marks:
    """Say which units are wholly lit at some time from `begin` to `duration` (s); all where light does not matter.

    The sun is looked at every few degrees of its way. What is lit only in between is left out: the answer is a lower
    bound.

    Args:
        camera: its light and lines of sight.
        units: (2 n,) that are asked for.
        duration: of the mission, s.
        begin: s.

    """
    if not camera.light.matters:
        return units.copy()
    lit, last, looked = np.zeros_like(units), None, 0
    for now in np.linspace(begin, duration, max(2, int(np.ceil((duration - begin) / _COARSE)) + 1)):
        sun = camera.light.sun(float(now))
        if sun is None or (last is not None and float(sun @ last) > np.cos(_COARSE_TURN)):
            continue
        left = np.flatnonzero(units & ~lit)
        if not len(left) or looked >= _MOST:
            break
        lit[left[camera.lit(sun, left)]] = True
        last, looked = sun, looked + 1
    return lit

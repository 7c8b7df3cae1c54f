"""Where a scenario's light comes from, in the target's body frame, and when the Earth hides it.

The sun stands at infinity: its direction is one for the whole target. It counts as shining only while the Earth hides
none of its disc. The Earth is a ball of its equatorial radius, which hides more than the Earth does but for the air,
whose bending of the light is left out.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.core.errors import InspectionError
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


@dataclass(frozen=True, eq=False)
class Light:
    """The light of a scenario; make one with `Light.of`."""

    scenario: Scenario

    @classmethod
    def of(cls, scenario: Scenario) -> "Light":
        """Give the light that a scenario names."""
        return cls(scenario)

    @property
    def matters(self) -> bool:
        """Whether a patch must be lit to count as seen."""
        return self.scenario.light.kind != "none"

    def sun(self, time: float) -> Float[np.ndarray, "3"] | None:
        """Give the unit vector towards the light at a time (s), body frame.

        None where light does not matter, and while the Earth hides any of the sun.

        Raises:
            InspectionError: a time before the start, or none at all.

        """
        if not self.matters:
            return None
        direction = self.suns([time])[0]
        return None if np.isnan(direction[0]) else direction

    def suns(self, times: Sequence[float] | Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
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

    def _inertial(
        self, times: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
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


def _unit(given: Sequence[float]) -> Float[np.ndarray, "3"]:
    """Give a vector the length 1, however long or short it is: squares of its numbers may over- or underflow."""
    vector = np.asarray(given, dtype=np.float64)
    vector = vector / np.abs(vector).max()
    return vector / np.linalg.norm(vector)


def shines(position: Float[np.ndarray, "n 3"], toward: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
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

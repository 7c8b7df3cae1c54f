"""`keepout/Approach-v0` for Gymnasium: one episode at a time, or a thousand on the batched step (docs/own-parts.md)."""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from keepout.apps.gym.episodes import Episode, Told, World, advancing, begin, free_share, starts_of
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.control.law import PolicyLaw
from keepout.core.cores import available_cores
from keepout.core.errors import KeepoutError, ScenarioError
from keepout.core.guard.field import guard_field
from keepout.core.guard.start import require_flyable
from keepout.core.mission.approach import require_one_leg
from keepout.core.mission.build import build_guard, require_navigation
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.mission.surroundings import Surroundings, broken_assumptions
from keepout.core.mission.target import load_target, require_apart
from keepout.core.motion.arrays import Vector
from keepout.core.plug_ins import load

MISSION: Mapping[str, Any] = {
    "name": "approach",
    "duration": 120.0,
    "target": {"source": "pocket"},
    "chaser": {"mass": 20.0, "radius": 0.5, "force_limit": 1.0, "speed_limit": 0.3},
    "safety": {"margin": 0.1},
    "start": {"position": [0.0, 8.0, 0.0]},
    "goal": {"position": [0.0, -4.0, 0.0], "tolerance": 0.5},
}
"""Flown where no mission is given: from anywhere around the pocket to behind its floor."""
PART = 512
"""Environments that one call of the compiled step flies on a CPU; each call has a thread of its own."""
Mission = ScenarioLike | None
Seeds = int | Sequence[int | None] | None


def approach_world(mission: Mission, guard: bool, starts: Any) -> World:
    """Build what episodes of a mission have in common, of what `ApproachEnv` takes.

    Raises:
        KeepoutError: it cannot be flown; the message names the entry.

    """
    keep_programs()
    if mission is None:
        mission, starts = MISSION, ("shell", 6.0, 9.0) if starts is None else starts
    scenario = Scenario.of(mission)
    require_one_leg(scenario, "an episode is led by its agent")
    target = load_target(scenario.target)
    require_apart(scenario, target)
    require_navigation(scenario)
    around, radius, place = Surroundings(scenario, target), scenario.chaser.radius, scenario.start.position
    grid = guard_field(target, radius)
    threshold = free = grid.certificate(radius).error_bound + radius
    shield = build_guard(around, grid=grid) if guard else None
    if shield is not None:
        # What `Guard.certified` asks of the field at rest.
        step = shield.assumptions.authority * scenario.control.period**2
        free = shield.least_value + shield.lipschitz * math.sqrt(3.0) / 8.0 * step + 1e-6
    chosen: dict[str, Any] = {"guard": shield}
    if scenario.navigation.suite != "none":
        chosen["navigation"] = load("navigation", "flown")(scenario, around.motion, around.guard_assumptions)
    world = World(
        setup=around.setup(PolicyLaw(scenario.goal.position, _no_force), **chosen),
        field=grid.field,
        threshold=threshold,
        free=free,
        margin=scenario.safety.margin,
        force_limit=scenario.chaser.force_limit,
        starts=starts_of(("box", place, place) if starts is None else starts),
        velocity=scenario.start.velocity,
        steps=scenario.steps,
        sound=not broken_assumptions(scenario, target),
    )
    share = float(free_share(world))
    if share < 0.05:
        said = f"starts: {100 * share:.3g} % of the places drawn are free (field above {free:.3f} m)"
        raise ScenarioError(f"{said}; at least 5 % must be: move them away from the target")
    if shield is not None:
        first = begin(world, *jnp.zeros((2, 1), jnp.int64))[0].flight.motion
        require_flyable(shield, jax.tree.map(lambda array: array[0], first), world.setup.goal)
    return world


def _no_force(away: Vector, velocity: Vector, time: Any) -> Vector:
    """Stand for the agent where none has acted yet."""
    return jnp.zeros(3)


class ApproachVectorEnv(VectorEnv):
    """Many `ApproachEnv` at once, on the batched step: the same episodes, spaces, rewards and infos.

    Environment i of seed s is an `ApproachEnv` of seed s + i. One that is over begins its next episode at the step
    after, whatever the action (`AutoresetMode.NEXT_STEP`); that step's reward is 0. The state stays in JAX's arrays.

    Args:
        num_envs: environments, at least 1.
        mission: as `ApproachEnv` takes it; and so are the next two.
        guard: whether the guard is a shield.
        starts: where episodes start.

    Raises:
        KeepoutError: the mission cannot be flown; the message names the entry.

    """

    def __init__(self, num_envs: int = 1, mission: Mission = None, guard: bool = True, starts: Any = None) -> None:
        if num_envs < 1:
            raise KeepoutError(f"num_envs: {num_envs}; it must be at least 1")
        self.num_envs, self.metadata = num_envs, {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._world = approach_world(mission, guard, starts)
        self._advance = advancing(self._world)
        # As many in each part, of which the last is filled up, so that only one size is compiled.
        parts = math.ceil(num_envs / PART) if jax.default_backend() == "cpu" else 1
        self._size = math.ceil(num_envs / parts)
        self._seeds = np.zeros(parts * self._size, np.int64)
        self._parts: list[Episode] = []
        self._pool = ThreadPoolExecutor(min(parts, available_cores()))

    def reset(self, *, seed: Seeds = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode in every environment: the first of a seed, or the next of the last one's."""
        numbers = np.zeros_like(self._seeds)
        if seed is None and self._parts:
            numbers = np.concatenate([np.asarray(part.number) for part in self._parts]) + 1
        else:
            self._seeds[: self.num_envs] = self._given(seed)
        told, info = self._done(lambda part: begin(self._world, *jnp.stack([self._seeds[part], numbers[part]])))
        return told.observation, info

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one control period of every environment; actions are (num_envs, 3) in [-1, 1]."""
        if not self._parts:
            raise gymnasium.error.ResetNeeded("no episode was begun: call reset first")
        given, shape = np.asarray(actions, np.float32), (self.num_envs, 3)
        if given.shape != shape or not np.isfinite(given).all():
            raise KeepoutError(f"action: shape {given.shape}; it must be finite numbers of shape {shape}")
        asked = np.resize(given, (len(self._seeds), 3))
        parts = self._parts
        told, info = self._done(lambda part: self._advance(parts[part.start // self._size], jnp.asarray(asked[part])))
        return told.observation, told.reward, told.terminated, told.truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _given(self, seed: Seeds) -> list[int]:
        if isinstance(seed, int | np.integer):
            return [int(seed) + place for place in range(self.num_envs)]
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise KeepoutError(f"seed: {len(seeds)} of them; {self.num_envs} environments need one each")
        return [int(self.np_random.integers(2**31)) if one is None else int(one) for one in seeds]

    def _done(self, work: Callable[[slice], tuple[Episode, Told]]) -> tuple[Any, dict[str, Any]]:
        """Do a part's work for all parts at once, and give what was told, in NumPy's arrays, and the infos."""
        places = [slice(first, first + self._size) for first in range(0, len(self._seeds), self._size)]

        def done(place: slice) -> tuple[Episode, Any]:
            episodes, told = work(place)
            return episodes, jax.tree.map(np.asarray, told)

        self._parts, answers = map(list, zip(*self._pool.map(done, places)))
        told = jax.tree.map(lambda *parts: np.concatenate(parts)[: self.num_envs], *answers)
        return told, told.info | {f"_{name}": np.ones(self.num_envs, bool) for name in told.info}


class ApproachEnv(gymnasium.Env):
    """Fly a chaser to a goal beside a target, a control period a step, with the guard as a shield.

    Everything is in the target's body frame and in SI units. The mission's law is not flown: the agent is the law.

    Action, (3,) float32 in [-1, 1]: the force of each body axis as a share of `chaser.force_limit`, held for a period.

    Observation, (7,) float32: the position less the goal (m), the velocity (m/s), and the clearance (m) there, of the
    estimate that a law would be told (the truth where the mission has neither sensors nor faults).

    Reward: how much nearer to the goal the step came (m), less 0.01 of the mean square of the force given as a share of
    its limit, and 10 on arrival.

    `info`, of the true state at the step's end: `clearance_m`, from the chaser to the target as the guard's field
    proves it; `contact`, where that is not above 0; `cost`, 0 at clearances from `safety.margin` on, 1 at contact,
    linear between; `arrived`; `certified`, whether the guard holds a free way to rest (false without a guard, and where
    the mission flies beyond what the guard assumes); `intervened`, whether the guard replaced this step's action;
    `interventions`, in how many steps of the episode it did.

    An episode is terminated on arrival (within `goal.tolerance`) and on contact, and truncated after `duration`.
    Contact is looked for at the ends of steps.

    Args:
        mission: a scenario's TOML file, its entries as a dict, or a `Scenario`; by default a built-in one.
        guard: whether the guard replaces actions that would leave no free way to rest.
        starts: where episodes start, at the mission's start velocity: ("shell", inner, outer), radii about the origin
            in m; ("box", lower, upper), corners in m; None: at the mission's start (of the built-in one: in a shell).

    Raises:
        KeepoutError: the mission cannot be flown; the message names the entry.

    """

    def __init__(self, mission: Mission = None, guard: bool = True, starts: Any = None) -> None:
        self._one = ApproachVectorEnv(1, mission, guard, starts)
        self.observation_space, self.action_space = self._one.single_observation_space, self._one.single_action_space
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode: the first of a seed, or the next of the last one's (of a random one, where none was)."""
        super().reset(seed=seed)
        self._over = False
        observation, info = self._one.reset(seed=seed)
        return observation[0], {name: info[name][0].item() for name in info if f"_{name}" in info}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Fly one control period under an action, (3,) in [-1, 1]."""
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or none was begun: call reset first")
        observation, *ends, info = self._one.step(np.asarray(action)[None])
        reward, terminated, truncated = (of[0].item() for of in ends)
        self._over = terminated or truncated
        told = {name: info[name][0].item() for name in info if f"_{name}" in info}
        return observation[0], reward, terminated, truncated, told

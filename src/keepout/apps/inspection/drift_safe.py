"""Legs that are flown no faster than lets a chaser without thrust drift past the target, wherever its thrust stops."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from keepout.apps.inspection.passive import drift_speed
from keepout.apps.inspection.seeing.patches import Point
from keepout.apps.inspection.ways import way_length
from keepout.core.control.controller import Controller
from keepout.core.control.guidance import Guidance
from keepout.core.control.legs import LegGuidance
from keepout.core.errors import ControlError, ScenarioError
from keepout.core.mission.approach import released
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.zones import named
from keepout.core.motion.arrays import Vector, norm
from keepout.core.progress import Progress, silent

_STEP = 0.1
"""Metres from one corner of a course to the next."""
_DETOUR = 4.0
"""A course is followed for so many times the straight way, and `_MORE` m."""
_MORE = 20.0


def drift_safe(around: Surroundings, law: Controller, progress: Progress = silent) -> Scenario:
    """Give a scenario whose legs that ask for it have the greatest safe speed among those tried as their limit.

    Safe is a speed up to which, at all speeds tried and from all along the leg's course, the drift without thrust or
    push is proved not to touch the mesh for `approach.abort_time`. The course is the one that the guidance leads along,
    and a target that moves is where it would be if the leg were flown at its limit. What is flown wanders from both,
    and is judged after the flight (`drifts` of its summary). Zones are not looked at. No leg asks for it any more.

    Args:
        around: the scenario's surroundings, with its target.
        law: of the scenario.
        progress: called leg by leg.

    Raises:
        ScenarioError: at none of the speeds tried is every drift from a leg safe.

    """
    scenario, guidance = around.scenario, law.velocity.guidance
    assert around.target is not None
    if not isinstance(guidance, LegGuidance):
        asking = [named("leg", leg, number) for number, leg in enumerate(scenario.leg) if leg.drift_safe]
        raise ScenarioError(f"{', '.join(asking)}: drift_safe, and the guidance given has no legs")
    place, time, legs = np.asarray(scenario.start.position, dtype=float), 0.0, []
    for number, (leg, release) in enumerate(zip(scenario.leg, released(scenario), strict=True)):
        progress(number / len(scenario.leg), named("leg", leg, number))
        limit, goal, told = leg.speed_limit or scenario.chaser.speed_limit, np.asarray(leg.position, dtype=float), {}
        if leg.drift_safe:
            way = dataclasses.replace(guidance, leg=jnp.asarray(number, guidance.leg.dtype)).way
            course = course_of(way, place, goal, named("leg", leg, number))
            times = time, time + way_length(course) / limit
            asked: dict[str, Any] = {"seconds": scenario.approach.abort_time, "limit": limit}
            speed, slowest = drift_speed(scenario, around.target.distance.distance, course, times, **asked)
            if not speed:
                raise ScenarioError(
                    f"{named('leg', leg, number)}: drift_safe, but at no speed down to {slowest:.3g} m/s every drift "
                    f"from it is proved clear for {scenario.approach.abort_time:g} s; make approach.abort_time "
                    "shorter, or leave the leg to the retreat"
                )
            limit, told = speed, {"speed_limit": speed, "drift_safe": False}
        time = max(time + float(np.linalg.norm(goal - place)) / limit + leg.dwell, release)
        legs.append(leg.model_dump() | told)
        place = goal
    return scenario.replace(leg=legs)


def course_of(way: Guidance, start: Point, goal: Point, name: str) -> Float[np.ndarray, "_ 3"]:
    """Follow a guidance from a place to its goal; the corners of its course, m. `name` is the leg's, in refusals.

    Raises:
        ControlError: it does not lead there.

    """
    steps = int(np.ceil((_DETOUR * float(np.linalg.norm(goal - start)) + _MORE) / _STEP))
    places, arrived = _followed(way, jnp.asarray(start), jnp.asarray(goal), steps)
    if not bool(arrived[-1]):
        raise ControlError(f"{name}: drift_safe, and no course leads from {start.tolist()} m to {goal.tolist()} m")
    return np.concatenate([start[None], np.asarray(places)[~np.asarray(arrived)], goal[None]])


@eqx.filter_jit
def _followed(
    way: Guidance, start: Vector, goal: Vector, steps: int
) -> tuple[Float[Array, "steps 3"], Bool[Array, "steps"]]:
    def step(place: Vector, _: None) -> tuple[Vector, tuple[Vector, Array]]:
        wanted = way.desired_velocity(place)
        after = place + _STEP * wanted / jnp.maximum(norm(wanted), 1e-12)
        there = norm(place - goal) <= 1.5 * _STEP
        after = jnp.where(there, place, after)
        return after, (after, norm(after - goal) <= 1.5 * _STEP)

    return jax.lax.scan(step, start, length=steps)[1]

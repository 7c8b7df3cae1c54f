"""Episodes of a mission that an agent steers: the flight loop's own step, a period at a time, many episodes at once.

What a flight is at a moment (`LoopState`) stays in JAX's arrays. An episode that is over begins anew in the step after,
from a key of its seed and its number: whichever episodes fly beside it, it is the same.
"""

import functools
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, PRNGKeyArray

from keepout.core.compiled.in_batches import where_needed
from keepout.core.compiled.kept_executables import kept_jit
from keepout.core.errors import ScenarioError
from keepout.core.fields.field import Field
from keepout.core.flight import loop
from keepout.core.flight.loop import LoopState
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.guard import GuardState
from keepout.core.guard.safety_layer import mode
from keepout.core.motion.arrays import Scalar, Vector, as_float64
from keepout.core.motion.relative import MotionState

EFFORT, ARRIVAL = 0.01, 10.0
"""Reward taken for a step at all thrusters' limits, and given for arriving."""


def starts_of(given: Any) -> Float[np.ndarray, "2 ..."]:
    """Read ("shell", inner, outer) or ("box", lower, upper): radii, or corners of three numbers, m.

    Raises:
        ScenarioError: it is neither, or its numbers are not finite or in the wrong order.

    """
    with suppress(TypeError, ValueError, KeyError):
        kind, *ends = given
        lower, upper = ends = np.asarray(ends, np.float64)
        ordered = np.isfinite(ends).all() and np.all(lower <= upper) and (kind == "box" or lower >= 0.0)
        if ordered and lower.shape == {"shell": (), "box": (3,)}[kind]:
            return ends
    raise ScenarioError(
        f'starts: {given!r}; it must be ("shell", inner, outer), radii in m with 0 <= inner <= outer, or '
        '("box", lower, upper), corners of three numbers in m with lower <= upper'
    )


class World(eqx.Module):
    """All that episodes have in common: the flight's setup, with a `PolicyLaw`, and what episodes are judged by.

    Clearance is told by `field`, the guard's own with or without a guard: above `threshold` (m) contact is excluded,
    above `free` an episode may start (and with a guard rest is certified there); below a clearance of `margin` (m) a
    step has a cost. `force_limit` is N per body axis. Starts, with `velocity` (m/s), are uniform in the box between the
    corners `starts` (m), or, where these are radii, in direction and radius. An episode is cut off after `steps`. A
    world is `sound` where nothing is flown beyond what the guard assumes.
    """

    setup: FlightSetup
    field: Field
    threshold: Scalar = eqx.field(converter=as_float64)
    free: Scalar = eqx.field(converter=as_float64)
    margin: Scalar = eqx.field(converter=as_float64)
    force_limit: Scalar = eqx.field(converter=as_float64)
    starts: Float[Array, "2 ..."] = eqx.field(converter=as_float64)
    velocity: Vector = eqx.field(converter=as_float64)
    steps: Int[Array, ""] = eqx.field(converter=loop.as_count)
    sound: bool = eqx.field(static=True)


class Episode(eqx.Module):
    """One episode at a moment (leading axes: many), the next but `number` of those of its environment's `seed`.

    `flown` counts steps, `interventions` those in which the guard replaced the command.
    """

    flight: LoopState
    seed: Int[Array, "*n"]
    number: Int[Array, "*n"]
    flown: Int[Array, "*n"]
    interventions: Int[Array, "*n"]
    over: Bool[Array, "*n"]


class Told(eqx.Module):
    """What an agent is told after a step (leading axes: of many), as `ApproachEnv` says."""

    observation: Float32[Array, "*n 7"]
    reward: Float[Array, "*n"]
    terminated: Bool[Array, "*n"]
    truncated: Bool[Array, "*n"]
    info: dict[str, Array]


@kept_jit
def begin(world: World, seeds: Int[Array, "n"], numbers: Int[Array, "n"]) -> tuple[Episode, Told]:
    """Begin episodes: each the one of this number of those of its seed."""
    return jax.vmap(lambda seed, number: _begun(world, seed, number))(seeds, numbers)


@kept_jit
def free_share(world: World) -> Scalar:
    """Give the share of places drawn at which an episode may start."""
    places = jax.vmap(lambda key: _drawn(world, key))(jax.random.split(jax.random.key(0), 4096))
    return jnp.mean(world.field.value(places) > world.free)


def advancing(world: World) -> Callable[[Episode, Float32[Array, "n 3"]], tuple[Episode, Told]]:
    """Give what flies one control period of each episode; one that is over begins anew instead, whatever its action.

    A world is taken apart here and not at every call, which costs as much as to fly.
    """
    arrays, still = eqx.partition(world, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    kind, frame = jax.tree.flatten(still)
    return functools.partial(_compiled(structure, frame, tuple(kind)), leaves)


@functools.lru_cache(8)
def _compiled(structure: Any, frame: Any, kind: tuple[Hashable, ...]) -> Callable:
    """Give the compiled step of all worlds of a kind: those that differ in their arrays' numbers only."""
    of_kind = jax.tree.unflatten(frame, kind)

    def world(leaves: list[Array]) -> World:
        return eqx.combine(jax.tree.unflatten(structure, leaves), of_kind)

    def anew(leaves: list[Array], seed: Int[Array, ""], number: Int[Array, ""]) -> tuple[Episode, Told]:
        return _begun(world(leaves), seed, number)

    @jax.jit
    def fly(leaves: list[Array], episodes: Episode, actions: Float32[Array, "n 3"]) -> tuple[Episode, Told]:
        def one(episode: Episode, action: Float32[Array, "3"]) -> tuple[Episode, Told]:
            flown = _flown(world(leaves), episode, action)
            return where_needed(anew, episode.over, flown, leaves, episode.seed, episode.number + 1)

        return jax.vmap(one)(episodes, actions)

    return fly


def _drawn(world: World, key: PRNGKeyArray) -> Vector:
    """Draw a place from a world's starts, m."""
    along, across = jax.random.split(key)
    lower, upper = world.starts
    drawn = lower + (upper - lower) * jax.random.uniform(along, lower.shape)
    direction = jax.random.normal(across, (3,))
    return drawn if lower.shape else drawn * direction / jnp.linalg.norm(direction)


def _begun(world: World, seed: Int[Array, ""], number: Int[Array, ""]) -> tuple[Episode, Told]:
    drawn, of_flight = jax.random.split(jax.random.fold_in(jax.random.key(seed), number))

    def further(tried: tuple[Int[Array, ""], Vector]) -> tuple[Int[Array, ""], Vector]:
        return tried[0] + 1, _drawn(world, jax.random.fold_in(drawn, tried[0]))

    # That this ends, `free_share` has said beforehand.
    none, no = jnp.zeros((), jnp.int32), jnp.asarray(False)
    place = jax.lax.while_loop(
        lambda tried: ~(world.field.value(tried[1]) > world.free), further, further((none, jnp.zeros(3)))
    )[1]
    initial = world.setup.motion.initial_state(place, world.velocity)
    begun = Episode(loop.start(world.setup, initial, of_flight), seed, number, none, none, no)
    return begun, _told(world, begun, jnp.zeros(()), no)


def _flown(world: World, episode: Episode, action: Float32[Array, "3"]) -> tuple[Episode, Told]:
    force = world.force_limit * jnp.clip(action.astype(jnp.float64), -1.0, 1.0)
    setup = eqx.tree_at(lambda setup: setup.controller.policy, world.setup, lambda *_: force)
    flight, row = loop.step(setup, episode.flight)
    replaced = mode(row.guard_status) != 0
    interventions = episode.interventions + replaced.astype(jnp.int32)
    flown = Episode(flight, episode.seed, episode.number, episode.flown + 1, interventions, episode.over)
    effort = jnp.mean((row.force / world.force_limit) ** 2)
    told = _told(world, flown, _away(setup, episode.flight) - _away(setup, flight) - EFFORT * effort, replaced)
    return eqx.tree_at(lambda episode: episode.over, flown, told.terminated | told.truncated), told


def _told(world: World, episode: Episode, reward: Scalar, intervened: Bool[Array, ""]) -> Told:
    setup, flight, begun = world.setup, episode.flight, episode.flown > 0
    estimate = _estimate(setup, flight)
    clearance = world.field.value(flight.motion.position) - world.threshold
    contact = ~(clearance > 0.0)
    arrived = (_away(setup, flight) < setup.tolerance) & ~contact & begun
    certified = flight.guard.certified if world.sound and isinstance(flight.guard, GuardState) else jnp.asarray(False)
    seen = world.field.value(estimate.position) - world.threshold
    told = jnp.concatenate([estimate.position - setup.goal, estimate.velocity, seen[None]])
    ended = (arrived | contact) & begun
    return Told(
        observation=told.astype(jnp.float32),
        reward=reward + jnp.where(arrived, ARRIVAL, 0.0),
        terminated=ended,
        truncated=(episode.flown >= world.steps) & ~ended,
        info={
            "cost": jnp.clip(1.0 - jnp.maximum(clearance, 0.0) / jnp.maximum(world.margin, 1e-9), 0.0, 1.0),
            "contact": contact,
            "arrived": arrived,
            "clearance_m": clearance,
            "certified": certified,
            "intervened": intervened,
            "interventions": episode.interventions,
        },
    )


def _estimate(setup: FlightSetup, flight: LoopState) -> MotionState:
    """Give what a law is told at the next step: the same draw of every sensor and fault."""
    if setup.navigation is None:
        return setup.faults.estimate(flight.faults, flight.motion)[1]
    samples = setup.navigation.suite.sample(flight.sensors, flight.motion)[1]
    return setup.navigation.know(flight.navigation, samples)[1].estimate


def _away(setup: FlightSetup, flight: LoopState) -> Scalar:
    return jnp.linalg.norm(flight.motion.position - setup.goal)

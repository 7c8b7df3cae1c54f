"""A base for rival laws: an acceleration in, a force out, with Keepout's disturbance observer for every rival alike."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from keepout.core.control.law import Command, Law
from keepout.core.control.observer import Observer
from keepout.core.motion.relative import MotionState, RelativeMotion
from rivals_laws.rival_case import RivalCase

Vector = Float[Array, "3"]


class Plant(eqx.Module):
    """What a rival knows of chaser and motion: the same for all laws of a case."""

    motion: RelativeMotion
    observer: Observer
    mass: Float[Array, ""]
    force_limit: Float[Array, "3"]
    speed_limit: Float[Array, ""]
    authority: Float[Array, ""]
    """Acceleration in any direction that disturbance and drift leave, m/s²."""

    @classmethod
    def of(cls, case: RivalCase) -> "Plant":
        """Gather it from the case's default law, once a case."""
        law = case.default_law
        speed = law.velocity.speed
        numbers = (law.motion, law.observer, law.mass, law.force_limit, speed.limit, speed.authority)
        return case.once("plant", lambda: cls(*numbers))


class ObservedState(eqx.Module):
    """What an `ObservedLaw` remembers: the last sample, the force held since, the observer's and its own memory."""

    velocity: Vector
    drift: Vector
    force: Vector
    observer: Float[Array, " q"]
    started: Bool[Array, ""]
    own: PyTree


class ObservedLaw(Law):
    """A law that asks for an acceleration; drift and disturbance are compensated as the default law does."""

    plant: eqx.AbstractVar[Plant]

    @abc.abstractmethod
    def acceleration(self, own: PyTree, estimate: MotionState) -> tuple[PyTree, Vector]:
        """Give the own memory for the next step, and the acceleration wanted beside drift and disturbance, m/s²."""

    def initial_memory(self, state: MotionState) -> PyTree:
        """Give the law's own memory before its first step."""
        return ()

    def initial_state(self, state: MotionState) -> ObservedState:
        """Return the memory before the first step."""
        plant = self.plant
        drift = plant.motion.drift_acceleration(state)
        observer = plant.observer.initial_state(state.velocity)
        own = self.initial_memory(state)
        return ObservedState(state.velocity, drift, jnp.zeros(3), observer, jnp.asarray(False), own)

    def with_applied_force(self, state: ObservedState, force: Vector) -> ObservedState:
        """Return the memory told that `force` (N) is held instead."""
        return eqx.tree_at(lambda s: s.force, state, force)

    def step(self, state: ObservedState, estimate: MotionState) -> tuple[ObservedState, Command]:
        """Observe, ask for the acceleration, compensate, and cut off at the thrusters' limits."""
        plant, velocity = self.plant, estimate.velocity
        drift = plant.motion.drift_acceleration(estimate)
        mean = 0.5 * (state.drift + drift)
        updated = plant.observer.update(state.observer, state.velocity, velocity, mean, state.force)
        memory = jnp.where(state.started, updated, state.observer)
        own, acceleration = self.acceleration(state.own, estimate)
        wanted = plant.mass * (acceleration - drift) - plant.observer.mean_ahead(memory, velocity)
        force = jnp.clip(jnp.nan_to_num(wanted), -plant.force_limit, plant.force_limit)
        command = Command.of_force(force)
        command = eqx.tree_at(lambda c: c.disturbance_estimate, command, plant.observer.estimate(memory, velocity))
        return ObservedState(velocity, drift, force, memory, jnp.asarray(True), own), command


def tracking(plant: Plant, wanted: Vector, velocity: Vector) -> Vector:
    """Give the acceleration (m/s²) towards a wanted velocity (m/s): gain 0.5/s, limited to the authority."""
    pull = 0.5 * (wanted - velocity)
    return pull * jnp.minimum(1.0, plant.authority / jnp.sqrt(jnp.sum(pull * pull) + 1e-300))


def linearised(motion: RelativeMotion) -> tuple[np.ndarray, np.ndarray]:
    """Give the derivatives of the drift by position (1/s²) and velocity (1/s) at the target and the orbit's epoch."""
    rest = motion.initial_state(np.zeros(3), np.zeros(3))

    def drift(position, velocity):
        moved = eqx.tree_at(lambda s: (s.position, s.velocity), rest, (position, velocity))
        return motion.drift_acceleration(moved)

    by_position, by_velocity = jax.jacfwd(drift, argnums=(0, 1))(rest.position, rest.velocity)
    return np.asarray(by_position), np.asarray(by_velocity)

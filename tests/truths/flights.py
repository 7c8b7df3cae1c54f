"""A flight of toy layers whose every step is known in closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp

from keepout.core.control.law import Command, Law
from keepout.core.flight.setup import Faults, FlightSetup
from keepout.core.guard.safety_layer import SafetyLayer
from keepout.core.motion.chaser import Thrusters
from keepout.core.motion.disturbance import paper_disturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion

KEY = jax.random.key(0)
STEPS = 30
"""Of flights that may be of any length: those of the same layers then share a program."""
GOAL = jnp.array([0.0, -10.0, -4.0])


class Spring(Law):
    """A damped spring to the goal that knows the orbital drift; its state counts its steps."""

    motion: RelativeMotion
    target: jax.Array
    stiffness: float = 0.02
    damping: float = 0.6

    @property
    def goal(self):
        return self.target

    def initial_state(self, state):
        return jnp.zeros((), jnp.int32)

    def step(self, count, estimate):
        error = estimate.position - self.target
        acceleration = -self.stiffness * error - self.damping * estimate.velocity
        force = 20.0 * (acceleration - self.motion.drift_acceleration(estimate))
        order = Command(
            force=force,
            desired_velocity=-error,
            safe_velocity=-0.5 * error,
            disturbance_estimate=jnp.full(3, 0.25),
            barrier=jnp.linalg.norm(estimate.position) - 2.0,
            backstepping_barrier=jnp.linalg.norm(error),
            lyapunov=error @ error,
            status=count % 3,
        )
        return count + 1, order


class Halving(SafetyLayer):
    """A guard that halves every command and says so with the status of the sign of its estimate."""

    def initial_state(self, estimate):
        return jnp.zeros((), jnp.int32)

    def filter(self, guard_state, estimate, force, disturbance_estimate, errors=None, contradicted=None):
        return guard_state + 1, force / 2, jnp.where(disturbance_estimate[0] > 0, 2, 0) + 8 * (guard_state == 5)


class Delayed(Faults):
    """The estimate is shifted, the command arrives a step late, and the x thruster gives nothing."""

    def initial_state(self, key):
        return jnp.zeros(3)

    def estimate(self, fault_state, true_state):
        return fault_state, eqx.tree_at(lambda s: s.position, true_state, true_state.position + 1.0)

    def command(self, fault_state, force, time):
        return force, fault_state

    def actuate(self, fault_state, force, time):
        return fault_state, force * jnp.array([0.0, 1.0, 1.0])


def make_setup(**changes):
    motion = RelativeMotion(Orbit(7e6))
    arguments = {
        "motion": motion,
        "disturbance": paper_disturbance(),
        "thrusters": Thrusters(0.1),
        "controller": Spring(motion, GOAL),
        "goal": GOAL,
        "mass": 20.0,
    }
    return FlightSetup(**(arguments | changes))


def start_state(setup, position=(0.0, 10.0, 6.0)):
    return setup.motion.initial_state(jnp.asarray(position), jnp.zeros(3))

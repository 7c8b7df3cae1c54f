"""The chaser: its body as one value, and its thrusters, from the commanded force to the one that is given.

Thrusters may be on or off within a control period: then the motion leaves that under their mean force, and comes back.
"""

import abc
import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from keepout.core.errors import ScenarioError, require_finite
from keepout.core.motion.arrays import Flag, NumbersLike, Scalar, Vector, as_float64


class Pulses(eqx.Module):
    """Constant forces, each on between two moments of one control period.

    With F(t) their sum and F̄ its mean, the chaser's path is x = y + δ: y under F̄, and δ̈ = (F(t) − F̄)/m with δ and δ̇
    zero at the period's start. δ̇ is zero at its end too, and so is δ where every pulse is centred in the period.

    Attributes:
        begin: when each is switched on, s since the period's start.
        end: when it is switched off, not before `begin`.
        force: of each while it is on, N, body axes.
        period: s.

    """

    begin: Float[Array, " pulses"]
    end: Float[Array, " pulses"]
    force: Float[Array, "pulses 3"]
    period: Scalar

    @property
    def mean(self) -> Vector:
        """F̄, N."""
        return (self.end - self.begin) @ self.force / self.period

    def moment(self, order: int, time: float | Scalar) -> Vector:
        """Give F(t) − F̄ integrated `order` times from the period's start to `time` (s): 1 is m δ̇, 2 is m δ."""
        since, until = jnp.maximum(time - self.begin, 0.0), jnp.maximum(time - self.end, 0.0)
        return ((since**order - until**order) @ self.force - self.mean * time**order) / math.factorial(order)


class Departure(eqx.Module):
    """What pulses add to the motion under their mean force, in a turning frame.

    The frame turns δ aside: x = y + δ + η with η̈ = −2 (ω + ω̇ t)×δ̇ + 3 ω×(ω×δ) − ω̇×δ, in which Coriolis force of η̇ is
    counted to first order, and what is left is of third order in ω. Both are integrals of δ in closed form, so that y
    is smooth enough for one Runge–Kutta step.

    Attributes:
        pulses: over the period.
        mass: kg.
        angular_velocity: ω of the frame at the period's start, rad/s.
        angular_acceleration: ω̇, rad/s².

    """

    pulses: Pulses
    mass: Scalar
    angular_velocity: Vector
    angular_acceleration: Vector

    def at(self, time: Scalar) -> tuple[Vector, Vector, Vector]:
        """Give δ + η (m), δ̇ + η̇ (m/s) and η̈ (m/s²), `time` s after the period's start."""
        speed, moved, summed, twice = (self.pulses.moment(order, time) / self.mass for order in (1, 2, 3, 4))
        turn, change = self.angular_velocity, self.angular_acceleration

        def aside(vector: Vector) -> Vector:
            return 3.0 * jnp.cross(turn, jnp.cross(turn, vector)) - jnp.cross(change, vector)

        def coriolis(still: Vector, growing: Vector) -> Vector:
            return -2.0 * (jnp.cross(turn, still) + jnp.cross(change, growing))

        position = moved + coriolis(summed, time * summed - 2.0 * twice) + aside(twice)
        velocity = speed + coriolis(moved, time * moved - summed) + aside(summed)
        return position, velocity, coriolis(speed, time * speed) + aside(moved)


class Firing(eqx.Module):
    """What thrusters do over one control period.

    Attributes:
        force: their mean force, N, body axes.
        pulses: when which force is on, where it is not held all along.
        on_time: of each thruster, s, where there are thrusters to tell apart.
        propellant: burnt, kg, where that is known.

    """

    force: Vector
    pulses: Pulses | None = None
    on_time: Float[Array, " thrusters"] | None = None
    propellant: Scalar | None = None


class ThrusterModel(eqx.Module):
    """What becomes of a commanded force; `Thrusters` hold it, and `thrusters.on_off.OnOffThrusters` give pulses."""

    @abc.abstractmethod
    def apply(self, command: Vector) -> Vector:
        """Give the force (N, body axes) that is held over the period for a commanded one.

        Args:
            command: (3,) N, body axes.

        """

    @abc.abstractmethod
    def saturated(self, command: Vector) -> Flag:
        """Whether a command (N) is more than can be given.

        Args:
            command: (3,) N, body axes.

        """

    def initial_state(self, key: PRNGKeyArray) -> PyTree:
        """Make the memory that a flight starts with; what differs from flight to flight is drawn from the key.

        Args:
            key: of the flight.

        """
        return ()

    def fire(self, state: PyTree, command: Vector) -> tuple[PyTree, Firing]:
        """Say what is done over the coming period for a commanded force (N, body axes): by default `apply`, held.

        Args:
            state: the memory.
            command: (3,) N, body axes.

        Returns:
            The memory, and what is fired.

        """
        return state, Firing(self.apply(command))


def _per_axis(value: NumbersLike) -> Array:
    if isinstance(value, jax.Array):
        return jnp.broadcast_to(as_float64(value), (3,))
    return as_float64(np.broadcast_to(np.asarray(value), (3,)))


class Thrusters(ThrusterModel):
    """Thrusters along the body axes, each limited on its own (paper, section VI: 0.1 N per axis).

    force_limit: N, one number or one per axis.

    Raises:
        ScenarioError: a limit that is not positive.

    """

    force_limit: Vector = eqx.field(converter=_per_axis)

    def __check_init__(self):
        if isinstance(self.force_limit, Tracer):
            return  # values are not known yet inside a transformation
        if not np.all(np.asarray(self.force_limit) > 0):
            raise ScenarioError(f"force_limit: {self.force_limit.tolist()} N; every axis must be positive")

    def apply(self, command: Vector) -> Vector:
        """Cut the command off at the limit in each axis, N. A command that is not a number stays one."""
        return jnp.clip(command, -self.force_limit, self.force_limit)

    def saturated(self, command: Vector) -> Flag:
        """Whether the command reaches the limit in any axis."""
        return jnp.any(jnp.abs(command) >= self.force_limit * (1 - 1e-9))


@dataclass(frozen=True)
class Chaser:
    """A ball with one thruster pair an axis.

    Attributes:
        mass: kg.
        radius: of the ball that holds the chaser, m.
        force_limit: of the thrusters, per body axis, N.
        speed_limit: m/s, that a law must keep.

    Raises:
        ScenarioError: a number that is not finite, or not positive (a radius may be 0).

    """

    mass: float
    radius: float
    force_limit: float
    speed_limit: float

    def __post_init__(self) -> None:
        """Check each number against its range."""
        for name, unit in (("mass", "kg"), ("force_limit", "N"), ("speed_limit", "m/s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ScenarioError(f"chaser: {name}: {value} {unit}; it must be positive and finite")
        require_finite(self.radius, f"chaser: radius: {self.radius} m", ScenarioError)

    @property
    def authority(self) -> float:
        """Acceleration that the thrusters give along every axis, m/s²."""
        return self.force_limit / self.mass

    @property
    def thrusters(self) -> Thrusters:
        """The thrusters, each axis limited on its own."""
        return Thrusters(self.force_limit)

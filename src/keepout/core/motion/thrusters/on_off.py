"""Thrusters that are on or off: a commanded force becomes pulses, one a thruster and control period."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.chaser import Firing, Pulses, ThrusterModel
from keepout.core.motion.rotation import Vector
from keepout.core.motion.thrusters.allocation import Allocation
from keepout.core.motion.thrusters.capability import Stuck
from keepout.core.motion.thrusters.layout import STANDARD_GRAVITY, Layout

Scalar = Float[Array, ""]


class Failure(eqx.Module):
    """A thruster that sticks in flight, and when that becomes known.

    Attributes:
        thruster: its number.
        on: 1 if it is stuck on, 0 if stuck off.
        begins: control period from which on it is stuck.
        known: control period from which on the others are fired in the knowledge of it.
        push: what it then gives, as the others are told, N.
        others: which thrusters fire for a force that the stuck one leaves to them.

    """

    thruster: Int[Array, ""]
    on: Scalar
    begins: Int[Array, ""]
    known: Int[Array, ""]
    push: Vector
    others: Allocation


class ThrusterMemory(eqx.Module):
    """What thrusters carry from period to period.

    Attributes:
        periods: flown so far.
        push: of each thruster while it is on, as it truly is, N.
        owed: on-time that was asked for and not given, s (0 with pulse-width modulation).
        tail: for which a thruster is still on in the coming period because it closes late, s.

    """

    periods: Int[Array, ""]
    push: Float[Array, "thrusters 3"]
    owed: Float[Array, " thrusters"]
    tail: Float[Array, " thrusters"]


class OnOffThrusters(ThrusterModel):
    """Thrusters of a layout, each fired once a control period, in its middle; build with `OnOffThrusters.of`.

    Attributes:
        push: of each thruster while it is on, as it should be, N.
        allocation: which fire for a force.
        force_limit: per body axis, at which commands are cut off, N.
        period: s.
        least_on_time: s. A shorter pulse is given as one of this length, or not at all if less than half of it.
        rise_delay: by which a pulse is late, s.
        flow: propellant burnt for each newton and second, kg.
        misalignment: largest angle of a thruster's force to its direction, drawn once a flight, rad.
        scale_error: largest relative error of its size, likewise.
        failure: of one thruster, or None.
        delta_sigma: whether what a pulse gives too much or too little is made up for later.

    """

    push: Float[Array, "thrusters 3"]
    allocation: Allocation
    force_limit: Float[Array, "3"]
    period: Scalar = eqx.field(converter=as_float64)
    least_on_time: Scalar = eqx.field(converter=as_float64)
    rise_delay: Scalar = eqx.field(converter=as_float64)
    flow: Scalar = eqx.field(converter=as_float64)
    misalignment: Scalar = eqx.field(converter=as_float64)
    scale_error: Scalar = eqx.field(converter=as_float64)
    failure: Failure | None = None
    delta_sigma: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls,
        layout: Layout,
        *,
        force_limit: float,
        period: float,
        delta_sigma: bool = False,
        stuck: tuple[int, Stuck] | None = None,
        stuck_from: float = 0.0,
        detection_time: float = math.inf,
    ) -> "OnOffThrusters":
        """Build the thrusters of a layout.

        Args:
            layout: the thrusters.
            force_limit: per body axis, at which commands are cut off, N.
            period: between control steps, s.
            delta_sigma: whether what a pulse gives too much or too little is made up for later.
            stuck: number of a thruster, and how it sticks; None for none.
            stuck_from: when it sticks, s after the start: from the first control step then or later.
            detection_time: after which it is known, s: from the first control step then or later.

        Raises:
            ScenarioError: a least on-time or rise delay that does not fit into a period, or no such thruster.

        """
        require_periods(layout, period)
        return cls(
            push=as_float64(layout.pushes()),
            allocation=Allocation.of(layout),
            force_limit=as_float64(np.full(3, force_limit)),
            period=period,
            least_on_time=layout.least_on_time,
            rise_delay=layout.rise_delay,
            flow=1.0 / (layout.specific_impulse * STANDARD_GRAVITY),
            misalignment=layout.misalignment,
            scale_error=layout.scale_error,
            failure=None if stuck is None else _failure(layout, stuck, stuck_from, detection_time, period),
            delta_sigma=delta_sigma,
        )

    def apply(self, command: Vector) -> Vector:
        """Cut the command off at the limit in each axis, N: what pulses aim at."""
        return jnp.clip(command, -self.force_limit, self.force_limit)

    def saturated(self, command: Vector) -> Bool[Array, ""]:
        """Whether the command reaches the limit in any axis."""
        return jnp.any(jnp.abs(command) >= self.force_limit * (1 - 1e-9))

    def initial_state(self, key: PRNGKeyArray) -> ThrusterMemory:
        """Draw each thruster's force and direction within their bounds."""
        size, tilt, turn = (jax.random.fold_in(key, number) for number in (11, 12, 13))
        count = self.push.shape[0]
        scale = 1.0 + self.scale_error * jax.random.uniform(size, (count, 1), minval=-1.0, maxval=1.0)
        across = jnp.cross(self.push, jax.random.normal(turn, (count, 3)))
        across = across / jnp.maximum(jnp.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        angle = self.misalignment * jax.random.uniform(tilt, (count, 1))
        length = jnp.linalg.norm(self.push, axis=1, keepdims=True)
        push = scale * (jnp.cos(angle) * self.push + jnp.sin(angle) * length * across)
        return ThrusterMemory(jnp.zeros((), jnp.int32), push, jnp.zeros(count), jnp.zeros(count))

    def fire(self, state: ThrusterMemory, command: Vector) -> tuple[ThrusterMemory, Firing]:
        """Give the pulses of the coming period for a commanded force (N, body axes), and their mean force."""
        wanted = self.period * self._shares(state.periods, self.apply(command)) + state.owed
        half = 0.5 * self.least_on_time
        given = jnp.where(wanted <= half, 0.0, jnp.clip(wanted, self.least_on_time, self.period))
        owed = wanted - given if self.delta_sigma else state.owed
        begin, tail = 0.5 * (self.period - given) + self.rise_delay, state.tail
        if self.failure is not None:
            works = 1.0 - self._is_stuck(state.periods)
            given = works * given + (1.0 - works) * self.failure.on * self.period
            begin, tail = works * begin, works * tail
        end = begin + given
        late = jnp.maximum(end - self.period, 0.0)
        still = jnp.zeros_like(begin)
        pulses = Pulses(
            begin=jnp.concatenate([still, jnp.minimum(begin, self.period)]),
            end=jnp.concatenate([tail, jnp.minimum(end, self.period)]),
            force=jnp.concatenate([state.push, state.push]),
            period=self.period,
        )
        on_time = tail + jnp.minimum(end, self.period) - jnp.minimum(begin, self.period)
        propellant = self.flow * on_time @ jnp.linalg.norm(state.push, axis=1)
        memory = ThrusterMemory(state.periods + 1, state.push, owed, late)
        return memory, Firing(pulses.mean, pulses, on_time, propellant)

    def _shares(self, periods: Int[Array, ""], force: Vector) -> Float[Array, " thrusters"]:
        shares = self.allocation.shares(force)
        if self.failure is None:
            return shares
        known = periods >= self.failure.known
        return jnp.where(known, self.failure.others.shares(force - self.failure.push), shares)

    def _is_stuck(self, periods: Int[Array, ""]) -> Float[Array, " thrusters"]:
        assert self.failure is not None
        mine = jnp.arange(self.push.shape[0]) == self.failure.thruster
        return (mine & (periods >= self.failure.begins)).astype(jnp.float64)


def require_periods(layout: Layout, period: float) -> None:
    """Refuse a least on-time longer than a control period, and a rise delay longer than half of one.

    Raises:
        ScenarioError: it is.

    """
    if layout.least_on_time > period:
        raise ScenarioError(
            f"thrusters.least_on_time: {layout.least_on_time:g} s is longer than the control period, {period:g} s; "
            "no pulse fits in"
        )
    if layout.rise_delay > 0.5 * period:
        raise ScenarioError(
            f"thrusters.rise_delay: {layout.rise_delay:g} s is more than half of the control period, {period:g} s"
        )


def _failure(
    layout: Layout, stuck: tuple[int, Stuck], stuck_from: float, detection_time: float, period: float
) -> Failure:
    thruster, how = stuck
    others = layout.without(thruster)
    begins = math.ceil(stuck_from / period - 1e-9)
    known = min(begins + math.ceil(detection_time / period - 1e-9), 2**31 - 1) if detection_time < 1e9 else 2**31 - 1
    return Failure(
        thruster=jnp.asarray(thruster),
        on=as_float64(float(how == "on")),
        begins=jnp.asarray(begins, jnp.int32),
        known=jnp.asarray(known, jnp.int32),
        push=as_float64(layout.pushes()[thruster] * (how == "on")),
        others=Allocation.of(others),
    )

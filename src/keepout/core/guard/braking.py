"""The guard's braking law, designed from its assumptions: authority, gains, and the radius of the tube it stays in.

Everything is derived, nothing tuned: docs/guard.md states and proves the theorem, with these names. In short, the error
e between the chaser and a nominal braking motion obeys, at the control instants and in every axis alike,

    e⁺ = (Φ + Γ K) e + w + Γ K (errors of the estimate),   Φ = [[1, T], [0, 1]],  Γ = [T²/2, T],  K = −[k_p, k_d],

so the largest error that any admissible disturbance can build up is the sum of the absolute impulse response. Where the
estimate has errors the guard smooths it by an observer of its own; `responses` sums over both.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from keepout.core.errors import ControlError, require_finite
from keepout.core.guard import responses
from keepout.core.guard.responses import Task, least_room, stop_length
from keepout.core.motion.arrays import Flag, Vector, norm

Number = float | Float[Array, "*flights"]
"""Python's number; in a compiled program that takes the guard's numbers as arguments an array."""

_AT_REST = 4.0
"""Weight of ρ against the stop length when gains are chosen for an estimate without errors."""
_ESCAPE_SPEED = 0.02
"""Of the way out of the margin, m/s."""
_LONGEST_FAULT = 100
"""Most steps of a fault."""
_POWERS = 32
"""Powers of a matrix taken between two looks at their size."""


_POSITIVE = {"mass": "kg", "force_limit": "N", "period": "s", "range_limit": "m", "speed_limit": "m/s"}
_NOT_NEGATIVE = dict.fromkeys(("disturbance_force", "force_error", "fault_force"), "N")
_NOT_NEGATIVE |= {"angular_rate": "rad/s", "angular_acceleration": "rad/s2", "gravity_gradient": "1/s2"}
_NOT_NEGATIVE |= dict.fromkeys(("position_error", "origin_offset", "excursion"), "m")
_NOT_NEGATIVE |= dict.fromkeys(("velocity_error", "velocity_excursion"), "m/s")
_NOT_NEGATIVE |= dict.fromkeys(("gain_error", "turning_error"), "")
"""Units of the numbers that must be above 0, and of those that must not be below it."""


class GuardAssumptions(eqx.Module):
    """What the guard's theorem assumes of the flight; each number is checked here and watched in flight.

    The numbers are Python's; in a flight's setup they are arrays, and in a campaign that varies them those have one
    entry a flight.

    Attributes:
        mass: the guard's value, kg.
        force_limit: per body axis, N.
        period: between control steps, s.
        disturbance_force: largest norm of the force that nobody commanded, N.
        angular_rate: bound on the body frame's inertial rate, rad/s.
        angular_acceleration: bound on its derivative, rad/s².
        gravity_gradient: bound on the gradient of differential gravity, 1/s².
        range_limit: distance from the body frame's origin within which the drift is bounded, m.
        speed_limit: speed up to which the drift is bounded, m/s.
        position_error: largest norm of the estimate's error, m.
        velocity_error: likewise, m/s.
        mass_error: largest relative error of the mass.
        gain_error: largest relative error of each thruster's force.
        delay: control steps between a command and its effect.
        origin_offset: from the body frame's origin, from which positions are told, to the target's centre of mass,
            about which the frame turns, m.
        force_error: largest norm of a step's mean force beyond the one commanded, of thrusters that give no force but
            some, N.
        excursion: what force that comes in pulses adds within a period to the distance from the motion under a steady
            one; at the samples it is nothing, m.
        velocity_excursion: likewise to the velocity, m/s.
        fault_force: largest norm of the force that is wrong in a fault, N.
        fault_steps: consecutive control steps after which a fault is over, once in a flight.
        turning_error: largest relative change of a held force while the axes that it is held in turn against the body
            frame over a period, 2 sin(α/2) for an angle α; 0 where a force is held in the body frame.
        valid_until: time, s since the orbit's epoch, until which the other numbers hold; infinite where they always do.

    Raises:
        ControlError: a number that is not finite or outside its range.

    """

    mass: float
    force_limit: float
    period: float
    disturbance_force: float
    angular_rate: float
    angular_acceleration: float
    gravity_gradient: float
    range_limit: float
    speed_limit: float
    position_error: float = 0.0
    velocity_error: float = 0.0
    mass_error: float = 0.0
    gain_error: float = 0.0
    delay: int = eqx.field(static=True, default=0)
    origin_offset: float = 0.0
    force_error: float = 0.0
    excursion: float = 0.0
    velocity_excursion: float = 0.0
    fault_force: float = 0.0
    fault_steps: int = eqx.field(static=True, default=0)
    turning_error: float = 0.0
    valid_until: float = math.inf

    def __check_init__(self) -> None:
        """Check each number against its range."""
        for names, positive in ((_POSITIVE, True), (_NOT_NEGATIVE, False)):
            for name, unit in names.items():
                value = getattr(self, name)
                require_finite(value, f"guard: {name} is {value} {unit}", ControlError, positive=positive)
        if self.turning_error and self.excursion:
            raise ControlError(
                f"guard: turning_error is {self.turning_error} and excursion {self.excursion} m; pulses are bounded "
                "only in the body frame, where turning_error is 0"
            )
        if math.isnan(self.valid_until):
            raise ControlError("guard: valid_until is nan s; it must be a time, or infinite")
        if not 0.0 <= self.mass_error < 1.0:
            raise ControlError(f"guard: mass_error is {self.mass_error}; it must be at least 0 and below 1")
        if self.delay != int(self.delay) or not 0 <= self.delay <= 8:
            raise ControlError(f"guard: delay is {self.delay} steps; it must be a whole number from 0 to 8")
        least = 1 if self.fault_force else 0
        if self.fault_steps != int(self.fault_steps) or not least <= self.fault_steps <= _LONGEST_FAULT:
            raise ControlError(
                f"guard: fault_steps is {self.fault_steps}; with a fault_force of {self.fault_force} N it must be a "
                f"whole number from {least} to {_LONGEST_FAULT}"
            )

    @property
    def authority(self) -> Number:
        """F_max/m, m/s²: what the thrusters give in every direction (more along a diagonal, which is not used)."""
        return self.force_limit / self.mass

    @property
    def drift(self) -> Number:
        """Bound on the drift |2ω×v + ω̇×r + ω×(ω×r) + Δg| inside the range and speed limits, m/s².

        There r is from the centre of mass, which is up to `origin_offset` further away than the origin.
        """
        kappa = self.angular_acceleration + self.angular_rate**2 + self.gravity_gradient
        return 2.0 * self.angular_rate * self.speed_limit + kappa * (self.range_limit + self.origin_offset)

    @property
    def disturbance(self) -> Number:
        """D: bound on every acceleration beyond commanded force over nominal mass, m/s², but for a fault's.

        The disturbance's, the drift, the errors of scale, those of the force that thrusters give, and what a force held
        in other axes than the body frame's turns away.
        """
        scale = (1.0 + self.gain_error) / (1.0 - self.mass_error) - 1.0
        push = self.disturbance_force / (self.mass * (1.0 - self.mass_error))
        wrong = self.force_error / (self.mass * (1.0 - self.mass_error))
        return push + self.drift + (scale + self.turning_error) * math.sqrt(3.0) * self.authority + wrong

    @property
    def fault_push(self) -> Number:
        """Largest acceleration of a fault, m/s²."""
        return self.fault_force / (self.mass * (1.0 - self.mass_error))

    @property
    def estimate_errors(self) -> tuple[Number, Number]:
        """Bounds ε_r (m) and ε_v (m/s) that every estimate of a flight keeps."""
        return self.position_error, self.velocity_error


class ObserverGain(eqx.Module):
    """The guard's observer x̂ = x̄ + H (told − x̄), H = [[l_r, (1 − l_r) T], [0, l_v]] (docs/guard.md, section 3).

    Attributes:
        position: l_r.
        velocity: l_v.
        error_radius: how far x̂ can be from the true position while the assumptions hold, m.
        velocity_error_radius: likewise of the velocity, m/s.
        plan_radius: how far the position predicted from x̂ can be from the plan then, m.

    """

    position: float
    velocity: float
    error_radius: float
    velocity_error_radius: float
    plan_radius: float


class BrakingDesign(eqx.Module):
    """Gains and radii of the braking law (docs/guard.md, section 3).

    Attributes:
        position_gain: k_p, 1/s².
        velocity_gain: k_d, 1/s.
        deceleration: a_b of the nominal braking motion, m/s².
        reserve: U, the largest feedback acceleration, m/s²; U + a_b = F_max/m.
        position_radius: ρ, the largest distance between the chaser and the nominal motion, at any instant, m. A chaser
            held at rest stays in a ball of this radius.
        velocity_radius: σ, the same of their velocities, m/s.
        observer: of the guard; None where the estimate has no errors and needs none.

    """

    position_gain: float
    velocity_gain: float
    deceleration: float
    reserve: float
    position_radius: float
    velocity_radius: float
    observer: ObserverGain | None = None


def design(assumptions: GuardAssumptions) -> BrakingDesign:
    """Choose the gains that need least room, and derive the radii that go with them.

    Least room, without errors of the estimate: the stop length from the speed limit and four times ρ, which is kept at
    rest too, and on every side. The poles are searched on a grid of real pairs. With errors: `least_room`. Whatever
    is chosen, the radii belong to it.

    Raises:
        ControlError: the thrusters cannot hold against the disturbance and the errors assumed.

    """
    best: BrakingDesign | None = None
    least, needed = math.inf, math.inf
    for made in _observed(assumptions) if any(assumptions.estimate_errors) else _perfect(assumptions):
        needed = min(needed, made.reserve)
        if made.deceleration <= 0.0:
            continue
        stopped = stop_length(assumptions.speed_limit, made.deceleration, assumptions.period, math.fmod)
        room = stopped + _AT_REST * made.position_radius
        if room < least:
            best, least = made, room
    if best is None:
        raise ControlError(
            f"guard: disturbance, drift and errors ask for {needed * assumptions.mass:.4g} N in feedback alone, and "
            f"force_limit is {assumptions.force_limit:.4g} N; lower disturbance_force, the rates, range_limit, "
            f"speed_limit, the delay ({assumptions.delay} steps), the errors or the fault, or raise force_limit"
        )
    return best


def _perfect(assumptions: GuardAssumptions) -> Iterator[BrakingDesign]:
    poles = np.linspace(0.02, 0.96, 20)
    for i, first in enumerate(poles):
        for second in poles[i:]:
            yield radii(assumptions, float(first), float(second))


def _observed(assumptions: GuardAssumptions) -> Iterator[BrakingDesign]:
    a = assumptions
    numbers = (a.disturbance, a.position_error, a.velocity_error, a.authority, a.speed_limit, a.fault_push)
    task = Task(float(a.period), a.delay, *map(float, numbers), fault_steps=a.fault_steps)
    yield observed_radii(a, least_room(task.rounded()))


def observed_radii(assumptions: GuardAssumptions, gains: responses.Gains) -> BrakingDesign:
    """Derive the radii for an estimate with errors, for given poles and gains of the observer (docs/guard.md, 3).

    Args:
        assumptions: of the guard.
        gains: the closed loop's two poles, at least 0 and below 1; l_r and l_v, above 0 and at most 1.

    """
    a, T, D = assumptions, assumptions.period, float(assumptions.disturbance)
    errors = np.array([float(error) for error in a.estimate_errors])
    summed = responses.responses(float(T), a.delay, gains, a.fault_steps)
    fault = float(a.fault_push)
    at_each_time = D * summed.pushed + summed.noisy @ errors + fault * summed.struck
    reach = at_each_time.max(axis=1)
    k_p, k_d = (float(gain[0]) for gain in responses.feedback_gains(float(T), *np.array(gains)[:2, None]))
    reserve = float(reach[responses.FEEDBACK])
    return BrakingDesign(
        position_gain=k_p,
        velocity_gain=k_d,
        deceleration=float(a.authority) - reserve,
        reserve=reserve,
        position_radius=float(reach[responses.POSITION]) + T**2 / 8.0 * (reserve + D + fault) + a.excursion,
        velocity_radius=float(reach[responses.VELOCITY]) + 0.5 * (D + fault) * T + a.velocity_excursion,
        # The first of the times is that of the plan itself, where the error from it is that of x̂.
        observer=ObserverGain(
            position=gains[2],
            velocity=gains[3],
            error_radius=float(at_each_time[responses.POSITION, 0]),
            velocity_error_radius=float(at_each_time[responses.VELOCITY, 0]),
            plan_radius=float(reach[responses.PREDICTED]),
        ),
    )


def radii(assumptions: GuardAssumptions, first_pole: float, second_pole: float) -> BrakingDesign:
    """Derive the radii for an estimate without errors, for closed-loop poles, 0 < pole < 1 (docs/guard.md, 3)."""
    T, D, fault = assumptions.period, float(assumptions.disturbance), float(assumptions.fault_push)
    k_p, k_d, (feedback, position, velocity) = _responses(
        T, assumptions.delay, first_pole, second_pole, assumptions.fault_steps
    )

    reserve = _reach(feedback, D, fault)
    bow = T**2 / 8.0 * (reserve + D + fault)
    return BrakingDesign(
        position_gain=k_p,
        velocity_gain=k_d,
        deceleration=float(assumptions.authority) - reserve,
        reserve=reserve,
        position_radius=_reach(position, D, fault) + bow + assumptions.excursion,
        velocity_radius=_reach(velocity, D, fault) + 0.5 * (D + fault) * T + assumptions.velocity_excursion,
    )


def _reach(response: tuple[float, float], disturbance: float, fault: float) -> float:
    """Give how far disturbance and fault (m/s²) take a response together."""
    peak, struck = response
    return disturbance * peak + fault * struck


@lru_cache(maxsize=2048)
def _responses(T: float, n: int, first_pole: float, second_pole: float, fault_steps: int):
    """Give all of `radii` that depends on period, delay, poles and a fault's length alone: guards have it in common.

    Gains k_p and k_d, and how feedback, position and velocity respond to a disturbance and to a fault.
    """
    k_p, k_d = responses.feedback_gains(T, first_pole, second_pole)
    step = np.array([[1.0, T], [0.0, 1.0]])
    held = np.array([0.5 * T**2, T])
    K = -np.array([k_p, k_d])
    ahead = np.linalg.matrix_power(step, n)
    powers = _powers(step + np.outer(held, K))
    free = np.stack([np.linalg.matrix_power(step, m) for m in range(n)]) if n else np.zeros((0, 2, 2))
    response = np.concatenate([free, powers @ ahead])

    def respond(row: Float[np.ndarray, "2"], pulses: Float[np.ndarray, "steps 2 2"]) -> tuple[float, float]:
        """Sum of ∫|row · pulse · (T − τ, 1)| dτ over all steps, and over those of a fault at its worst."""
        late, early = pulses @ np.array([0.0, 1.0]) @ row, pulses @ np.array([T, 1.0]) @ row
        each = responses.line_size(late, early)
        struck = responses.largest_window(each, fault_steps)[-1]
        return float(0.5 * T * np.sum(each)), float(0.5 * T * struck)

    position, velocity = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    return k_p, k_d, (respond(K, powers @ ahead), respond(position, response), respond(velocity, response))


def _powers(closed: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "steps 2 2"]:
    """I, M, M², … until what follows is below 1e-12 of what came before; that rest is lost in the last digits of ρ."""
    powers = np.eye(2)[None]
    while True:
        small = np.abs(powers).reshape(-1, 4).sum(axis=1) <= 1e-13
        if small.any():
            return powers[: int(np.argmax(small)) + 1]
        more = np.empty((_POWERS, 2, 2))
        last = powers[-1]
        for next_ in more:
            np.matmul(closed, last, out=next_)
            last = next_
        powers = np.concatenate([powers, more])


def predict(
    assumptions: GuardAssumptions, position: Vector, velocity: Vector, pending: Float[Array, "delay 3"]
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3"]]:
    """Positions and velocities now and after each pending command; the next command takes effect at the last."""
    T = assumptions.period
    points, velocities = [position], [velocity]
    for i in range(assumptions.delay):
        position = position + T * velocity + 0.5 * T**2 * pending[i]
        velocity = velocity + T * pending[i]
        points.append(position)
        velocities.append(velocity)
    return jnp.stack(points), jnp.stack(velocities)


def stop(assumptions: GuardAssumptions, braking: BrakingDesign, velocity: Vector) -> Vector:
    """From where the nominal braking motion begins to where it ends, m."""
    speed = jnp.linalg.norm(velocity)
    length = stop_length(speed, braking.deceleration, assumptions.period, jnp.fmod)
    return velocity * (length / jnp.maximum(speed, 1e-12))


def brake(assumptions: GuardAssumptions, braking: BrakingDesign, velocity: Vector) -> tuple[Vector, Flag]:
    """Give the nominal braking acceleration, m/s², and whether the nominal motion is at rest."""
    speed = norm(velocity)
    size = jnp.minimum(braking.deceleration, speed / assumptions.period)
    return -velocity * (size / jnp.maximum(speed, 1e-12)), speed < 1e-9


def escape(
    assumptions: GuardAssumptions, braking: BrakingDesign, position: Vector, velocity: Vector, outward: Vector
) -> Vector:
    """Acceleration (m/s²) along the field's growth, or back into range, at `_ESCAPE_SPEED`, within the authority."""
    a = assumptions
    afar = norm(position) + braking.position_radius > 0.99 * a.range_limit
    away = jnp.where(afar, -position, outward)
    direction = away / jnp.maximum(norm(away), 1e-9)
    wanted = (jnp.where(jnp.isfinite(direction), direction, 0.0) * _ESCAPE_SPEED - velocity) / a.period
    return wanted * jnp.minimum(1.0, a.authority / jnp.maximum(norm(wanted), 1e-12))

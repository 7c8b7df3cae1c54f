"""The guard's braking law, designed from its assumptions: authority, gains, and the radius of the tube it stays in.

Everything is derived, nothing tuned: docs/guard.md states and proves the theorem, with these names. In short, the error
e between the chaser and a nominal braking motion obeys, at the control instants and in every axis alike,

    e⁺ = (Φ + Γ K) e + w + Γ K (errors of the estimate),   Φ = [[1, T], [0, 1]],  Γ = [T²/2, T],  K = −[k_p, k_d],

so the largest error that any admissible disturbance can build up is the sum of the absolute impulse response.
"""

import math
from functools import lru_cache

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from keepout.errors import ControlError

Number = float | Float[Array, "*flights"]
"""Python's number; in a compiled program that takes the guard's numbers as arguments an array."""

_AT_REST = 4.0
"""Weight of ρ against the stop length when gains are chosen."""
_POWERS = 32
"""Powers of a matrix taken between two looks at their size."""


class GuardAssumptions(eqx.Module):
    """What the guard's theorem assumes of the flight; each number is checked here and watched in flight.

    The numbers are Python's, and part of a compiled program; in a campaign that varies them they are arrays, one entry
    a flight.

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

    def __check_init__(self) -> None:
        """Check each number against its range."""
        for name, unit in (
            ("mass", "kg"),
            ("force_limit", "N"),
            ("period", "s"),
            ("range_limit", "m"),
            ("speed_limit", "m/s"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ControlError(f"guard: {name} is {value} {unit}; it must be finite and greater than 0")
        for name, unit in (
            ("disturbance_force", "N"),
            ("angular_rate", "rad/s"),
            ("angular_acceleration", "rad/s2"),
            ("gravity_gradient", "1/s2"),
            ("position_error", "m"),
            ("velocity_error", "m/s"),
            ("gain_error", ""),
            ("origin_offset", "m"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ControlError(f"guard: {name} is {value} {unit}; it must be finite and at least 0")
        if not 0.0 <= self.mass_error < 1.0:
            raise ControlError(f"guard: mass_error is {self.mass_error}; it must be at least 0 and below 1")
        if self.delay != int(self.delay) or not 0 <= self.delay <= 8:
            raise ControlError(f"guard: delay is {self.delay} steps; it must be a whole number from 0 to 8")

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
        """D: bound on every acceleration beyond commanded force over nominal mass, m/s² (disturbance, drift, scale)."""
        scale = (1.0 + self.gain_error) / (1.0 - self.mass_error) - 1.0
        push = self.disturbance_force / (self.mass * (1.0 - self.mass_error))
        return push + self.drift + scale * math.sqrt(3.0) * self.authority


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

    """

    position_gain: float
    velocity_gain: float
    deceleration: float
    reserve: float
    position_radius: float
    velocity_radius: float

    def stop_length(self, speed: float, period: float) -> float:
        """Length of the nominal braking motion from `speed` (m/s), in m: full steps, then one that ends at rest."""
        rest = math.fmod(speed, self.deceleration * period)
        return (speed**2 - rest**2) / (2.0 * self.deceleration) + 0.5 * rest * period


def design(assumptions: GuardAssumptions) -> BrakingDesign:
    """Choose the gains that need least room, and derive the radii that go with them.

    Least room: the stop length from the speed limit and four times ρ, which is kept at rest too, and on every side.
    The poles are searched on a grid of real pairs; whatever the grid, the radii belong to the gains chosen.

    Raises:
        ControlError: the thrusters cannot hold against the disturbance and the estimate's errors assumed.

    """
    poles = np.linspace(0.02, 0.96, 20)
    best: BrakingDesign | None = None
    least, needed = math.inf, math.inf
    for i, first in enumerate(poles):
        for second in poles[i:]:
            made = radii(assumptions, float(first), float(second))
            needed = min(needed, made.reserve)
            if made.deceleration <= 0.0:
                continue
            room = made.stop_length(assumptions.speed_limit, assumptions.period) + _AT_REST * made.position_radius
            if room < least:
                best, least = made, room
    if best is None:
        raise ControlError(
            f"guard: disturbance, drift and errors ask for {needed * assumptions.mass:.4g} N in feedback alone, and "
            f"force_limit is {assumptions.force_limit:.4g} N; lower disturbance_force, the rates, range_limit, "
            f"speed_limit, the delay ({assumptions.delay} steps) or the errors, or raise force_limit"
        )
    return best


def radii(assumptions: GuardAssumptions, first_pole: float, second_pole: float) -> BrakingDesign:
    """Derive the radii for given closed-loop poles, 0 < pole < 1 (docs/guard.md, section 3)."""
    T, D = assumptions.period, float(assumptions.disturbance)
    k_p, k_d, heard, (feedback, position, velocity) = _responses(T, assumptions.delay, first_pole, second_pole)
    errors = np.array([assumptions.position_error, assumptions.velocity_error])
    # The estimate's error reaches the thrusters through K Φⁿ, once a step.
    noise = float(heard @ errors)

    reserve = _reach(feedback, D, noise, errors) + noise
    bow = T**2 / 8.0 * (reserve + D)
    return BrakingDesign(
        position_gain=k_p,
        velocity_gain=k_d,
        deceleration=float(assumptions.authority) - reserve,
        reserve=reserve,
        position_radius=_reach(position, D, noise, errors) + bow,
        velocity_radius=_reach(velocity, D, noise, errors) + 0.5 * D * T,
    )


def _reach(
    response: tuple[float, float, Float[np.ndarray, "starts 2"]],
    disturbance: float,
    noise: float,
    errors: Float[np.ndarray, "2"],
) -> float:
    """Give how far disturbance, noise and the errors of the start take a response together."""
    peak, driven, started = response
    return disturbance * peak + noise * driven + float(np.max(started @ errors))


@lru_cache(maxsize=2048)
def _responses(T: float, n: int, first_pole: float, second_pole: float):
    """Give all of `radii` that depends on period, delay and poles alone: guards of one period have it in common.

    Gains k_p, k_d and |K Φⁿ|, and how feedback, position and velocity respond: to a disturbance, to noise in the
    feedback, and (a row a start) to the errors that a plan starts with.
    """
    total, product = first_pole + second_pole, first_pole * second_pole
    k_p = (1.0 - total + product) / T**2
    k_d = (1.0 - product) / T + 0.5 * k_p * T
    step = np.array([[1.0, T], [0.0, 1.0]])
    held = np.array([0.5 * T**2, T])
    K = -np.array([k_p, k_d])
    ahead = np.linalg.matrix_power(step, n)
    powers = _powers(step + np.outer(held, K))
    # A candidate's plan is one step older when it is first followed than the plan that a flight starts with.
    start = np.concatenate([powers @ np.linalg.matrix_power(step, n + 1), powers @ ahead])
    free = np.stack([np.linalg.matrix_power(step, m) for m in range(n)]) if n else np.zeros((0, 2, 2))
    response = np.concatenate([free, powers @ ahead])

    def peak(row: Float[np.ndarray, "2"], pulses: Float[np.ndarray, "steps 2 2"]) -> float:
        """Sum of ∫|row · pulse · (T − τ, 1)| dτ over a step: of the absolute value of a line between two end values."""
        late, early = pulses @ np.array([0.0, 1.0]) @ row, pulses @ np.array([T, 1.0]) @ row
        size = np.abs(late) + np.abs(early)
        crossing = (late**2 + early**2) / np.maximum(size, 1e-300)
        return float(0.5 * T * np.sum(np.where(late * early < 0.0, crossing, size)))

    def respond(row: Float[np.ndarray, "2"], pulses: Float[np.ndarray, "steps 2 2"]):
        driven = float(np.sum(np.abs(powers @ held @ row)))
        return peak(row, pulses), driven, np.abs(np.einsum("i,mij->mj", row, start))

    position, velocity = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    rows = respond(K, powers @ ahead), respond(position, response), respond(velocity, response)
    return k_p, k_d, np.abs(K @ ahead), rows


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

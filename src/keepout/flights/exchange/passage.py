"""The verdict on a flight that is known by positions and attitudes at some epochs only, and a bound on what is not.

Let ρ(t) be the chaser's position from the target's centre of mass in inertial axes and R(t) the rotation from inertial
to body axes. Over a step of T seconds nothing is assumed but |ρ̈| ≤ a, the turning rate |ω| ≤ Ω and |ω̇| ≤ α. Whatever
twice differentiable curve has |ü| ≤ b lies within b τ (T − τ)/2 of the chord between its ends. So do

    ρ, with b = a,        and R(t) c for a fixed c, with b = (α + Ω²)|c|, because R̈ c = ω̇ × … + ω × (ω × …),

and with ρ̃ and R̃ the chords, |R ρ − R̃ ρ̃| ≤ |ρ − ρ̃| + |(R − R̃) ρ̃| ≤ (a + (α + Ω²) max|ρ̃|) τ (T − τ)/2. The speed in the
body frame is at most |ρ̇| + Ω|ρ|, where |ρ̇| ≤ |Δρ|/T + a T/2. A branch and bound as in `tube` then bounds the clearance.

The samples are wrong too: ρ by E metres at most, R by a turn of at most ε. Chords between wrong samples are wrong by E
and ε|ρ| at most.

Ω follows from α and the samples: a rotation by the angle φ in T seconds with |ω̇| ≤ α turns at (φ + 2ε)/T + α T at
most, provided that it turns less than half a turn in a step, which samples alone cannot tell.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.core.audit.audit import Contact, ExactMesh, box_of, outside_from, verdict
from keepout.core.audit.tube import Fractions, Numbers, Path, Pieces, lengths, nearest
from keepout.core.errors import FlightError, require_finite

_ROUNDING = 1e-9
"""Metres taken off every clearance bound: far more than float64 loses at the size of a space station."""


class Samples(NamedTuple):
    """A flight at some epochs.

    Attributes:
        time: of each, s.
        relative: chaser less target's centre of mass, inertial axes, m.
        relative_velocity: its derivative, m/s; it only tells whether an acceleration's bound can be true.
        turn: rotations from inertial to body axes.

    """

    time: Float[np.ndarray, "samples"]
    relative: Float[np.ndarray, "samples 3"]
    relative_velocity: Float[np.ndarray, "samples 3"]
    turn: Float[np.ndarray, "samples 3 3"]


@dataclass(frozen=True)
class SampleBounds:
    """What samples do not tell, bounded.

    Attributes:
        acceleration_bound: of `relative` in inertial axes, whatever its cause: thrust, air, differential gravity, m/s².
        turning_acceleration_bound: of the target, rad/s².
        sample_error: how far a sample of `relative` may be from the truth, and how far one of `relative_velocity`
            leads astray over a step where `velocity_error` does not say more, m.
        velocity_error: how far a sample of `relative_velocity` may be from the truth, m/s.
        attitude_error: the angle by which a sample of `turn` may be turned from the truth, rad.

    Raises:
        FlightError: a bound is no bound.

    """

    acceleration_bound: float
    turning_acceleration_bound: float
    sample_error: float = 1e-6
    velocity_error: float = 0.0
    attitude_error: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a number that bounds nothing."""
        for (name, value), unit in zip(vars(self).items(), ("m/s²", "rad/s²", "m", "m/s", "rad"), strict=True):
            require_finite(value, f"audit: {name} is {value} {unit}", FlightError)


@dataclass(frozen=True)
class Chords(Path):
    """A path between samples of one flight: chords, and how far it can be from them; what `tube.nearest` splits.

    `sway` (m/s²) is a + (α + Ω²) max|ρ̃|, and `swing` (m) is ε max|ρ̃|, how far a wrong attitude carries a point, one of
    each a step; half a step's travel at `speed` holds `swing`.
    `turn` holds the rotations body ← inertial at the samples, `relative` is ρ, and `origin` (m) the centre of mass in
    the body frame.
    """

    relative: Float[np.ndarray, "samples 3"]
    turn: Float[np.ndarray, "samples 3 3"]
    sway: Float[np.ndarray, "steps"]
    swing: Float[np.ndarray, "steps"]
    origin: Float[np.ndarray, "3"]

    @classmethod
    def of(
        cls,
        samples: Samples,
        bounds: SampleBounds,
        turning_rate: Float[np.ndarray, "steps"],
        origin: Float[np.ndarray, "3"],
    ) -> "Chords":
        """Build the chords of samples with ρ, R, a, E, α and ε, Ω of each step and the centre of mass (m)."""
        time, relative, _, turn = samples
        step = np.diff(time)
        away = lengths(relative) + bounds.sample_error
        furthest = np.maximum(away[1:], away[:-1])
        swing = bounds.attitude_error * furthest
        acceleration = bounds.acceleration_bound
        sway = acceleration + (bounds.turning_acceleration_bound + turning_rate**2) * furthest
        own = (lengths(np.diff(relative, axis=0)) + 2.0 * bounds.sample_error) / step + 0.5 * acceleration * step
        # The path may bulge beyond its ends by a T²/8.
        speed = own + turning_rate * (furthest + acceleration * step**2 / 8.0) + 2.0 * swing / step
        position = np.einsum("nij,nj->ni", turn, relative) + origin
        return cls(time, position[None], speed[None], relative, turn, sway, swing, origin)

    def piece(self, flight: Numbers, index: Numbers, start: Fractions, end: Fractions) -> Pieces:
        """Give the point of the turned chord, its error, and the part's radius; see `Path`."""
        step = np.diff(self.time)[index]
        middle = 0.5 * (start + end)
        one, other = (1.0 - middle)[:, None], middle[:, None]
        relative = one * self.relative[index] + other * self.relative[index + 1]
        turn = one[:, None] * self.turn[index] + other[:, None] * self.turn[index + 1]
        point = np.einsum("nij,nj->ni", turn, relative) + self.origin
        error = self.error(index, middle)
        return point, error, error + 0.5 * (end - start) * step * self.speed[flight, index]

    def error(self, index: Numbers, part: Fractions) -> Fractions:
        """Give how far the path is at most (m) from its chord's point at a part (a fraction) of step `index`."""
        step = np.diff(self.time)[index]
        return 0.5 * self.sway[index] * part * (1.0 - part) * step**2 + self.swing[index]


@dataclass(frozen=True)
class Passage:
    """What is known about a flight from samples of it (metres, seconds).

    Attributes:
        contact: the verdict.
        minimum_clearance: no instant has a smaller clearance, given the bounds.
        measured_clearance: some instant has a clearance no larger than this, given the bounds.
        minimum_time: of that instant.
        minimum_position: there, body frame.
        start_outside: whether the exterior was reached from one of the samples.
        least_acceleration: the least bound with which positions and velocities of all steps agree, m/s².
        turning_rate: the largest Ω, rad/s.
        largest_turn: of the target between two samples, rad.
        longest_step: s.
        uncertainty: the largest distance of the path from chords between exact samples, m.
        remarks: a line each, why the verdict is not a plain "no".

    """

    contact: Contact
    minimum_clearance: float
    measured_clearance: float
    minimum_time: float
    minimum_position: tuple[float, float, float]
    start_outside: bool
    least_acceleration: float
    turning_rate: float
    largest_turn: float
    longest_step: float
    uncertainty: float
    remarks: tuple[str, ...]


def audit_passage(
    samples: Samples,
    target: ExactMesh,
    *,
    chaser_radius: float,
    bounds: SampleBounds,
    centre_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tolerance: float = 1e-3,
) -> Passage:
    """Judge a flight that is known at some epochs against the exact mesh.

    Args:
        samples: of the flight.
        target: the mesh.
        chaser_radius: of the ball that holds the chaser, m.
        bounds: on what the samples do not tell.
        centre_of_mass: of the target, in the body frame, m.
        tolerance: how close to the truth the clearance bound is driven, m.

    Raises:
        FlightError: a number is out of range, or times do not rise.

    """
    require_finite(chaser_radius, f"audit: chaser_radius is {chaser_radius} m", FlightError)
    require_finite(tolerance, f"audit: tolerance is {tolerance} m", FlightError, positive=True)
    if not np.all(np.isfinite(centre_of_mass)):
        raise FlightError(f"audit: centre_of_mass is {list(centre_of_mass)} m; its numbers must be finite")
    time, step = samples.time, np.diff(samples.time)
    if len(time) < 2 or not np.all(step > 0.0):
        raise FlightError(f"audit: {len(time)} times are given; there must be at least 2, and each after the last")
    turned = angles(samples.turn) + 2.0 * bounds.attitude_error
    rate = turned / step + bounds.turning_acceleration_bound * step
    chords = Chords.of(samples, bounds, rate, np.asarray(centre_of_mass))
    distance = target.distance.distance
    bound = nearest(chords, distance, tolerance=tolerance)
    clearance = float(bound.lower[0]) - chaser_radius - bounds.sample_error - _ROUNDING
    # The least distance found may be that at a sample, which the search takes to be exact.
    k = min(int(np.searchsorted(time, bound.time[0], side="right")) - 1, len(step) - 1)
    astray = chords.error(np.array([k]), (bound.time - time[k]) / step[k])
    found = float((distance(bound.position) + astray)[0]) - chaser_radius + bounds.sample_error
    shown = chords.position[0][np.linspace(0, len(time) - 1, 5).astype(int)]
    outside = outside_from(shown, distance, box_of(target), chaser_radius)
    needed = least_accelerations(samples, bounds)
    contact, remarks = verdict(clearance, found, outside, _remarks(time, needed, bounds.acceleration_bound, turned))
    x, y, z = bound.position[0].tolist()
    return Passage(
        contact=contact,
        minimum_clearance=clearance,
        measured_clearance=found,
        minimum_time=float(bound.time[0]),
        minimum_position=(x, y, z),
        start_outside=outside,
        least_acceleration=float(needed.max()),
        turning_rate=float(rate.max()),
        largest_turn=float(turned.max()),
        longest_step=float(step.max()),
        uncertainty=float(np.max(chords.sway * step**2 / 8.0)),
        remarks=remarks,
    )


def _remarks(
    time: Float[np.ndarray, "samples"],
    needed: Float[np.ndarray, "steps"],
    acceleration_bound: float,
    turned: Float[np.ndarray, "steps"],
) -> list[str]:
    """Say where the acceleration needed (m/s²) is beyond its bound, and where a turn (rad) is too large to tell."""
    said, k = [], int(np.argmax(needed))
    if needed[k] > acceleration_bound:
        said.append(
            f"from {time[k]:.6g} s to {time[k + 1]:.6g} s positions and velocities need {needed[k]:.4g} m/s², more "
            f"than the acceleration bound, {acceleration_bound:.4g} m/s²"
        )
    if turned.max() > 0.5 * np.pi:
        said.append(
            f"the target turns by {np.degrees(turned.max()):.4g} degrees between two epochs: too far to tell its rate"
        )
    return said


def angles(turn: Float[np.ndarray, "samples 3 3"]) -> Float[np.ndarray, "steps"]:
    """Give the angle, rad, between each rotation and the next, accurate for the smallest: 2 asin(‖ΔR‖_F/√8)."""
    between = np.linalg.norm(np.diff(turn, axis=0).reshape(len(turn) - 1, 9), axis=1)
    return 2.0 * np.arcsin(np.minimum(between / np.sqrt(8.0), 1.0))


def least_accelerations(samples: Samples, bounds: SampleBounds) -> Float[np.ndarray, "steps"]:
    """Give for each step the least a with which its ends agree, m/s².

    With E the sample error, and V T the velocity error times the step, or E if that is more: |Δv| T ≤ a T² + 2 V T; and
    |Δr − v₀ T|, |Δr − v₁ T| ≤ a T²/2 + 2 E + V T.
    """
    step, velocity = np.diff(samples.time), samples.relative_velocity
    astray = np.maximum(bounds.sample_error, bounds.velocity_error * step)
    moved = np.diff(samples.relative, axis=0)
    sped = lengths(np.diff(velocity, axis=0)) * step
    forward = lengths(moved - velocity[:-1] * step[:, None])
    backward = lengths(moved - velocity[1:] * step[:, None])
    coasted = 2.0 * (np.maximum(forward, backward) - 2.0 * bounds.sample_error - astray)
    return np.maximum(np.maximum(sped - 2.0 * astray, coasted), 0.0) / step**2

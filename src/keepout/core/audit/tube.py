"""Where a recorded flight can have been between its samples, and how near it can have come to a mesh.

Over a control step the applied force F is held, so with a = F/m the recorded start (r₀, v₀) and end (r₁, v₁) give

    r(τ) = r₀ + v₀ τ + a τ²/2 + u(τ),             u(0) = u̇(0) = 0,  |ü| ≤ b,
    r(τ) = r₁ − v₁ (T−τ) + a (T−τ)²/2 + w(τ),     w(T) = ẇ(T) = 0,  |ẅ| ≤ b,

where b bounds every acceleration that the record does not hold (disturbance and drift). Hence |u| ≤ b τ²/2 and
|w| ≤ b (T−τ)²/2: the first parabola serves the first half of the step, the second one the second half, and the path is
never further than b T²/8 from the one in use. Distance to a mesh is 1-Lipschitz, so a distance at the middle of a piece
of path, less the piece's radius, bounds the whole piece from below; pieces are split, those that can hold the minimum
first, until the bound is within the tolerance asked.

Where thrusters give pulses, F is their mean, and r is such a path y plus a departure δ, |δ| ≤ e from the path through
either end of the step and |δ̇| ≤ c. What drifts is y + δ, so that b grows by 2ωc + κe, and every radius grows by e.

The loops over all samples of all flights, at the end, are compiled: each sample is read once, and other threads go on.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from math import sqrt

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.cores import kernel
from keepout.core.errors import FlightError, require_finite

Distance = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]
Numbers = Int[np.ndarray, "pieces"]
Fractions = Float[np.ndarray, "pieces"]
Pieces = tuple[Float[np.ndarray, "pieces 3"], Float[np.ndarray, "pieces"], Float[np.ndarray, "pieces"]]

_BLOCK = 64
"""Steps in the coarsest piece of path; a power of four, because blocks are split into quarters."""

_HALVINGS = 14
"""A step is halved at most this often: beyond it the remainder b T²/8, not the piece's length, limits the bound."""


class Contact(StrEnum):
    """Whether the chaser touched the target, or entered a zone: proved either way, or not decided."""

    NO = "no"
    YES = "yes"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class FlightBounds:
    """What a flight's record does not hold, bounded: the audit's only assumptions, all of them scenario numbers.

    `mass` is the true mass in kg; `disturbance_force` the largest norm, in newton, of every force not recorded;
    `angular_rate` (rad/s) and `angular_acceleration` (rad/s²) bound the rotation of the body frame; `gravity_gradient`
    (1/s²) bounds the norm of the gradient of differential gravity within `range_limit` (m) of the body frame's origin,
    2 μ / r³ for a point mass with r the least distance from the Earth's centre; `origin_offset` (m) is the origin's
    distance from the target's centre of mass. `excursion` (m) and `velocity_excursion` (m/s) bound the departure of
    pulsed thrusters from the motion under the recorded mean force. All of them hold for relative speeds up to
    `speed_limit` (m/s), until `valid_until` (s). `force_turning` (rad/s) bounds how fast the axes in which the recorded
    force is held turn against the body frame.
    """

    mass: float
    disturbance_force: float
    angular_rate: float
    angular_acceleration: float
    gravity_gradient: float
    origin_offset: float = 0.0
    range_limit: float = np.inf
    excursion: float = 0.0
    velocity_excursion: float = 0.0
    speed_limit: float = np.inf
    valid_until: float = np.inf
    force_turning: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a number that bounds nothing."""
        require_finite(self.mass, f"audit: mass is {self.mass} kg", FlightError, positive=True)
        pushes = ("disturbance_force", "excursion", "velocity_excursion")
        turns = ("angular_rate", "angular_acceleration", "gravity_gradient", "force_turning")
        for name in (*pushes, *turns, "origin_offset"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise FlightError(f"audit: {name} is {value}; a bound must be finite and at least 0")
        for name, unit in (("range_limit", "m"), ("speed_limit", "m/s"), ("valid_until", "s")):
            if not getattr(self, name) > 0.0:
                raise FlightError(f"audit: {name} is {getattr(self, name)} {unit}; it must be greater than 0")


def components(vectors: Float[np.ndarray, "*batch 3"]) -> list[Float[np.ndarray, "*batch"]]:
    """Give views of the three components: NumPy is several times as fast along a long axis as along one of three."""
    return [vectors[..., axis] for axis in range(3)]


def lengths(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    """Euclidean norms, by components."""
    x, y, z = components(vectors)
    return np.sqrt(x * x + y * y + z * z)


@dataclass(frozen=True)
class Path(abc.ABC):
    """Flights of equal length between their samples, as `nearest` asks about them.

    `time` (s) and `position` (m) are those of the samples; `speed` (m/s) bounds |ṙ| over each step.
    """

    time: Float[np.ndarray, "samples"]
    position: Float[np.ndarray, "flights samples 3"]
    speed: Float[np.ndarray, "flights steps"]

    @abc.abstractmethod
    def piece(self, flight: Numbers, index: Numbers, start: Fractions, end: Fractions) -> Pieces:
        """Give a point for the part [start, end] (fractions) of step `index`, its error, and the part's radius.

        The path at the middle of the part is within `error` of the point, the whole part within `radius` of it.
        """


@dataclass(frozen=True)
class Tube(Path):
    """Flights of equal length as recorded states and the bounds that hold between them.

    `residual` (m/s²) is b of the module's docstring, one a step.
    `beyond` says of each step whether it can have left the range, speed or time within which b is a bound. `excursion`
    (m) is e of the docstring; half a step's travel at `speed` holds it too.
    """

    velocity: Float[np.ndarray, "flights samples 3"]
    acceleration: Float[np.ndarray, "flights samples 3"]
    residual: Float[np.ndarray, "flights steps"]
    beyond: Bool[np.ndarray, "flights steps"]
    excursion: float = 0.0

    @classmethod
    def of(
        cls,
        time: Float[np.ndarray, "samples"],
        position: Float[np.ndarray, "flights samples 3"],
        velocity: Float[np.ndarray, "flights samples 3"],
        force: Float[np.ndarray, "flights samples 3"],
        bounds: FlightBounds,
    ) -> "Tube":
        """Build the tube of recorded states; row k of `force` (newton) is held from sample k to sample k + 1.

        The drift |2ω×v + ω̇×r + ω×(ω×r) + Δg| is at most 2ω|v| + κ|r|, κ = ω̇ + ω² + gravity gradient, r from the centre
        of mass. With X the largest speed in the step, |r| ≤ |r₀| + X T and X ≤ |v₀| + T (|a| + d/m + 2ωX + κ(|r₀| +
        X T)), which is solved for X. A path that is still within the range limit after |r₀| + X T never left it, so
        that κ held all along, and likewise X the speed limit; one that may not be is `beyond`. A force whose axes turn
        by α in the step is off by at most 2 sin(α/2)|a|, which adds to d/m.
        """
        step, acceleration = np.diff(time), force / bounds.mass
        # Of one kind, whoever recorded them: else the kernels are compiled once more.
        position, velocity = (np.require(of, requirements=("C", "W")) for of in (position, velocity))
        disturbance = bounds.disturbance_force / bounds.mass
        kappa = bounds.angular_acceleration + bounds.angular_rate**2 + bounds.gravity_gradient
        disturbance += 2.0 * bounds.angular_rate * bounds.velocity_excursion + kappa * bounds.excursion
        slack = 1.0 - 2.0 * bounds.angular_rate * step - kappa * step**2
        if np.any(slack <= 0.0):
            raise FlightError(
                f"audit: samples {step.max():.3g} s apart are too coarse for a frame turning at "
                f"{bounds.angular_rate:.3g} rad/s; the record needs "
                f"samples at most {0.4 / max(bounds.angular_rate, kappa**0.5):.3g} s apart"
            )
        turned = 2.0 * np.sin(0.5 * np.minimum(bounds.force_turning * step, np.pi))
        limits = kappa, bounds.origin_offset, bounds.range_limit - bounds.excursion
        residual, speed, beyond = bound_steps(
            step, slack, turned, position, velocity, acceleration, disturbance, bounds.angular_rate, *limits
        )
        if bounds.excursion > 0.0:
            speed = speed + 2.0 * bounds.excursion / step
        beyond |= (speed + bounds.velocity_excursion > bounds.speed_limit) | (time[1:] > bounds.valid_until)
        return cls(time, position, speed, velocity, acceleration, residual, beyond, bounds.excursion)

    def inconsistency(self) -> Float[np.ndarray, "flights steps"]:
        """How far, in metres, the end of each step lies beyond what its start and the bounds allow; ≤ 0 is consistent.

        The velocity's excess is counted over the step's length, so that one number covers both.
        """
        return excess_of_steps(
            np.diff(self.time), self.position, self.velocity, self.acceleration, self.residual, self.excursion
        )

    def piece(self, flight: Numbers, index: Numbers, start: Fractions, end: Fractions) -> Pieces:
        """Give a point on the nearer end's parabola, its error, and the part's radius; see `Path`."""
        step = np.diff(self.time)[index]
        middle = 0.5 * (start + end)
        forward = middle <= 0.5
        tau = np.where(forward, middle, middle - 1.0) * step
        sample = index + np.where(forward, 0, 1)
        position, velocity = self.position[flight, sample], self.velocity[flight, sample]
        held = self.acceleration[flight, index]
        point = position + velocity * tau[:, None] + 0.5 * held * (tau**2)[:, None]
        error = 0.5 * self.residual[flight, index] * tau**2 + self.excursion
        radius = error + 0.5 * (end - start) * step * self.speed[flight, index]
        return point, error, radius


@dataclass(frozen=True)
class Nearest:
    """Bounds on each flight's least distance, in metres, and where the nearest point found lies."""

    lower: Float[np.ndarray, "flights"]
    upper: Float[np.ndarray, "flights"]
    time: Float[np.ndarray, "flights"]
    position: Float[np.ndarray, "flights 3"]


def nearest(tube: Path, distance: Distance, *, tolerance: float) -> Nearest:
    """Bound the least distance of each flight to the mesh, by branch and bound over pieces of its path.

    `lower` never exceeds the true least distance and lies within `tolerance` of `upper` wherever the remainder b T²/8
    allows it. `distance` is exact and 1-Lipschitz.
    """
    flights, samples = tube.position.shape[:2]
    search = _Search(tube, distance, tolerance)
    flight = np.repeat(np.arange(flights), -(-(samples - 1) // _BLOCK))
    first = np.tile(np.arange(0, samples - 1, _BLOCK), flights)
    length = _BLOCK
    while length > 1:
        kept = search.blocks(flight, first, length)
        length //= 4
        flight = np.repeat(flight[kept], 4)
        first = (first[kept][:, None] + length * np.arange(4)).ravel()
        inside = first < samples - 1
        flight, first = flight[inside], first[inside]
    start, end = np.zeros(first.shape), np.ones(first.shape)
    for halving in range(_HALVINGS + 1):
        kept = search.parts(flight, first, start, end, last=halving == _HALVINGS)
        flight, first = np.repeat(flight[kept], 2), np.repeat(first[kept], 2)
        middle = 0.5 * (start[kept] + end[kept])
        start, end = (np.stack(ends, axis=-1).ravel() for ends in ([start[kept], middle], [middle, end[kept]]))
        if first.size == 0:
            break
    return Nearest(search.lower, search.upper, search.time, search.position)


class _Search:
    """The running bounds of `nearest`: least lower bound among pieces settled, least distance found so far."""

    def __init__(self, tube: Path, distance: Distance, tolerance: float) -> None:
        flights = tube.position.shape[0]
        self.tube, self.distance, self.tolerance = tube, distance, tolerance
        self.time = np.full(flights, tube.time[0])
        self.position = tube.position[:, 0].copy()
        self.upper = distance(self.position)
        self.lower = self.upper.copy()

    def blocks(self, flight: np.ndarray, first: np.ndarray, length: int) -> np.ndarray:
        """Bound blocks of whole steps by balls around their samples; the mask of those to be split."""
        tube = self.tube
        centre, sample, least, most, excess = bound_blocks(tube.time, tube.position, tube.speed, flight, first, length)
        found = self.distance(centre)
        self._improve(flight, found + least, tube.time[sample], tube.position[flight, sample])
        return self._settle(flight, found - most - excess)

    def parts(
        self, flight: np.ndarray, index: np.ndarray, start: np.ndarray, end: np.ndarray, *, last: bool
    ) -> np.ndarray:
        """Bound parts of single steps; the mask of those to be split."""
        if index.size == 0:
            return np.zeros(0, bool)
        tube = self.tube
        point, error, radius = tube.piece(flight, index, start, end)
        found = self.distance(point)
        time = tube.time[index] + 0.5 * (start + end) * np.diff(tube.time)[index]
        self._improve(flight, found + error, time, point)
        return self._settle(flight, found - radius, final=last | (radius - error <= 0.05 * error))

    def _improve(self, flight: np.ndarray, upper: np.ndarray, time: np.ndarray, position: np.ndarray) -> None:
        order = np.lexsort((upper, flight))
        flights, best = np.unique(flight[order], return_index=True)
        best = order[best]
        better = upper[best] < self.upper[flights]
        flights, best = flights[better], best[better]
        self.upper[flights] = upper[best]
        self.time[flights], self.position[flights] = time[best], position[best]

    def _settle(self, flight: np.ndarray, lower: np.ndarray, final: bool | np.ndarray = False) -> np.ndarray:
        settled = (lower >= self.upper[flight] - self.tolerance) | final
        np.minimum.at(self.lower, flight[settled], lower[settled])
        return ~settled


@kernel(inline="always")
def _length(x, y, z):
    return sqrt(x * x + y * y + z * z)


@kernel()
def bound_steps(step, slack, turned, position, velocity, acceleration, disturbance, rate, kappa, offset, range_limit):
    """Give residual (m/s²), speed (m/s) and whether gravity may be unbounded, of each flight and step: `Tube.of`."""
    flights, steps = position.shape[0], len(step)
    residual, speed = np.empty((flights, steps)), np.empty((flights, steps))
    beyond = np.empty((flights, steps), np.bool_)
    for i in range(flights):
        for k in range(steps):
            away = _length(position[i, k, 0], position[i, k, 1], position[i, k, 2])
            start = _length(velocity[i, k, 0], velocity[i, k, 1], velocity[i, k, 2])
            thrust = _length(acceleration[i, k, 0], acceleration[i, k, 1], acceleration[i, k, 2])
            radius, unknown = away + offset, disturbance + turned[k] * thrust
            fastest = (start + step[k] * (thrust + unknown + kappa * radius)) / slack[k]
            speed[i, k] = fastest
            residual[i, k] = unknown + 2.0 * rate * fastest + kappa * (radius + fastest * step[k])
            beyond[i, k] = away + fastest * step[k] > range_limit
    return residual, speed, beyond


@kernel()
def excess_of_steps(step, position, velocity, acceleration, residual, excursion):
    """Give by how much (m) each step's end is beyond what its start and the bounds allow: `Tube.inconsistency`."""
    flights, steps = residual.shape
    excess = np.empty((flights, steps))
    for i in range(flights):
        for k in range(steps):
            forwards = backwards = kick = 0.0
            for axis in range(3):
                before, after = velocity[i, k, axis], velocity[i, k + 1, axis]
                held = acceleration[i, k, axis] * step[k]
                moved = position[i, k + 1, axis] - position[i, k, axis]
                ahead = moved - (before + 0.5 * held) * step[k]
                back = moved - (after - 0.5 * held) * step[k]
                change = after - before - held
                forwards += ahead * ahead
                backwards += back * back
                kick += change * change
            allowed = 0.5 * residual[i, k] * (step[k] * step[k]) + excursion
            kicked = (sqrt(kick) - residual[i, k] * step[k]) * step[k]
            excess[i, k] = max(max(sqrt(forwards), sqrt(backwards)) - allowed, kicked)
    return excess


@kernel()
def bound_blocks(time, position, speed, flight, first, length):
    """Put a ball about each block of `length` steps from a sample `first` on.

    Returns its centre (m), the sample nearest to it and its distance, that of the furthest (m), and how far (m) the
    path can be from the nearer sample of a step: half the step's travel.
    """
    blocks, last = len(first), position.shape[1] - 1
    centre, nearest = np.empty((blocks, 3)), np.empty(blocks, np.int64)
    least, most, excess = np.empty(blocks), np.empty(blocks), np.empty(blocks)
    for b in range(blocks):
        i, begin, end = flight[b], first[b], min(first[b] + length, last)
        for axis in range(3):
            low = high = position[i, begin, axis]
            for k in range(begin + 1, end + 1):
                low, high = min(low, position[i, k, axis]), max(high, position[i, k, axis])
            centre[b, axis] = 0.5 * (low + high)
        least[b], most[b], excess[b] = np.inf, 0.0, 0.0
        for k in range(begin, end + 1):
            away = _length(
                position[i, k, 0] - centre[b, 0], position[i, k, 1] - centre[b, 1], position[i, k, 2] - centre[b, 2]
            )
            if away < least[b]:
                least[b], nearest[b] = away, k
            most[b] = max(most[b], away)
        for k in range(begin, end):
            excess[b] = max(excess[b], 0.5 * (time[k + 1] - time[k]) * speed[i, k])
    return centre, nearest, least, most, excess

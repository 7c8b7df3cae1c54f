"""Disturbance forces on the chaser as functions of time, in newtons, in the target's body axes, each with a bound."""

import abc
import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from keepout.core.errors import ScenarioError
from keepout.core.motion.arrays import NumbersLike, Scalar, Vector, as_float64

# Bounds are sums and roots of float64 numbers; this covers their rounding.
_OUTWARD = 1 + 1e-12

_AT_SWITCH = 1e-9
"""Within this part of a half period a time is a switch's own: control times carry rounding."""
_TERMS = 32
"""Sinusoids in every axis of a noise."""


class Disturbance(eqx.Module):
    """A force that the control law does not know.

    One that jumps says when (`switches`) and what it is between two jumps (`between_switches`), so that the motion can
    be integrated piece by piece. The defaults are those of a force without jumps.
    """

    @abc.abstractmethod
    def force(self, time: Scalar) -> Vector:
        """Force at `time` (s), N, in body axes; at a jump, and within rounding of one, the force after it.

        Args:
            time: s since the epoch.

        Returns:
            (3,) N.

        """

    def switches(self, start: Scalar, duration: float | Scalar) -> Float[Array, "switches"]:
        """Give the times after `start` (s) at which the force jumps.

        Args:
            start: of the stretch that is integrated, s.
            duration: its length, s, at most `longest_stretch`.

        Returns:
            Rising times since `start` in [0, duration], s, always as many; those without a jump are `duration`.

        """
        return jnp.zeros(0)

    def between_switches(self, middle: Scalar) -> "Disturbance":
        """Give the force without jumps that this one is between the two neighbouring jumps of the time `middle` (s).

        Args:
            middle: s since the epoch.

        """
        return self

    @property
    def longest_stretch(self) -> float:
        """The longest duration, s, in which `switches` finds every jump. Needs concrete values, as `bound` does."""
        return math.inf

    @property
    @abc.abstractmethod
    def bound(self) -> float:
        """A number, N, that the norm of the force never exceeds. Needs concrete values: not inside a transformation."""


class NoDisturbance(Disturbance):
    """Nothing pushes."""

    def force(self, time: Scalar) -> Vector:
        """Zero."""
        return jnp.zeros(3)

    @property
    def bound(self) -> float:
        """Zero."""
        return 0.0


class ConstantDisturbance(Disturbance):
    """A constant force (3,), N."""

    constant: Vector = eqx.field(converter=as_float64)

    def force(self, time: Scalar) -> Vector:
        """Constant."""
        return self.constant

    @property
    def bound(self) -> float:
        """Its norm."""
        return float(np.linalg.norm(self.constant)) * _OUTWARD


class SinusoidalDisturbance(Disturbance):
    """A sum of sinusoids in every axis: d_i(t) = Σ_k amplitude_ki sin(frequency_ki t + phase_ki).

    amplitude (N), frequency (rad/s) and phase (rad): (terms, 3).

    Raises:
        ScenarioError: arrays of other or different shapes.

    """

    amplitude: Float[Array, "terms 3"] = eqx.field(converter=as_float64)
    frequency: Float[Array, "terms 3"] = eqx.field(converter=as_float64)
    phase: Float[Array, "terms 3"] = eqx.field(converter=as_float64)

    def __check_init__(self):
        shape = self.amplitude.shape
        for name in ("amplitude", "frequency", "phase"):
            own = getattr(self, name).shape
            if own != shape or own[1:] != (3,):
                raise ScenarioError(f"{name}: shape {own}; amplitude, frequency and phase must all be (terms, 3)")

    def force(self, time: Scalar) -> Vector:
        """Sum of the terms at `time`."""
        return jnp.sum(self.amplitude * jnp.sin(self.frequency * time + self.phase), axis=0)

    def shifted(self, phase: float) -> "SinusoidalDisturbance":
        """Give the sum with `phase` (rad) added to that of every term; its exact bound is the same."""
        return dataclasses.replace(self, phase=np.asarray(self.phase) + phase)

    @property
    def bound(self) -> float:
        """The smaller of two bounds that hold for all time.

        One adds amplitudes in each axis. The other gathers the terms of one frequency ω into a 3 × 2 matrix M_ω, so
        that d = Σ_ω M_ω [sin ωt, cos ωt]ᵀ and ‖d‖² ≤ Σ_ω Σ_ω' ‖M_ωᵀ M_ω'‖₂; it sees that a sine and a cosine never peak
        together. A phase added to all terms turns every M_ω, M_ω R, and changes neither bound.
        """
        amplitude, frequency, phase = (np.asarray(a) for a in (self.amplitude, self.frequency, self.phase))
        per_axis = float(np.linalg.norm(np.sum(np.abs(amplitude), axis=0)))
        matrices = []
        for omega in np.unique(frequency):
            part = np.where(frequency == omega, amplitude, 0.0)
            matrices.append(np.stack([np.sum(part * np.cos(phase), axis=0), np.sum(part * np.sin(phase), axis=0)], 1))
        stacked = np.stack(matrices)
        products = np.einsum("aik,bil->abkl", stacked, stacked)
        grouped = float(np.sqrt(np.sum(np.linalg.norm(products, ord=2, axis=(2, 3)))))
        return min(per_axis, grouped) * _OUTWARD


class SquareWaveDisturbance(Disturbance):
    """Bang-bang force: ±`amplitude` (3,) N, changing sign every half `period` (s), positive just after `delay` (s).

    `most_switches`: how many changes of sign a stretch of integration may hold; each costs one more Runge–Kutta step.

    Raises:
        ScenarioError: a period that is not positive, or fewer than one change of sign.

    """

    amplitude: Vector = eqx.field(converter=as_float64)
    period: Scalar = eqx.field(converter=as_float64)
    delay: Scalar = eqx.field(converter=as_float64, default=0.0)
    most_switches: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not isinstance(self.period, Tracer) and not self.period > 0:
            raise ScenarioError(f"period: {float(self.period):g} s; it must be positive")
        if self.most_switches < 1:
            raise ScenarioError(f"most_switches: {self.most_switches}; it must be at least 1")

    def force(self, time: Scalar) -> Vector:
        """Plus or minus the amplitude."""
        return self._in_half_period(jnp.floor(2 * (time - self.delay) / self.period + _AT_SWITCH))

    def switches(self, start: Scalar, duration: float | Scalar) -> Float[Array, "switches"]:
        """Give the ends of half periods; not numbers where the stretch holds more of them than `most_switches`."""
        half = self.period / 2
        current = jnp.floor((start - self.delay) / half)
        after = (self.delay - start) + (current + jnp.arange(1, self.most_switches + 1)) * half
        # A start within rounding of a switch may count it as still to come; that one then takes no time.
        missed = self.most_switches * half < duration * (1 - _AT_SWITCH)
        return jnp.where(missed, jnp.nan, jnp.clip(after, 0.0, duration))

    def between_switches(self, middle: Scalar) -> Disturbance:
        """Give the constant force of the half period."""
        return ConstantDisturbance(self._in_half_period(jnp.floor(2 * (middle - self.delay) / self.period)))

    def shifted(self, phase: float) -> "SquareWaveDisturbance":
        """Give the wave that is `phase` (rad, 2π a period) ahead of this one."""
        return dataclasses.replace(self, delay=np.asarray(self.delay) - phase / (2.0 * np.pi) * np.asarray(self.period))

    def _in_half_period(self, number: Scalar) -> Vector:
        return self.amplitude * (1 - 2 * jnp.mod(number, 2))

    @property
    def bound(self) -> float:
        """The amplitude's norm."""
        return float(np.linalg.norm(self.amplitude)) * _OUTWARD

    @property
    def longest_stretch(self) -> float:
        """So many half periods."""
        return self.most_switches * float(self.period) / 2


class BandLimitedNoise(Disturbance):
    """A sum of sinusoids whose norm is cut off at `limit`: random-looking, smooth but for the cut, and bounded."""

    sinusoids: SinusoidalDisturbance
    limit: Scalar = eqx.field(converter=as_float64)

    def force(self, time: Scalar) -> Vector:
        """Sum at `time`, shortened to `limit` where it is longer."""
        raw = self.sinusoids.force(time)
        squared = raw @ raw
        excess = squared > self.limit**2
        return raw * jnp.where(excess, self.limit / jnp.sqrt(jnp.where(excess, squared, 1.0)), 1.0)

    def shifted(self, phase: float) -> "BandLimitedNoise":
        """Give the noise with `phase` (rad) added to that of every sinusoid."""
        return dataclasses.replace(self, sinusoids=self.sinusoids.shifted(phase))

    @property
    def bound(self) -> float:
        """The cut-off."""
        return float(self.limit) * _OUTWARD


class CombinedDisturbance(Disturbance):
    """Several disturbances at once."""

    parts: tuple[Disturbance, ...]

    def force(self, time: Scalar) -> Vector:
        """Sum of the parts."""
        return sum((part.force(time) for part in self.parts), jnp.zeros(3))

    def switches(self, start: Scalar, duration: float | Scalar) -> Float[Array, "switches"]:
        """Give the jumps of all parts."""
        return jnp.sort(jnp.concatenate([jnp.zeros(0), *(part.switches(start, duration) for part in self.parts)]))

    def between_switches(self, middle: Scalar) -> Disturbance:
        """Give the sum of what the parts are."""
        return CombinedDisturbance(tuple(part.between_switches(middle) for part in self.parts))

    @property
    def longest_stretch(self) -> float:
        """The shortest of the parts'."""
        return min((part.longest_stretch for part in self.parts), default=math.inf)

    @property
    def bound(self) -> float:
        """The sum of the parts' bounds."""
        return sum(part.bound for part in self.parts) * _OUTWARD


def paper_disturbance() -> SinusoidalDisturbance:
    """0.01 [sin 0.02t, cos 0.02t, sin 0.01t] N (paper, section VI)."""
    return SinusoidalDisturbance(
        amplitude=np.full((1, 3), 0.01),
        frequency=np.array([[0.02, 0.02, 0.01]]),
        phase=np.array([[0.0, np.pi / 2, 0.0]]),
    )


def steady(force: NumbersLike) -> SinusoidalDisturbance:
    """Give a constant force (3,), N, as one sinusoid of rate zero: it shares its compiled flights with the paper's."""
    return SinusoidalDisturbance(
        amplitude=np.asarray(force, float)[None], frequency=np.zeros((1, 3)), phase=np.full((1, 3), np.pi / 2)
    )


def resonant(amplitude: NumbersLike, control_period: float) -> SquareWaveDisturbance:
    """Square wave of ±`amplitude` (3,) N that changes sign with every control step.

    What a sampled observer measured over the last step is then the opposite of what acts over the next one.
    """
    if not control_period > 0:
        raise ScenarioError(f"control_period: {control_period:g} s; it must be positive")
    return SquareWaveDisturbance(amplitude, 2 * control_period)


def band_limited_noise(
    key: PRNGKeyArray, root_mean_square: float, limit: float, band: Sequence[float]
) -> BandLimitedNoise:
    """Noise with frequencies drawn evenly from `band` (two values, rad/s) and random phases, the same for the same key.

    root_mean_square: of the norm before the cut, N. limit: the cut of the norm, N.

    Raises:
        ScenarioError: a band that is empty or negative.

    """
    low, high = band
    if not 0 <= low < high:
        raise ScenarioError(f"band: [{low:g}, {high:g}] rad/s; it must rise from a value that is not negative")
    frequency_key, phase_key = jax.random.split(key)
    frequency = jax.random.uniform(frequency_key, (_TERMS, 3), minval=low, maxval=high, dtype=jnp.float64)
    phase = jax.random.uniform(phase_key, (_TERMS, 3), maxval=2 * np.pi, dtype=jnp.float64)
    amplitude = jnp.full((_TERMS, 3), root_mean_square * np.sqrt(2 / (3 * _TERMS)))
    return BandLimitedNoise(SinusoidalDisturbance(amplitude, frequency, phase), limit)

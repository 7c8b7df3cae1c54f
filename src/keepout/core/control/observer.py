"""Disturbance observers: the paper's continuous form, run exactly between samples, and a sampled form for on board.

The disturbance is modelled as ξ̇ = A ξ, d = C ξ (paper Eq. disturbance_model). The paper writes the gain function on
r; the equations only close with it on v, and so does this module.
"""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import linalg

from keepout.core.errors import ControlError
from keepout.core.motion.arrays import Scalar, Vector, as_float64

Memory = Float[Array, " q"]
"""What an observer remembers from step to step."""


class Observer(eqx.Module):
    """An estimator of the disturbance force from sampled velocities and the force held between them."""

    @abc.abstractmethod
    def initial_state(self, velocity: Vector) -> Memory:
        """Return the state that estimates no disturbance, at a velocity in m/s."""

    @abc.abstractmethod
    def update(self, state: Memory, before: Vector, after: Vector, drift: Vector, force: Vector) -> Memory:
        """Return the state a period later.

        `before` and `after` are the velocities (m/s) at the ends of the period, `drift` the mean acceleration
        without force and disturbance (m/s²), `force` what the thrusters held (N).
        """

    @abc.abstractmethod
    def estimate(self, state: Memory, velocity: Vector) -> Vector:
        """Return the disturbance now, N."""

    def mean_ahead(self, state: Memory, velocity: Vector) -> Vector:
        """Return the disturbance's mean over the period to come, N: what a held force cancels; by default that now."""
        return self.estimate(state, velocity)


class NoObserver(Observer):
    """Estimates no disturbance."""

    def initial_state(self, velocity: Vector) -> Memory:
        """Return an empty state."""
        return jnp.zeros(0)

    def update(self, state: Memory, before: Vector, after: Vector, drift: Vector, force: Vector) -> Memory:
        """Return the state unchanged."""
        return state

    def estimate(self, state: Memory, velocity: Vector) -> Vector:
        """Return zero."""
        return jnp.zeros(3)


class ContinuousObserver(Observer):
    """The paper's observer (Eq. disturbance_observer) with its misprints mended.

        ż = (A − L C/m) z + (A L − L C L/m) v − L (a_drift + F/m),   ξ̂ = z + L v,   d̂ = C ξ̂

    so that the error obeys ė_ξ = (A − L C/m) e_ξ. Between samples it is integrated exactly for a held force, a
    constant drift and a velocity that is linear in time. Build with `continuous`.
    """

    generator: Float[Array, "q q"]
    output: Float[Array, "3 q"]
    gain: Float[Array, "q 3"]
    mass: Scalar
    transition: Float[Array, "q q"]
    held: Float[Array, "q q"]
    ramp: Float[Array, "q q"]

    def error_matrix(self) -> Float[Array, "q q"]:
        """Return A − L C/m, whose eigenvalues (1/s) are the rates of convergence."""
        return self.generator - self.gain @ self.output / self.mass

    def initial_state(self, velocity: Vector) -> Memory:
        """Return z with ξ̂ = 0."""
        return -self.gain @ velocity

    def update(self, state: Memory, before: Vector, after: Vector, drift: Vector, force: Vector) -> Memory:
        """Return z a period later."""
        error = self.error_matrix()
        constant = error @ self.gain @ before - self.gain @ (drift + force / self.mass)
        return self.transition @ state + self.held @ constant + self.ramp @ (error @ self.gain @ (after - before))

    def estimate(self, state: Memory, velocity: Vector) -> Vector:
        """Return C (z + L v)."""
        return self.output @ (state + self.gain @ velocity)


def continuous(
    generator: Float[np.ndarray, "q q"],
    output: Float[np.ndarray, "3 q"],
    gain: Float[np.ndarray, "q 3"],
    *,
    mass: float,
    period: float,
) -> ContinuousObserver:
    """Build the paper's observer for A, C, L (N s/m), a mass in kg and a sampling period in s."""
    generator, output, gain = (np.asarray(x, dtype=float) for x in (generator, output, gain))
    q = generator.shape[0]
    error = generator - gain @ output / mass
    block = np.zeros((3 * q, 3 * q))
    block[:q, :q], block[:q, q : 2 * q] = error * period, np.eye(q) * period
    block[q : 2 * q, 2 * q :] = np.eye(q)
    whole = linalg.expm(block)
    arrays = (generator, output, gain, mass, whole[:q, :q], whole[:q, q : 2 * q], whole[:q, 2 * q :])
    return ContinuousObserver(*(as_float64(x) for x in arrays))


def printed_observer(*, mass: float, period: float) -> ContinuousObserver:
    """Build the observer with the matrices printed in the paper's section VI: A = C = I, L = 50 I (N s/m)."""
    one = np.eye(3)
    return continuous(one, one, 50.0 * one, mass=mass, period=period)


class SampledObserver(Observer):
    """An observer of the mean disturbance over each period: residual = m Δv/T − m·drift − F.

        ξ̂⁺ = Φ ξ̂ + K (residual − C̄ ξ̂),   Φ = exp(A T),   C̄ = (1/T) ∫₀ᵀ C exp(A t) dt

    Build with `constant_observer` or `harmonic_observer`.
    """

    transition: Float[Array, "q q"]
    mean_output: Float[Array, "3 q"]
    output: Float[Array, "3 q"]
    gain: Float[Array, "q 3"]
    mass: Scalar
    period: Scalar

    def error_matrix(self) -> Float[Array, "q q"]:
        """Return Φ − K C̄, whose eigenvalues are the error's factors a period."""
        return self.transition - self.gain @ self.mean_output

    def initial_state(self, velocity: Vector) -> Memory:
        """Return zero."""
        return jnp.zeros(self.transition.shape[0])

    def update(self, state: Memory, before: Vector, after: Vector, drift: Vector, force: Vector) -> Memory:
        """Return ξ̂ a period later."""
        residual = self.mass * ((after - before) / self.period - drift) - force
        return self.transition @ state + self.gain @ (residual - self.mean_output @ state)

    def estimate(self, state: Memory, velocity: Vector) -> Vector:
        """Return C ξ̂."""
        return self.output @ state

    def mean_ahead(self, state: Memory, velocity: Vector) -> Vector:
        """Return C̄ ξ̂."""
        return self.mean_output @ state


def constant_observer(*, mass: float, period: float) -> SampledObserver:
    """Build the sampled observer of a constant disturbance (A = 0): d̂ += 0.9 (residual − d̂)."""
    one = np.eye(3)
    return SampledObserver(*(as_float64(x) for x in (one, one, one, 0.9 * one, mass, period)))


PAPER_FREQUENCIES = (0.02, 0.01)
"""Of the paper's disturbance, rad/s."""


def harmonic_observer(
    frequencies: Sequence[float] = PAPER_FREQUENCIES,
    *,
    mass: float,
    period: float,
    factors: Sequence[float] | None = None,
) -> SampledObserver:
    """Build the sampled observer of a constant plus sinusoids of known frequencies (rad/s) along each axis.

    `factors` are the eigenvalues of the error per period, 1 + 2 × the number of frequencies, distinct and within the
    unit circle. By default one is 0.1, which catches a push at once, and the others lie between 0.8 and 0.92: they
    only sort the push into its parts.

    Raises:
        ControlError: a frequency that is not in (0, π/period) or that repeats, or factors of the wrong number or size.

    """
    omegas = [float(w) for w in frequencies]
    if len(set(omegas)) != len(omegas) or any(not 0.0 < w < np.pi / period for w in omegas):
        raise ControlError(
            f"observer frequencies: {omegas} rad/s; distinct values in (0, {np.pi / period:.3g}) are needed"
        )
    q = 1 + 2 * len(omegas)
    if factors is None:
        factors = [0.1, *np.linspace(0.8, 0.92, q - 1)]
    if len(factors) != q or any(not abs(f) < 1.0 for f in factors) or len(set(factors)) != q:
        raise ControlError(
            f"observer factors: {list(factors)}; {len(omegas)} frequencies need {q} distinct ones of modulus below 1"
        )
    generator = linalg.block_diag(np.zeros((1, 1)), *([[0.0, w], [-w, 0.0]] for w in omegas))
    output = np.array([[1.0, *([1.0, 0.0] * len(omegas))]])
    block = np.zeros((q + 1, q + 1))
    block[:q, :q] = generator.T * period
    block[:q, q:] = output.T * period
    whole = linalg.expm(block)
    transition, mean_output = whole[:q, :q].T, whole[:q, q:].T / period

    # Slow sinusoids are nearly alike over one period: in their own amplitudes the gain would have lost its digits. The
    # state is the mean push and its scaled differences instead, where the observability matrix is the identity.
    scale = max(omegas, default=1.0) * period
    difference = (transition - np.eye(q)) / scale
    rows = [mean_output]
    for _ in range(q - 1):
        rows.append(rows[-1] @ difference)
    basis = np.vstack(rows)
    roots = np.concatenate([[0.0], *(np.exp([1j * w * period, -1j * w * period]) - 1.0 for w in omegas)]) / scale
    companion = np.eye(q, k=1)
    companion[-1] = -np.poly(roots).real[:0:-1]
    gain = np.eye(q)[:, -1:]
    for factor in factors:
        gain = companion @ gain - (factor - 1.0) / scale * gain
    matrices = (np.eye(q) + scale * companion, np.eye(1, q), np.linalg.solve(basis.T, output.T).T, scale * gain)
    arrays = [as_float64(np.kron(np.eye(3), x)) for x in matrices]
    return SampledObserver(*arrays, mass=as_float64(mass), period=as_float64(period))

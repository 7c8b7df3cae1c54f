"""How far a drifting chaser can be from where it is expected: the growth of errors and of a push that nobody commanded.

Let δ be the difference of two motions, and η its rate as seen from inertial space, in body axes. Then

    |δ|' ≤ |η|,    |η|' ≤ γ |δ| + c |η| + a,

a bounding the push, γ the gradient of differential gravity and what perturbations add to it, c what drag adds: the
turning of the frame moves neither norm. The larger solution with equality bounds both (Müller's theorem). That grows
like a hyperbolic cosine. On a circular orbit without perturbations Hill's equations with their matrices Φ are exact but
for ε = the change of the gradient of gravity over the range, and

    |δ(t)| ≤ A(t) + ∫ ‖Φ_rv(t − s)‖ (a + ε |δ(s)|) ds,   so   sup |δ| ≤ (A + a K) / (1 − ε K),   K = ∫ ‖Φ_rv‖,

A being what the errors at the start grow to. It counts the turning where the first bound does not, and is the smaller
one from about a third of an orbit on. The smaller of the two is used.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from keepout.apps.inspection.hill import coast_matrix
from keepout.core.errors import InspectionError
from keepout.core.mission.bounds import perturbations
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER

_STEEPEST, _TURNING = 7.08, 12.4
"""Bounds of ‖Φ_vv‖ = ‖Φ_rv'‖ and, over n, of ‖Φ_vr‖ = ‖Φ_rr'‖, by the sums of their entries' squares."""
_CELLS = 2000
"""Of the integral K."""


@dataclass(frozen=True)
class Spread:
    """Bounds from which the growth follows; `Spread.of` takes them from a scenario.

    Attributes:
        push: largest acceleration that nobody commanded, m/s².
        gradient: γ, 1/s².
        per_speed: c, 1/s.
        frame_rate: largest inertial rate of the body frame, rad/s.
        range_limit: of the chaser from the target, m: within it the gradient holds.
        mean_motion: of a circular orbit without perturbations, rad/s; 0 for any other.

    """

    push: float
    gradient: float
    per_speed: float
    frame_rate: float
    range_limit: float
    mean_motion: float = 0.0

    @classmethod
    def of(cls, scenario: Scenario, push: float | None = None) -> "Spread":
        """Take the bounds from a scenario: its orbit, attitude, perturbations, and its disturbance or a push, N.

        Raises:
            InspectionError: a push that is negative or not a number.

        """
        if push is not None and not (math.isfinite(push) and push >= 0.0):
            raise InspectionError(f"passive safety: push is {push} N; it must be finite and at least 0")
        bounds, orbit = Surroundings(scenario).flight_bounds, scenario.orbit
        circular = orbit.eccentricity == 0.0 and not perturbations(scenario)
        return cls(
            push=(bounds.disturbance_force if push is None else push) / bounds.mass,
            gradient=bounds.gravity_gradient,
            per_speed=2.0 * bounds.angular_rate if scenario.drag.density > 0.0 else 0.0,
            frame_rate=bounds.angular_rate,
            range_limit=bounds.range_limit,
            mean_motion=math.sqrt(EARTH_GRAVITATIONAL_PARAMETER / orbit.semi_major_axis**3) if circular else 0.0,
        )

    def radius(
        self, times: Float[np.ndarray, " k"], *, position_error: float = 0.0, velocity_error: float = 0.0
    ) -> Float[np.ndarray, " k"]:
        """Bound how far the chaser is from its nominal drift, m, at times (s, from 0 on, ascending) after the start.

        Args:
            times: since the thrust stopped.
            position_error: of the state that the nominal drift starts from, in norm, m.
            velocity_error: likewise, in the body frame, m/s.

        Raises:
            InspectionError: an error that is negative or not a number.

        """
        for name, value in (("position_error", position_error), ("velocity_error", velocity_error)):
            if not (math.isfinite(value) and value >= 0.0):
                raise InspectionError(f"passive safety: {name} is {value}; it must be finite and at least 0")
        found = self._by_norms(times, position_error, velocity_error + self.frame_rate * position_error)
        if self.mean_motion:
            faster = velocity_error + (self.frame_rate + self.mean_motion) * position_error
            found = np.minimum(found, self._by_hill(times, position_error, faster))
        return np.maximum.accumulate(found)

    def _by_norms(self, times: Float[np.ndarray, " k"], apart: float, faster: float) -> Float[np.ndarray, " k"]:
        """Solve u' = w, w' = γ u + c w + a from (apart, faster)."""
        half = 0.5 * self.per_speed
        root = math.sqrt(half * half + self.gradient)
        if root * float(np.max(times, initial=0.0)) < 1e-6:
            return apart + faster * times + 0.5 * (1.0 + 1e-5) * self.push * times**2
        up, down = half + root, half - root
        with np.errstate(over="ignore"):
            quick, slow = np.exp(up * times), np.exp(down * times)
            answer = (quick - slow) / (up - down)
            own = (up * slow - down * quick) / (up - down)
            summed = (np.expm1(up * times) / up - self._slow_sum(down, times)) / (up - down)
        return apart * own + faster * answer + self.push * summed

    @staticmethod
    def _slow_sum(down: float, times: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        return times if down == 0.0 else np.expm1(down * times) / down

    def _by_hill(self, times: Float[np.ndarray, " k"], apart: float, faster: float) -> Float[np.ndarray, " k"]:
        last = float(np.max(times, initial=0.0))
        if last == 0.0:
            return np.full(len(times), apart)
        n, cell = self.mean_motion, last / _CELLS
        grid = np.linspace(0.0, last, _CELLS + 1)
        whole = coast_matrix(n, grid)
        answer = np.linalg.norm(whole[:, :3, 3:], ord=2, axis=(1, 2))
        own = np.linalg.norm(whole[:, :3, :3], ord=2, axis=(1, 2))
        most = np.maximum(answer[:-1], answer[1:]) + 0.5 * _STEEPEST * cell
        kernel = np.concatenate([[0.0], np.cumsum(most) * cell])
        start = np.maximum.accumulate(own + 0.5 * _TURNING * n * cell) * apart
        start[1:] += np.maximum.accumulate(most) * faster
        radius = (EARTH_GRAVITATIONAL_PARAMETER / n**2) ** (1.0 / 3.0) - self.range_limit
        changed = 6.0 * EARTH_GRAVITATIONAL_PARAMETER / radius**4 * self.range_limit
        left = 1.0 - changed * kernel
        bound = np.where(left > 0.0, (start + self.push * kernel) / np.maximum(left, 1e-300), np.inf)
        return bound[np.minimum(np.ceil(times / cell).astype(int), _CELLS)]

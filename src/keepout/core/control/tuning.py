"""Gains from what the chaser can do: mass, thrust, sampling, disturbance and the speed wished for."""

from dataclasses import dataclass

import numpy as np

from keepout.core.control.operation import Operation
from keepout.core.errors import ControlError


@dataclass(frozen=True)
class Tuning:
    """Gains of the default law.

    authority a_b (m/s²): acceleration left after disturbance and drift. braking a_c (m/s²): deceleration that the
    class-K function asks for. class_k_rate α₀, tracking_gain λ, estimation_rate β_e, barrier_rate β_c: 1/s.
    barrier_ratio μ_h: m/s². lyapunov_ratio μ_v: 1/s². estimation_weight β: m/N². slowing_length k_p, speed_reserve,
    nominal_offset: m. speed_limit (m/s) is the one asked for; honoured_speed (m/s) is the largest one from which the
    thrusters can stop within the stopping distance.
    """

    authority: float
    braking: float
    class_k_rate: float
    tracking_gain: float
    estimation_rate: float
    barrier_rate: float
    barrier_ratio: float
    lyapunov_ratio: float
    estimation_weight: float
    slowing_length: float
    speed_reserve: float
    nominal_offset: float
    observer_gain: float
    sharpness: float
    speed_limit: float
    honoured_speed: float


def least_offset(speed_limit: float, period: float) -> float:
    """Give what the default law keeps beyond the keep-out zone, m: room for sampling, 1.2 periods of flight."""
    return max(0.12, 1.2 * speed_limit * period)


def tune(operation: Operation, *, drift_bound: float = 0.0, stopping_distance: float = 3.0) -> Tuning:
    """Compute the default law's gains, and say which speed the thrusters can honour.

    Args:
        operation: the chaser, the control period and the disturbance bound.
        drift_bound: largest drift acceleration on the way, m/s².
        stopping_distance: within which the chaser must be able to stop from its speed limit, m.

    For the paper's case (20 kg, 0.1 N, 1 Hz, 0.1 m/s) λ = 1/s, a_b = 4 mm/s², a_c = 2 mm/s², α₀ = 0.08/s.

    Raises:
        ControlError: a period that is not positive, disturbance and drift leave no authority, or the speed limit
            cannot be honoured.

    """
    chaser, period, disturbance_bound = operation.chaser, operation.period, operation.disturbance_bound
    mass, force_limit, speed_limit = chaser.mass, chaser.force_limit, chaser.speed_limit
    if not (np.isfinite(period) and period > 0.0):
        raise ControlError(f"period: {period} s; it must be positive and finite")
    authority = (force_limit - disturbance_bound) / mass - drift_bound
    if not authority > 0.0:
        raise ControlError(
            f"authority: disturbance ({disturbance_bound:.3g} N) and drift ({mass * drift_bound:.3g} N) use up "
            f"the thrust of {force_limit:.3g} N; a larger force_limit, a lower speed or a slower turn would leave some"
        )
    honoured = float(np.sqrt(2.0 * authority * stopping_distance))
    if speed_limit > honoured:
        raise ControlError(
            f"speed_limit: {speed_limit:.3g} m/s cannot be stopped within {stopping_distance:.3g} m with "
            f"{authority:.3g} m/s2; at most {honoured:.3g} m/s"
        )
    gain = 1.0 / period
    observer_gain = 0.9
    return Tuning(
        authority=authority,
        braking=0.5 * authority,
        class_k_rate=min(0.08, 0.08 / period),
        tracking_gain=gain,
        estimation_rate=float(-np.log(1.0 - observer_gain)) / period,
        barrier_rate=0.5 * gain,
        barrier_ratio=2.0 * authority,
        lyapunov_ratio=1e-6,
        estimation_weight=10.0,
        slowing_length=max(1.5, 0.77 * speed_limit**2 / authority),
        speed_reserve=0.1,
        nominal_offset=least_offset(speed_limit, period),
        observer_gain=observer_gain,
        # At full velocity error and 0.1 m of barrier the filter's exponential is exp(-20): it acts only where it must.
        sharpness=20.0 * (speed_limit / (2.0 * mass * authority)) ** 2 / (0.05 * gain),
        speed_limit=speed_limit,
        honoured_speed=honoured,
    )

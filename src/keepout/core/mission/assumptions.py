"""What the guard's theorem assumes of a scenario, as numbers to show, and where the scenario flies beyond it."""

import math
from typing import Any

from keepout.core.geometry.target import Target
from keepout.core.guard import watch
from keepout.core.guard.guard import Guard
from keepout.core.mission import environment
from keepout.core.mission.scenario import Scenario
from keepout.core.plug_ins import load

_ROUNDING = 1e-9
"""Relative: a bound declared is not broken by the rounding of the flown one."""


def broken_assumptions(scenario: Scenario, target: Target | None = None) -> tuple[str, ...]:
    """Name what the scenario flies beyond what it declares to the guard, each with its numbers; () where nothing is.

    A target that is the skin of a map brings along what was broken when that map was made.

    A broken control law is none of it: the theorem holds whatever is commanded. Sufficient for the theorem, not
    necessary: that needs the sum D only, and one part may use what another leaves.
    """
    guard, faults = scenario.guard, scenario.faults
    found: list[str] = []

    def compare(flown_name: str, flown: float, declared_name: str, declared: float, unit: str) -> None:
        if flown > declared * (1.0 + _ROUNDING):
            found.append(f"{flown_name} {flown:.6g}{unit} > {declared_name} {declared:.6g}{unit}")

    compare(
        "disturbance: flown up to",
        environment.largest_disturbance(scenario),
        "disturbance.bound",
        environment.disturbance_bound(scenario),
        " N",
    )
    for kind, unit in (("position", " m"), ("velocity", " m/s")):
        flown = getattr(faults, f"{kind}_bias") + getattr(faults, f"{kind}_noise")
        declared = getattr(guard, f"{kind}_error")
        compare(f"faults.{kind}_bias + faults.{kind}_noise", flown, f"guard.{kind}_error", declared, unit)
        spread = getattr(faults, f"{kind}_noise_std")
        if spread:
            found.append(f"faults.{kind}_noise_std {spread:.6g}{unit} > 0 (Gaussian noise has no bound)")
    compare("faults.gain_error", faults.gain_error, "guard.gain_error", guard.gain_error, "")
    if faults.delay != guard.delay:
        found.append(f"faults.delay {faults.delay} != guard.delay {guard.delay} (the delay assumed is exact)")
    if faults.dropped:
        found.append(f"faults.dropped {faults.dropped:.6g} > 0 (no command may be lost)")
    if faults.stuck is not None and faults.stuck_from < scenario.duration:
        found.append(
            f"faults.stuck {faults.stuck} at {faults.stuck_force:.6g} N from {faults.stuck_from:.6g} s "
            "(no thruster may be stuck)"
        )
    if faults.thruster is not None and faults.stuck_from < scenario.duration and not scenario.thrusters.survive_failure:
        found.append(
            f"faults.thruster {faults.thruster} stuck {faults.thruster_stuck} from {faults.stuck_from:.6g} s "
            "(thrusters.survive_failure is false: no thruster may be stuck)"
        )
    if scenario.navigation.suite != "none":
        missed = load("navigation", "suite")(scenario.navigation).probability_beyond(scenario.steps)
        if missed:
            found.append(
                f"navigation.suite {scenario.navigation.suite}: Gaussian noise has no bound (the guard's set "
                f"misses the truth with a probability per flight of at most {missed:.3g})"
            )
    return (*found, *(() if target is None else target.broken))


def guard_numbers(guard: Guard, scenario: Scenario) -> dict[str, Any]:
    """Give what a scenario's guard assumes and what follows (docs/guard.md) as plain numbers for JSON, SI units."""
    a, b = guard.assumptions, guard.braking
    longest = watch.windows(a)[-1]
    least = watch.SHARE * float(a.disturbance)
    numbers = {
        "disturbance_force_N": a.disturbance_force,
        "angular_rate_radps": a.angular_rate,
        "angular_acceleration_radps2": a.angular_acceleration,
        "gravity_gradient_per_s2": a.gravity_gradient,
        "origin_offset_m": a.origin_offset,
        "range_limit_m": a.range_limit,
        "speed_limit_mps": a.speed_limit,
        "position_error_m": a.position_error,
        "velocity_error_mps": a.velocity_error,
        "mass_error": a.mass_error,
        "gain_error": a.gain_error,
        "delay": a.delay,
        "force_error_N": a.force_error,
        "excursion_m": a.excursion,
        "velocity_excursion_mps": a.velocity_excursion,
        "fault_force_N": a.fault_force,
        "fault_steps": a.fault_steps,
        "turning_error": a.turning_error,
        "valid_until_s": a.valid_until if math.isfinite(a.valid_until) else None,
        "disturbance_D_mps2": a.disturbance,
        "deceleration_a_b_mps2": b.deceleration,
        "reserve_U_mps2": b.reserve,
        "position_radius_rho_m": b.position_radius,
        "velocity_radius_sigma_mps": b.velocity_radius,
        "margin_kept_m": environment.kept_margin(scenario),
        "threshold_theta_m": guard.threshold,
        "lipschitz_L": guard.lipschitz,
        "evaluation_error_j_m": guard.evaluation_error,
        "watched_steps": longest,
        "lasting_excess_mps2": least,
        "lasting_excess_seen_steps": watch.seen_within(a, least),
    }
    return {
        name: number if number is None or isinstance(number, int) else float(number) for name, number in numbers.items()
    }

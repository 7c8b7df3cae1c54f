"""A scenario's surroundings: orbit, the target's turning, disturbance, thrusters, and bounds on all of them."""

import math
from dataclasses import replace

import jax
import numpy as np

from keepout.core.audit.tube import FlightBounds
from keepout.core.errors import ScenarioError
from keepout.core.flight.faults import (
    CombinedFaults,
    DelayedCommands,
    DroppedCommands,
    GaussianEstimate,
    StuckThruster,
    ThrusterGain,
    WrongEstimate,
)
from keepout.core.flight.setup import Faults, NoFaults
from keepout.core.geometry.target import Target
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.mission import turning_bounds
from keepout.core.mission.first_look import refuse_disturbance
from keepout.core.mission.orbit_bounds import (
    DifferentialBounds,
    differential_bounds,
    orbit_bounds,
    orbit_of,
    perturbations,
)
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.thrusters import errors
from keepout.core.motion.attitude import InertiallyFixed, Tumbling, VVLHFixed
from keepout.core.motion.chaser import Chaser
from keepout.core.motion.disturbance import (
    Disturbance,
    NoDisturbance,
    SquareWaveDisturbance,
    band_limited_noise,
    paper_disturbance,
    resonant,
    steady,
)
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER
from keepout.core.motion.relative import RelativeMotion
from keepout.core.plug_ins import load

_NEAR = 1000.0
"""Gravity is bounded at least this far from the target, m."""
_FARTHEST = 100_000.0
"""Gravity is bounded at most this far from the target's centre of mass, m."""
_FAST = 100.0
"""Differential drag is bounded at least up to this relative speed, m/s."""
_DIAGONAL = np.full(3, 1.0 / math.sqrt(3.0))

_BANG_BANG_PERIOD = 100.0
"""Of the bang-bang disturbance, s."""

RANDOM_BAND = (0.001, 0.3)
"""Frequencies of the random disturbance, rad/s."""


def relative_motion(scenario: Scenario) -> RelativeMotion:
    """Build the relative dynamics of the scenario's orbit and attitude."""
    attitude = scenario.attitude
    if attitude.kind == "tumbling":
        turning = Tumbling(
            angular_velocity=np.asarray(attitude.angular_velocity),
            inertia=np.asarray(attitude.inertia),
            gravity_gradient=attitude.gravity_gradient,
        )
    elif attitude.kind == "inertial":
        turning = InertiallyFixed()
    else:
        turning = VVLHFixed()
    return RelativeMotion(
        orbit_of(scenario.orbit),
        turning,
        perturbations(scenario),
        centre_of_mass=np.asarray(scenario.target.centre_of_mass),
        held_inertially=scenario.thrusters.held_in == "inertial",
    )


def disturbance(scenario: Scenario) -> Disturbance:
    """Build the force that nobody commanded (body axes, N)."""
    return _disturbance(scenario, scenario.disturbance.phase)


def _disturbance(scenario: Scenario, phase: float) -> Disturbance:
    entry = scenario.disturbance
    amplitude = 0.0 if entry.amplitude is None else entry.amplitude
    match entry.kind:
        case "none":
            return NoDisturbance()
        case "paper":
            return paper_disturbance().shifted(phase)
        case "constant":
            return steady(np.asarray(entry.force))
        case "bang-bang":
            most_switches = math.ceil(scenario.control.period / (0.5 * _BANG_BANG_PERIOD))
            wave = SquareWaveDisturbance(amplitude * _DIAGONAL, _BANG_BANG_PERIOD, most_switches=most_switches)
            return wave.shifted(phase)
        case "resonant":
            return resonant(amplitude * _DIAGONAL, scenario.control.period).shifted(phase)
        case "random":
            key = jax.random.fold_in(jax.random.key(scenario.seed), 1)
            return band_limited_noise(key, 0.5 * amplitude, amplitude, RANDOM_BAND).shifted(phase)


def largest_disturbance(scenario: Scenario) -> float:
    """Bound the norm of the true disturbance, N, whatever its phase.

    No phase changes a bound but by rounding (`SinusoidalDisturbance.bound`); that of phase 0 stands for all, so that
    laws and guards of flights that differ in the phase alone are equal to the last bit.
    """
    return _disturbance(scenario, 0.0).bound


def disturbance_bound(scenario: Scenario) -> float:
    """Give the largest disturbance norm (N) that law and guard assume.

    Raises:
        ScenarioError: the thrusters cannot hold against it.

    """
    true_bound = largest_disturbance(scenario)
    bound = true_bound if scenario.disturbance.bound is None else scenario.disturbance.bound
    refuse_disturbance(bound, scenario.chaser.force_limit)
    return bound


def chaser(scenario: Scenario) -> Chaser:
    """Give the chaser's body: mass, radius, thrusters and speed limit."""
    return Chaser(**scenario.chaser.model_dump())


def faults(scenario: Scenario) -> Faults:
    """Build what stands between truth and law, in the order in which a command passes it."""
    entry = scenario.faults
    parts: list[Faults] = []
    if entry.position_bias or entry.velocity_bias or entry.position_noise or entry.velocity_noise:
        parts.append(
            WrongEstimate(entry.position_bias, entry.velocity_bias, entry.position_noise, entry.velocity_noise)
        )
    if entry.position_noise_std or entry.velocity_noise_std:
        parts.append(GaussianEstimate(entry.position_noise_std, entry.velocity_noise_std, noise_memory(scenario)))
    if entry.dropped:
        parts.append(DroppedCommands(entry.dropped))
    if entry.delay:
        parts.append(DelayedCommands(entry.delay))
    if entry.gain_error:
        parts.append(ThrusterGain(entry.gain_error))
    if entry.stuck is not None:
        sign, axis = (1 if entry.stuck[0] == "+" else -1), "xyz".index(entry.stuck[1])
        parts.append(StuckThruster(axis, sign, entry.stuck_force, start=entry.stuck_from))
    return CombinedFaults(tuple(parts)) if parts else NoFaults()


def noise_memory(scenario: Scenario) -> float:
    """Give the share of a Gaussian error of the estimate that is left a period later."""
    lasting = scenario.faults.noise_correlation_time
    return math.exp(-scenario.control.period / lasting) if lasting else 0.0


def kept_margin(scenario: Scenario) -> float:
    """Give what the guard keeps beyond contact, m: the operator's margin, or nothing."""
    return scenario.safety.margin if scenario.guard.keeps_margin else 0.0


def flight_bounds(scenario: Scenario) -> FlightBounds:
    """Bound what a flight's record does not hold, for the audit: true disturbance, rotation, differential gravity.

    Differential gravity is bounded within a range that holds every start and the goal twice over, and 1000 m at least.
    Of what perturbations add, the constant is part of the force, and half of what grows with speed of the rate. Drag is
    bounded up to the speed that the guard allows, and 100 m/s at least.

    Raises:
        ScenarioError: start, goal or campaign are too far away for any bound, or the orbit has none.

    """
    region = _region(scenario, _furthest(scenario))
    rate, acceleration = _rotation(scenario)
    differential = _differential(scenario, region)
    return FlightBounds(
        mass=scenario.chaser.mass,
        disturbance_force=largest_disturbance(scenario) + scenario.chaser.mass * differential.constant,
        angular_rate=rate + 0.5 * differential.per_speed,
        angular_acceleration=acceleration,
        gravity_gradient=differential.gradient,
        origin_offset=_origin_offset(scenario),
        range_limit=region,
        excursion=(pulsed := errors(scenario)).excursion,
        velocity_excursion=pulsed.velocity_excursion,
        speed_limit=_fastest(scenario) if scenario.drag.density > 0.0 else math.inf,
        valid_until=_valid_until(scenario),
        force_turning=_force_turning(scenario),
    )


def require_bounded(scenario: Scenario, away: dict[str, float]) -> None:
    """Refuse entries that say that the chaser flies farther from the origin than gravity is bounded.

    Args:
        scenario: its target's centre of mass.
        away: of each entry, by its name, the distance from the body frame's origin, m.

    Raises:
        ScenarioError: the message names the entry that is farthest.

    """
    _region(scenario, away)


def _rotation(scenario: Scenario) -> tuple[float, float]:
    """Bound the body frame's inertial rate, rad/s, and its derivative, rad/s².

    Raises:
        ScenarioError: a body that turns too fast for a bound between two control periods.

    """
    outward = 1.0 + 1e-9
    if scenario.attitude.kind == "inertial":
        return 0.0, 0.0
    if scenario.attitude.kind == "tumbling":
        if scenario.attitude.gravity_gradient:
            rate, acceleration = turning_bounds.pulled(
                relative_motion(scenario),
                period=scenario.control.period,
                steps=scenario.steps,
                lowest_radius=orbit_bounds(scenario).lowest_radius,
            )
            if not math.isfinite(rate):
                raise ScenarioError(
                    f"attitude.angular_velocity: {list(scenario.attitude.angular_velocity)} rad/s; with "
                    f"gravity_gradient the body must turn less within a control period of {scenario.control.period:g} s"
                )
            return rate, acceleration
        inertia, omega = np.asarray(scenario.attitude.inertia), np.asarray(scenario.attitude.angular_velocity)
        rate, acceleration = turning_bounds.free(omega, inertia)
        return rate * outward, acceleration * outward
    orbit = orbit_bounds(scenario)
    return orbit.rate * outward, orbit.acceleration * outward


def _force_turning(scenario: Scenario) -> float:
    """Bound how fast the axes in which a force is held turn against the body frame, rad/s."""
    return _rotation(scenario)[0] if scenario.thrusters.held_in == "inertial" else 0.0


def _valid_until(scenario: Scenario) -> float:
    """Give the time, s since the epoch, until which orbit and rotation are bounded; infinite where they always are."""
    until = orbit_bounds(scenario).valid_until
    if scenario.attitude.gravity_gradient:
        until = min(until, turning_bounds.valid_until(scenario.control.period, scenario.steps))
    return until


def _origin_offset(scenario: Scenario) -> float:
    """Distance of the body frame's origin from the target's centre of mass, m."""
    return float(np.linalg.norm(scenario.target.centre_of_mass))


def _furthest(scenario: Scenario) -> dict[str, float]:
    """Give the distance from the origin, m, of each entry that says where the chaser flies."""
    corner = np.maximum(np.abs(scenario.campaign.lower), np.abs(scenario.campaign.upper))
    return {
        "start.position": float(np.linalg.norm(scenario.start.position)),
        "goal.position": float(np.linalg.norm(scenario.goal.position)),
        "campaign": float(np.linalg.norm(corner)),
    }


def _region(scenario: Scenario, away: dict[str, float]) -> float:
    """Give the range, m, within which gravity is bounded: twice the furthest of `away` plus 20 m, at least 1000 m.

    Raises:
        ScenarioError: that and the centre of mass's offset go beyond `_FARTHEST`.

    """
    entry = max(away, key=lambda name: away[name])
    offset = _origin_offset(scenario)
    region = max(_NEAR, 2.0 * away[entry] + 20.0)
    if region + offset > _FARTHEST:
        name, value = ("target.centre_of_mass", offset) if offset > away[entry] else (entry, away[entry])
        raise ScenarioError(
            f"{name}: {value:.6g} m from the body frame's origin; gravity is bounded within {_FARTHEST:g} m of the "
            f"target's centre of mass, and twice the distance flown plus 20 m must lie within that"
        )
    return region


def _differential(scenario: Scenario, region: float) -> DifferentialBounds:
    """Bound what gravity and perturbations do to chaser and target differently, for a chaser within `region` m.

    The least r from the Earth's centre to any point between target and chaser is the lowest radius less their distance;
    the gradient of a point mass's gravity is at most 2 μ / r³.
    """
    orbit = orbit_bounds(scenario)
    nearest = orbit.lowest_radius - max(_NEAR, region + _origin_offset(scenario))
    rate, fastest = _rotation(scenario)[0], _fastest(scenario)
    bent = differential_bounds(scenario, orbit, nearest=nearest, angular_rate=rate, fastest=fastest)
    return replace(bent, gradient=2.0 * EARTH_GRAVITATIONAL_PARAMETER / nearest**3 + bent.gradient)


def _allowed_speed(scenario: Scenario) -> float:
    """V̄: the speed, m/s, up to which the guard lets the chaser fly."""
    return 1.5 * scenario.chaser.speed_limit


def _fastest(scenario: Scenario) -> float:
    """Give the relative speed, m/s, up to which drag is bounded."""
    return max(_FAST, _allowed_speed(scenario))


def guard_assumptions(scenario: Scenario, target: Target) -> GuardAssumptions:
    """Gather what the guard's theorem assumes of a scenario; every number is the scenario's or derived from it.

    The drift is bounded inside a range of twice the furthest of start, goal and target plus 20 m, and up to one and a
    half times the speed limit; the guard flags a flight that leaves that region.

    Raises:
        ScenarioError: start, goal or target reach too far for gravity to be bounded.

    """
    return guard_assumptions_within(scenario, float(np.linalg.norm(target.vertices, axis=1).max()))


def guard_assumptions_within(scenario: Scenario, extent: float) -> GuardAssumptions:
    """Gather the same where no mesh is known: of the target, only how far it reaches from the body frame's origin, m.

    Raises:
        ScenarioError: start, goal or target reach too far for gravity to be bounded.

    """
    away = {name: value for name, value in _furthest(scenario).items() if name != "campaign"}
    away["target"] = extent
    region = _region(scenario, away)
    rate, acceleration = _rotation(scenario)
    differential = _differential(scenario, region)
    entry = scenario.guard
    thrust = errors(scenario).times_gain(entry.gain_error)
    assumed = GuardAssumptions(
        mass=scenario.chaser.mass,
        force_limit=scenario.chaser.force_limit,
        period=scenario.control.period,
        disturbance_force=disturbance_bound(scenario) + scenario.chaser.mass * differential.constant,
        angular_rate=rate + 0.5 * differential.per_speed,
        angular_acceleration=acceleration,
        gravity_gradient=differential.gradient,
        range_limit=2.0 * max(away.values()) + 20.0,
        speed_limit=_allowed_speed(scenario),
        position_error=entry.position_error,
        velocity_error=entry.velocity_error,
        mass_error=entry.mass_error,
        gain_error=thrust.gain_error,
        delay=entry.delay,
        origin_offset=_origin_offset(scenario),
        force_error=thrust.force_error,
        excursion=thrust.excursion,
        velocity_excursion=thrust.velocity_excursion,
        fault_force=thrust.fault_force,
        fault_steps=thrust.fault_steps,
        turning_error=2.0 * math.sin(0.5 * min(_force_turning(scenario) * scenario.control.period, math.pi)),
        valid_until=_valid_until(scenario),
    )
    if scenario.navigation.suite == "none":
        return assumed
    position_error, velocity_error = load("navigation", "certain")(scenario, assumed).errors
    return replace(assumed, position_error=position_error, velocity_error=velocity_error)

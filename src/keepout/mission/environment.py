"""A scenario's surroundings: orbit, the target's turning, disturbance, thrusters, and bounds on all of them."""

import math

import jax
import numpy as np

from keepout.audit.tube import FlightBounds
from keepout.errors import ScenarioError
from keepout.flight.faults import (
    CombinedFaults,
    DelayedCommands,
    DroppedCommands,
    StuckThruster,
    ThrusterGain,
    WrongEstimate,
)
from keepout.flight.setup import Faults, NoFaults
from keepout.geometry.target import Target
from keepout.guard.braking import GuardAssumptions
from keepout.mission.orbit_bounds import differential_bounds, orbit_bounds, orbit_of, perturbations
from keepout.mission.scenario import Scenario
from keepout.motion import (
    ConstantDisturbance,
    Disturbance,
    InertiallyFixed,
    NoDisturbance,
    RelativeMotion,
    SquareWaveDisturbance,
    Thrusters,
    Tumbling,
    VVLHFixed,
    band_limited_noise,
    paper_disturbance,
    resonant,
)
from keepout.motion.perturbation import EARTH_GRAVITATIONAL_PARAMETER

_DIAGONAL = np.full(3, 1.0 / math.sqrt(3.0))

_BANG_BANG_PERIOD = 100.0
"""Of the bang-bang disturbance, s."""


def relative_motion(scenario: Scenario) -> RelativeMotion:
    """Build the relative dynamics of the scenario's orbit and attitude."""
    attitude = scenario.attitude
    if attitude.kind == "tumbling":
        turning = Tumbling(angular_velocity=np.asarray(attitude.angular_velocity), inertia=np.asarray(attitude.inertia))
    elif attitude.kind == "inertial":
        turning = InertiallyFixed()
    else:
        turning = VVLHFixed()
    return RelativeMotion(orbit_of(scenario.orbit), turning, perturbations(scenario))


def disturbance(scenario: Scenario) -> Disturbance:
    """Build the force that nobody commanded (body axes, N)."""
    entry = scenario.disturbance
    amplitude = 0.0 if entry.amplitude is None else entry.amplitude
    match entry.kind:
        case "none":
            return NoDisturbance()
        case "paper":
            return paper_disturbance()
        case "constant":
            return ConstantDisturbance(np.asarray(entry.force))
        case "bang-bang":
            most_switches = math.ceil(scenario.control.period / (0.5 * _BANG_BANG_PERIOD))
            return SquareWaveDisturbance(amplitude * _DIAGONAL, _BANG_BANG_PERIOD, most_switches=most_switches)
        case "resonant":
            return resonant(amplitude * _DIAGONAL, scenario.control.period)
        case "random":
            key = jax.random.fold_in(jax.random.key(scenario.seed), 1)
            return band_limited_noise(key, 0.5 * amplitude, amplitude, (0.001, 0.3))


def disturbance_bound(scenario: Scenario) -> float:
    """Give the largest disturbance norm (N) that law and guard assume.

    Raises:
        ScenarioError: the thrusters cannot hold against it.

    """
    true_bound = disturbance(scenario).bound
    bound = true_bound if scenario.disturbance.bound is None else scenario.disturbance.bound
    if bound >= scenario.chaser.force_limit:
        raise ScenarioError(
            f"disturbance: its bound, {bound:.4g} N, is not below chaser.force_limit, {scenario.chaser.force_limit} N; "
            "no law can hold the chaser"
        )
    return bound


def thrusters(scenario: Scenario) -> Thrusters:
    """Build the chaser's thrusters."""
    return Thrusters(scenario.chaser.force_limit)


def faults(scenario: Scenario) -> Faults:
    """Build what stands between truth and law, in the order in which a command passes it."""
    entry = scenario.faults
    parts: list[Faults] = []
    if entry.position_bias or entry.velocity_bias or entry.position_noise or entry.velocity_noise:
        parts.append(
            WrongEstimate(entry.position_bias, entry.velocity_bias, entry.position_noise, entry.velocity_noise)
        )
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


def flight_bounds(scenario: Scenario) -> FlightBounds:
    """Bound what a flight's record does not hold, for the audit: true disturbance, rotation, differential gravity.

    What perturbations add is part of the force (differential drag), the gravity gradient and the angular rate.
    """
    orbit = orbit_bounds(scenario)
    rate, acceleration = orbit.rate, orbit.acceleration
    if scenario.attitude.kind == "inertial":
        rate, acceleration = 0.0, 0.0
    elif scenario.attitude.kind == "tumbling":
        # Torque-free: energy and momentum are kept, so ‖ω‖² ≤ 2E/I_min and ‖ω̇‖ ≤ ‖L‖‖ω‖/I_min.
        inertia = np.asarray(scenario.attitude.inertia)
        omega = np.asarray(scenario.attitude.angular_velocity)
        least = float(np.linalg.eigvalsh(inertia)[0])
        rate = math.sqrt(max(omega @ inertia @ omega, 0.0) / least)
        acceleration = float(np.linalg.norm(inertia @ omega)) * rate / least
    # Differential gravity between target and chaser, whose own radius may be less than perigee by the flown region.
    nearest = orbit.lowest_radius - 1000.0
    outward = 1.0 + 1e-9
    bent = differential_bounds(scenario, orbit, nearest=nearest, angular_rate=rate)
    return FlightBounds(
        mass=scenario.chaser.mass,
        disturbance_force=disturbance(scenario).bound + scenario.chaser.mass * bent.constant,
        # Twice the rate multiplies the speed.
        angular_rate=rate * outward + 0.5 * bent.per_speed,
        angular_acceleration=acceleration * outward,
        gravity_gradient=2.0 * EARTH_GRAVITATIONAL_PARAMETER / nearest**3 + bent.gradient,
    )


def guard_assumptions(scenario: Scenario, target: Target) -> GuardAssumptions:
    """Gather what the guard's theorem assumes of a scenario; every number is the scenario's or derived from it.

    The drift is bounded inside a range of twice the furthest of start, goal and target plus 20 m, and up to one and a
    half times the speed limit; the guard flags a flight that leaves that region.
    """
    bounds = flight_bounds(scenario)
    reach = [float(np.linalg.norm(point)) for point in (scenario.start.position, scenario.goal.position)]
    reach.append(float(np.linalg.norm(target.vertices, axis=1).max()))
    entry = scenario.guard
    return GuardAssumptions(
        mass=scenario.chaser.mass,
        force_limit=scenario.chaser.force_limit,
        period=scenario.control.period,
        disturbance_force=disturbance_bound(scenario) + (bounds.disturbance_force - disturbance(scenario).bound),
        angular_rate=bounds.angular_rate,
        angular_acceleration=bounds.angular_acceleration,
        gravity_gradient=bounds.gravity_gradient,
        range_limit=2.0 * max(reach) + 20.0,
        speed_limit=1.5 * scenario.chaser.speed_limit,
        position_error=entry.position_error,
        velocity_error=entry.velocity_error,
        mass_error=entry.mass_error,
        gain_error=entry.gain_error,
        delay=entry.delay,
    )

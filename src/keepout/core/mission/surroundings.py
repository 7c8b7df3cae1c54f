"""What a scenario flies in, each part and number worked out once, and what the guard's theorem assumes of it."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from keepout.core.audit.tube import FlightBounds
from keepout.core.control.law import Law
from keepout.core.errors import ScenarioError
from keepout.core.flight import faults as wrongs
from keepout.core.flight.setup import Faults, FlightSetup, NoFaults
from keepout.core.geometry.target import Target
from keepout.core.guard import watch
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.guard.guard import Guard
from keepout.core.mission import bounds
from keepout.core.mission.first_look import refuse_disturbance, require_thrusters
from keepout.core.mission.scenario import Scenario
from keepout.core.motion import disturbance as pushes
from keepout.core.motion.attitude import InertiallyFixed, Tumbling, VVLHFixed
from keepout.core.motion.chaser import ThrusterModel, Thrusters
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER
from keepout.core.motion.relative import RelativeMotion
from keepout.core.plug_ins import load

_NEAR = 1000.0
"""Gravity is bounded at least this far from the target, m."""
_FARTHEST = 100_000.0
"""Gravity is bounded at most this far from the target's centre of mass, m."""
_FAST = 100.0
"""Differential drag is bounded at least up to this relative speed, m/s."""
_OUTWARD = 1.0 + 1e-9
_DIAGONAL = np.full(3, 1.0 / math.sqrt(3.0))
_BANG_BANG_PERIOD = 100.0
"""Of the bang-bang disturbance, s."""
RANDOM_BAND = (0.001, 0.3)
"""Frequencies of the random disturbance, rad/s."""
_ASSUMED = (
    *(("disturbance_force", "N"), ("angular_rate", "radps"), ("angular_acceleration", "radps2")),
    *(("gravity_gradient", "per_s2"), ("origin_offset", "m"), ("range_limit", "m"), ("speed_limit", "mps")),
    *(("position_error", "m"), ("velocity_error", "mps"), ("mass_error", ""), ("gain_error", ""), ("delay", "")),
    *(("force_error", "N"), ("excursion", "m"), ("velocity_excursion", "mps")),
    *(("fault_force", "N"), ("fault_steps", ""), ("turning_error", "")),
)
"""What the guard assumes, with its unit, as a summary lists it."""
_ROUNDING = 1e-9
"""Relative: a bound declared is not broken by the rounding of the flown one."""


@dataclass(frozen=True)
class ThrusterErrors:
    """What thrusters add to what a guard and an audit must assume; all zero for thrusters that hold any force.

    Attributes:
        force_error: bound on the norm of a constant force that, added to the force asked for, has the same effect on
            position and velocity at the end of a control period as the pulses' quantisation and delay have, N.
        running_error: bound on the norm of the impulse given less the one asked for, added up over all periods so far,
            beside what misalignment and scale add up to, N s; infinite where nothing is made up for.
        excursion: bound on the distance within a period between the path and that of the held mean force through either
            end of the period, m.
        velocity_excursion: the same of the velocities, m/s.
        gain_error: relative error of each axis' force that covers misalignment and scale, as the guard's `gain_error`
            counts it.
        fault_force: bound on the norm of the force that a stuck thruster adds or leaves out until it is known, N.
        fault_steps: control periods until it is known.

    """

    force_error: float = 0.0
    running_error: float = 0.0
    excursion: float = 0.0
    velocity_excursion: float = 0.0
    gain_error: float = 0.0
    fault_force: float = 0.0
    fault_steps: int = 0

    def times_gain(self, gain_error: float) -> "ThrusterErrors":
        """Give the errors of thrusters whose every force is wrong by a further factor of 1 ± `gain_error`.

        Whatever they give is scaled, what they give wrongly too: relative errors compound, all else grows.
        """
        most = 1.0 + gain_error
        grown = ("force_error", "running_error", "excursion", "velocity_excursion", "fault_force")
        gain = gain_error + self.gain_error + gain_error * self.gain_error
        return replace(self, gain_error=gain, **{name: most * getattr(self, name) for name in grown})


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a scenario flies in, and its numbers for law, guard and audit; each is worked out when first asked for.

    Attributes:
        scenario: whose surroundings these are.
        target: its mesh; of all numbers only the guard's assumptions need it.
        extent: how far the target reaches from the body frame's origin, m, where no mesh is known.

    """

    scenario: Scenario
    target: Target | None = None
    extent: float | None = None

    def setup(self, law: Law, **chosen: Any) -> FlightSetup:
        """Put a law where the scenario flies: motion, disturbance, faults and numbers, without guard or logged field.

        Args:
            law: as it is flown, its faults and what it is told of a delay included (`broken_as`).
            **chosen: entries of `FlightSetup`, instead of the scenario's or beside them.

        """
        goal, mass, period = self.scenario.goal, self.scenario.chaser.mass, self.scenario.control.period
        parts = {name: getattr(self, name) for name in ("motion", "disturbance", "thrusters", "faults")}
        parts |= {"goal": goal.position, "tolerance": goal.tolerance, "mass": mass, "period": period}
        return FlightSetup(controller=law, **(parts | chosen))

    @cached_property
    def motion(self) -> RelativeMotion:
        """The relative dynamics of the scenario's orbit and attitude."""
        scenario, attitude = self.scenario, self.scenario.attitude
        if attitude.kind == "tumbling":
            turning = Tumbling(
                angular_velocity=np.asarray(attitude.angular_velocity),
                inertia=np.asarray(attitude.inertia),
                gravity_gradient=attitude.gravity_gradient,
            )
        else:
            turning = InertiallyFixed() if attitude.kind == "inertial" else VVLHFixed()
        return RelativeMotion(
            bounds.orbit_of(scenario.orbit),
            turning,
            bounds.perturbations(scenario),
            centre_of_mass=np.asarray(scenario.target.centre_of_mass),
            held_inertially=scenario.thrusters.held_in == "inertial",
        )

    @cached_property
    def disturbance(self) -> pushes.Disturbance:
        """The force that nobody commanded (body axes, N)."""
        return self._disturbance(self.scenario.disturbance.phase)

    def _disturbance(self, phase: float) -> pushes.Disturbance:
        scenario, entry = self.scenario, self.scenario.disturbance
        amplitude = 0.0 if entry.amplitude is None else entry.amplitude
        match entry.kind:
            case "none":
                return pushes.NoDisturbance()
            case "paper":
                return pushes.paper_disturbance().shifted(phase)
            case "constant":
                return pushes.steady(np.asarray(entry.force))
            case "bang-bang":
                most = math.ceil(scenario.control.period / (0.5 * _BANG_BANG_PERIOD))
                wave = pushes.SquareWaveDisturbance(amplitude * _DIAGONAL, _BANG_BANG_PERIOD, most_switches=most)
                return wave.shifted(phase)
            case "resonant":
                return pushes.resonant(amplitude * _DIAGONAL, scenario.control.period).shifted(phase)
            case "random":
                key = jax.random.fold_in(jax.random.key(scenario.seed), 1)
                return pushes.band_limited_noise(key, 0.5 * amplitude, amplitude, RANDOM_BAND).shifted(phase)

    @cached_property
    def largest_disturbance(self) -> float:
        """A bound on the norm of the true disturbance, N, whatever its phase.

        No phase changes a bound but by rounding (`SinusoidalDisturbance.bound`); that of phase 0 stands for all, so
        that laws and guards of flights that differ in the phase alone are equal to the last bit.
        """
        return self._disturbance(0.0).bound

    @property
    def disturbance_bound(self) -> float:
        """The largest disturbance norm (N) that law and guard assume.

        Raises:
            ScenarioError: the thrusters cannot hold against it.

        """
        declared = self.scenario.disturbance.bound
        bound = self.largest_disturbance if declared is None else declared
        refuse_disturbance(bound, self.scenario.chaser.force_limit)
        return bound

    @cached_property
    def faults(self) -> Faults:
        """What stands between truth and law, in the order in which a command passes it."""
        entry = self.scenario.faults
        bounded = entry.position_bias, entry.velocity_bias, entry.position_noise, entry.velocity_noise
        parts: list[Faults] = []
        if any(bounded):
            parts.append(wrongs.WrongEstimate(*bounded))
        if entry.position_noise_std or entry.velocity_noise_std:
            parts.append(wrongs.GaussianEstimate(entry.position_noise_std, entry.velocity_noise_std, self.noise_memory))
        if entry.dropped:
            parts.append(wrongs.DroppedCommands(entry.dropped))
        if entry.delay:
            parts.append(wrongs.DelayedCommands(entry.delay))
        if entry.gain_error:
            parts.append(wrongs.ThrusterGain(entry.gain_error))
        if entry.stuck is not None:
            sign, axis = (1 if entry.stuck[0] == "+" else -1), "xyz".index(entry.stuck[1])
            parts.append(wrongs.StuckThruster(axis, sign, entry.stuck_force, start=entry.stuck_from))
        if entry.abort_at is not None and self.scenario.approach.abort == "drift":
            parts.append(wrongs.NoThrust(entry.abort_at))
        return wrongs.CombinedFaults(tuple(parts)) if parts else NoFaults()

    @property
    def noise_memory(self) -> float:
        """The share of a Gaussian error of the estimate that is left a period later."""
        lasting = self.scenario.faults.noise_correlation_time
        return math.exp(-self.scenario.control.period / lasting) if lasting else 0.0

    @property
    def kept_margin(self) -> float:
        """What the guard keeps beyond contact, m: the operator's margin, or nothing."""
        return self.scenario.safety.margin if self.scenario.guard.keeps_margin else 0.0

    @cached_property
    def flight_bounds(self) -> FlightBounds:
        """What the audit takes for bounds on what no record holds: true disturbance, rotation, differential gravity.

        Differential gravity is bounded within a range that holds every start and the goal twice over, and 1000 m at
        least. Of what perturbations add, the constant is part of the force, and half of what grows with speed of the
        rate. Drag is bounded up to the speed that the guard allows, and 100 m/s at least.

        Raises:
            ScenarioError: start, goal or campaign are too far away for any bound, or the orbit has none.

        """
        region = self.region(self._furthest)
        shared, pull = self._moved(region)
        return FlightBounds(
            **shared,
            disturbance_force=self.largest_disturbance + pull,
            range_limit=region,
            excursion=self._thruster_errors.excursion,
            velocity_excursion=self._thruster_errors.velocity_excursion,
            speed_limit=self._fastest if self.scenario.drag.density > 0.0 else math.inf,
            force_turning=self._force_turning,
        )

    @cached_property
    def guard_assumptions(self) -> GuardAssumptions:
        """What the guard's theorem assumes of the scenario; every number is the scenario's or derived from it.

        The drift is bounded inside a range of twice the furthest of start, goal and target plus 20 m, and up to one and
        a half times the speed limit; the guard flags a flight that leaves that region.

        Raises:
            ScenarioError: start, goal or target reach too far for gravity to be bounded.

        """
        extent = self.extent if self.target is None else float(np.linalg.norm(self.target.vertices, axis=1).max())
        assert extent is not None, "how far the target reaches is not known"
        scenario, entry = self.scenario, self.scenario.guard
        away = {name: value for name, value in self._furthest.items() if name != "campaign"}
        away["target"] = extent
        shared, pull = self._moved(self.region(away))
        thrust = vars(self._thruster_errors.times_gain(entry.gain_error))
        told = {name: getattr(entry, name) for name in ("position_error", "velocity_error", "mass_error", "delay")}
        assumed = GuardAssumptions(
            **shared,
            **told,
            **{name: error for name, error in thrust.items() if name != "running_error"},
            force_limit=scenario.chaser.force_limit,
            period=scenario.control.period,
            disturbance_force=self.disturbance_bound + pull,
            range_limit=2.0 * max(away.values()) + 20.0,
            speed_limit=self._allowed_speed,
            turning_error=2.0 * math.sin(0.5 * min(self._force_turning * scenario.control.period, math.pi)),
        )
        if scenario.navigation.suite == "none":
            return assumed
        position_error, velocity_error = load("navigation", "certain")(scenario, assumed).errors
        return replace(assumed, position_error=position_error, velocity_error=velocity_error)

    def _moved(self, region: float) -> tuple[dict[str, float], float]:
        """Give the bounds that guard and audit share for a chaser within `region` m, and the perturbations' pull, N."""
        mass, (rate, acceleration) = self.scenario.chaser.mass, self._rotation
        differential = self._differential(region)
        shared = {
            "mass": mass,
            "angular_rate": rate + 0.5 * differential.per_speed,
            "angular_acceleration": acceleration,
            "gravity_gradient": differential.gradient,
            "origin_offset": self._origin_offset,
            "valid_until": self._valid_until,
        }
        return shared, mass * differential.constant

    @cached_property
    def _orbit(self) -> bounds.OrbitBounds:
        return bounds.orbit_bounds(self.scenario)

    @property
    def thrusters(self) -> ThrusterModel:
        """What gives the force in flight, with the thruster that the scenario's faults stick.

        Raises:
            ScenarioError: a layout that cannot be flown, or a fault of a thruster that is not there.

        """
        require_thrusters(self.scenario)
        if self.scenario.thrusters.layout == "ideal":
            return Thrusters(self.scenario.chaser.force_limit)
        return load("thrusters", "flown")(self.scenario)

    @cached_property
    def _thruster_errors(self) -> ThrusterErrors:
        ideal = self.scenario.thrusters.layout == "ideal"
        return ThrusterErrors() if ideal else load("thrusters", "errors")(self.scenario)

    @cached_property
    def _rotation(self) -> tuple[float, float]:
        """Bounds on the body frame's inertial rate, rad/s, and its derivative, rad/s².

        Raises:
            ScenarioError: a body that turns too fast for a bound between two control periods.

        """
        scenario, attitude = self.scenario, self.scenario.attitude
        if attitude.kind == "inertial":
            return 0.0, 0.0
        if attitude.gravity_gradient:
            period, lowest = scenario.control.period, self._orbit.lowest_radius
            rate, acceleration = bounds.turned_by_gravity(
                self.motion, period=period, steps=scenario.steps, lowest_radius=lowest
            )
            if not math.isfinite(rate):
                raise ScenarioError(
                    f"attitude.angular_velocity: {list(attitude.angular_velocity)} rad/s; with "
                    f"gravity_gradient the body must turn less within a control period of {period:g} s"
                )
            return rate, acceleration
        if attitude.kind == "tumbling":
            rate, acceleration = bounds.turning_freely(
                np.asarray(attitude.angular_velocity), np.asarray(attitude.inertia)
            )
        else:
            rate, acceleration = self._orbit.rate, self._orbit.acceleration
        return rate * _OUTWARD, acceleration * _OUTWARD

    @property
    def _force_turning(self) -> float:
        """A bound on how fast the axes in which a force is held turn against the body frame, rad/s."""
        return self._rotation[0] if self.scenario.thrusters.held_in == "inertial" else 0.0

    @property
    def _valid_until(self) -> float:
        """The time, s since the epoch, until which orbit and rotation are bounded; infinite where they always are.

        A body that gravity turns, and zones that turn, are followed until half a period after the last of the flight's
        states.
        """
        until = self._orbit.valid_until
        turning = any(self.turning_rate(zone.axes) for zone in self.scenario.zone)
        if self.scenario.attitude.gravity_gradient or turning:
            until = min(until, (self.scenario.steps + 0.5) * self.scenario.control.period)
        return until

    @property
    def _origin_offset(self) -> float:
        """Distance of the body frame's origin from the target's centre of mass, m."""
        return float(np.linalg.norm(self.scenario.target.centre_of_mass))

    @property
    def _furthest(self) -> dict[str, float]:
        """The distance from the origin, m, of each entry that says where the chaser flies."""
        scenario = self.scenario
        corner = np.maximum(np.abs(scenario.campaign.lower), np.abs(scenario.campaign.upper))
        legs = {f"leg.{k}.position": float(np.linalg.norm(leg.position)) for k, leg in enumerate(scenario.leg)}
        return {
            "start.position": float(np.linalg.norm(scenario.start.position)),
            "goal.position": float(np.linalg.norm(scenario.goal.position)),
            "campaign": float(np.linalg.norm(corner)),
        } | legs

    def turning_rate(self, axes: str) -> float:
        """Bound how fast axes ("body", "vvlh", "inertial") turn against the body frame, rad/s."""
        if axes == "body" or self.scenario.attitude.kind == axes:
            return 0.0
        return self._rotation[0] + (self._orbit.rate * _OUTWARD if axes == "vvlh" else 0.0)

    def region(self, away: dict[str, float]) -> float:
        """Give the range, m, within which gravity is bounded: twice the furthest of `away` plus 20 m, at least 1000 m.

        Args:
            away: of each entry that says where the chaser flies, by its name, the distance from the origin, m.

        Raises:
            ScenarioError: that and the centre of mass's offset go beyond `_FARTHEST`.

        """
        entry = max(away, key=lambda name: away[name])
        offset = self._origin_offset
        region = max(_NEAR, 2.0 * away[entry] + 20.0)
        if region + offset > _FARTHEST:
            name, value = ("target.centre_of_mass", offset) if offset > away[entry] else (entry, away[entry])
            raise ScenarioError(
                f"{name}: {value:.6g} m from the body frame's origin; gravity is bounded within {_FARTHEST:g} m of the "
                f"target's centre of mass, and twice the distance flown plus 20 m must lie within that"
            )
        return region

    def _differential(self, region: float) -> bounds.DifferentialBounds:
        """Bound what gravity and perturbations do to chaser and target differently, for a chaser within `region` m.

        The least r from the Earth's centre to any point between target and chaser is the lowest radius less their
        distance; the gradient of a point mass's gravity is at most 2 μ / r³.
        """
        nearest = self._orbit.lowest_radius - max(_NEAR, region + self._origin_offset)
        rate, fastest = self._rotation[0], self._fastest
        bent = bounds.differential_bounds(
            self.scenario, self._orbit, nearest=nearest, angular_rate=rate, fastest=fastest
        )
        return replace(bent, gradient=2.0 * EARTH_GRAVITATIONAL_PARAMETER / nearest**3 + bent.gradient)

    @property
    def _allowed_speed(self) -> float:
        """V̄: the speed, m/s, up to which the guard lets the chaser fly."""
        return 1.5 * self.scenario.chaser.speed_limit

    @property
    def _fastest(self) -> float:
        """The relative speed, m/s, up to which drag is bounded."""
        return max(_FAST, self._allowed_speed)


def broken_assumptions(scenario: Scenario, target: Target | None = None) -> tuple[str, ...]:
    """Name what the scenario flies beyond what it declares to the guard, each with its numbers; () where nothing is.

    A target that is the skin of a map brings along what was broken when that map was made.

    A broken control law is none of it: the theorem holds whatever is commanded. Sufficient for the theorem, not
    necessary: that needs the sum D only, and one part may use what another leaves.
    """
    guard, faults, around = scenario.guard, scenario.faults, Surroundings(scenario)
    found: list[str] = []

    def compare(flown_name: str, flown: float, declared_name: str, declared: float, unit: str) -> None:
        if flown > declared * (1.0 + _ROUNDING):
            found.append(f"{flown_name} {flown:.6g}{unit} > {declared_name} {declared:.6g}{unit}")

    compare("disturbance: flown up to", around.largest_disturbance, "disturbance.bound", around.disturbance_bound, " N")
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
    if faults.abort_at is not None and scenario.approach.abort == "drift" and faults.abort_at < scenario.duration:
        found.append(f"faults.abort_at {faults.abort_at:.6g} s, approach.abort drift (from then on nothing thrusts)")
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
    # As Python's numbers: of arrays JAX would compile every sum and product below.
    a = jax.tree.map(lambda leaf: float(leaf) if isinstance(leaf, jax.Array) else leaf, guard.assumptions)
    b = guard.braking
    longest = watch.windows(a)[-1]
    least = watch.SHARE * float(a.disturbance)
    numbers = {f"{name}_{unit}".removesuffix("_"): getattr(a, name) for name, unit in _ASSUMED} | {
        "valid_until_s": a.valid_until if math.isfinite(a.valid_until) else None,
        "disturbance_D_mps2": a.disturbance,
        "deceleration_a_b_mps2": b.deceleration,
        "reserve_U_mps2": b.reserve,
        "position_radius_rho_m": b.position_radius,
        "velocity_radius_sigma_mps": b.velocity_radius,
        "margin_kept_m": Surroundings(scenario).kept_margin,
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

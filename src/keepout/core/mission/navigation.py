"""A scenario's navigation: its suite, the law's estimator, and the guard's set with the caps that it keeps."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from keepout.core.control.observer import PAPER_FREQUENCIES
from keepout.core.errors import ScenarioError
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.mission.navigation_entries import NavigationEntry
from keepout.core.mission.scenario import Scenario
from keepout.core.motion import RelativeMotion
from keepout.flights.navigation.bounded import SetMembership
from keepout.flights.navigation.caps import design
from keepout.flights.navigation.estimator import Estimator
from keepout.flights.navigation.kalman import kalman_filter
from keepout.flights.navigation.navigation import Navigation
from keepout.flights.navigation.observability import check_observability
from keepout.flights.navigation.raw import RawSamples
from keepout.flights.navigation.sensor import Sensor
from keepout.flights.navigation.suite import Suite
from keepout.flights.navigation.worked_suites import SUITES


@dataclass(frozen=True)
class Certain:
    """The guard's estimate, and what it is sure to keep.

    Attributes:
        estimate: the set-membership estimate.
        errors: caps of its radii, m and m/s.
        initial: largest errors of the first estimate, m and m/s.

    """

    estimate: SetMembership
    errors: tuple[float, float]
    initial: tuple[float, float]


def require_navigation(scenario: Scenario) -> None:
    """Refuse entries of navigation that the suite has no use for.

    Raises:
        ScenarioError: there are some; the message names them.

    """
    entry = scenario.navigation
    if entry.suite == "none":
        given = [f"navigation.{key}" for key in entry.model_dump(exclude_defaults=True)]
        if given:
            raise ScenarioError(
                f'{", ".join(given)}: only for a suite, and navigation.suite is "none"; give "far", "near" or "close"'
            )
        return
    noises = [f"navigation.{key}" for key in ("position_noise", "velocity_noise") if getattr(entry, key) is not None]
    if noises and entry.suite != "close":
        raise ScenarioError(
            f'{", ".join(noises)}: only for navigation.suite = "close", and it is "{entry.suite}"; leave them out'
        )


def suite_of(entry: NavigationEntry) -> Suite:
    """Build the sensors."""
    chosen = {
        "position": entry.position_noise,
        "velocity": entry.velocity_noise,
        "dropout": entry.dropout,
        "most_missed": entry.most_missed,
    }
    if entry.dropout and entry.most_missed == 0:
        raise ScenarioError(
            f"navigation.most_missed: 0, and dropout is {entry.dropout:g}; a sample that can be lost needs at least 1"
        )
    if entry.dropout and entry.most_missed is None and entry.suite == "close":
        raise ScenarioError(
            f"navigation.dropout: {entry.dropout:g} needs most_missed, how many samples can be lost in a row"
        )
    return SUITES[entry.suite](**{name: value for name, value in chosen.items() if value is not None})


def certain(scenario: Scenario, assumed: GuardAssumptions) -> Certain:
    """Design the guard's estimate for what the guard assumes of the motion, and bound its radii over the flight.

    A thruster that sticks pushes until it is known: its force is part of what the set must allow for.

    Args:
        scenario: with a suite.
        assumed: the guard's assumptions, whose errors of the estimate do not matter.

    Raises:
        ScenarioError: a suite that does not determine the motion, or whose set grows without end.

    """
    return _certain(
        scenario.navigation.model_dump_json(),
        float(assumed.disturbance + assumed.fault_push),
        scenario.chaser.mass,
        scenario.control.period,
        float(assumed.range_limit),
        float(assumed.speed_limit),
    )


@lru_cache(maxsize=64)
def _certain(
    entries: str, disturbance: float, mass: float, period: float, range_limit: float, speed_limit: float
) -> Certain:
    numbers = {
        "disturbance": disturbance,
        "mass": mass,
        "period": period,
        "range_limit": range_limit,
        "speed_limit": speed_limit,
    }
    entry = NavigationEntry.model_validate_json(entries)
    given = entry.initial_position_error, entry.initial_velocity_error
    whole = suite_of(entry.model_copy(update={"dropout": 0.0, "most_missed": 0}))
    _, usual = design(whole, **numbers, initial_errors=(0.0, 0.0))
    initial = (usual[0] if given[0] is None else given[0], usual[1] if given[1] is None else given[1])
    estimate, errors = design(suite_of(entry), **numbers, initial_errors=initial)
    return Certain(estimate, errors, initial)


def navigation(scenario: Scenario, motion: RelativeMotion, assumed: GuardAssumptions) -> Navigation:
    """Build the navigation of a scenario that names a suite.

    Args:
        scenario: its entries `navigation`, `chaser`, `control`, `disturbance` and `guard.delay`.
        motion: the model of the relative motion.
        assumed: what the guard assumes.

    Raises:
        ScenarioError: a suite that does not determine the motion, or whose set grows without end.

    """
    sure = certain(scenario, assumed)
    start = motion.initial_state(np.asarray(scenario.start.position), np.asarray(scenario.start.velocity))
    check_observability(sure.estimate.suite, start, scenario.control.period)
    suite = sure.estimate.suite
    estimator = _estimator(scenario, motion, suite.sensors, float(assumed.disturbance_force))
    return Navigation(suite, estimator, sure.estimate, sure.initial, scenario.guard.delay)


def _estimator(
    scenario: Scenario, motion: RelativeMotion, sensors: tuple[Sensor, ...], disturbance_bound: float
) -> Estimator:
    mass, period = scenario.chaser.mass, scenario.control.period
    if scenario.navigation.estimate != "filter":
        return RawSamples.build(motion, sensors, mass=mass, period=period)
    harmonic = scenario.control.observer in (None, "harmonic")
    return kalman_filter(
        motion,
        sensors,
        mass=mass,
        period=period,
        disturbance_bound=max(disturbance_bound, 1e-6),
        frequencies=PAPER_FREQUENCIES if harmonic else (),
    )

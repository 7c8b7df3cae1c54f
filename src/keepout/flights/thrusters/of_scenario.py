"""A scenario's thrusters: the layout, whether it gives the force that law and guard use, and what it does wrong."""

from functools import lru_cache

import numpy as np

from keepout.core.errors import ScenarioError
from keepout.core.mission.entries import ThrustersEntry
from keepout.core.mission.scenario import Scenario
from keepout.flights.thrusters.layout import Capability, Layout, Stuck, force_box, preset, share
from keepout.flights.thrusters.on_off import OnOffThrusters, ThrusterErrors, require_periods, thruster_errors

_ROUNDING = 1.0 - 1e-6
"""A force box may be short of chaser.force_limit by so much: what a linear program's solver leaves open."""


def layout(scenario: Scenario) -> Layout | None:
    """Give the scenario's layout; None where the thrusters are ideal.

    Raises:
        ScenarioError: its directions do not span three axes.

    """
    entry, chaser = scenario.thrusters, scenario.chaser
    return _layout(entry, chaser.force_limit, chaser.radius)  # pyright: ignore[reportArgumentType]: it has a hash


@lru_cache(maxsize=64)
def _layout(entry: ThrustersEntry, force_limit: float, radius: float) -> Layout | None:
    """Give one layout for all scenarios of the same thrusters, so that what it can give is worked out once."""
    names = ("least_on_time", "specific_impulse", "rise_delay", "misalignment", "scale_error")
    numbers = {name: getattr(entry, name) for name in names}
    if entry.layout == "ideal":
        return None
    if entry.layout == "own":
        force = np.array([entry.force if own.force is None else own.force for own in entry.own], float)
        positions, directions = (
            np.array([getattr(own, key) for own in entry.own]) for key in ("position", "direction")
        )
        return Layout(positions, directions, force, **numbers)
    force = force_limit / share(entry.layout) if entry.force is None else entry.force
    return preset(entry.layout, force=force, arm=max(radius, 0.1), **numbers)


_whole, _able = lru_cache(maxsize=64)(force_box), lru_cache(maxsize=64)(Capability.of)


def thrusters(scenario: Scenario) -> OnOffThrusters:
    """Build the thrusters of a scenario's layout, with the one that its faults stick.

    Raises:
        ScenarioError: a layout that cannot be flown (`require_layout`), or a fault of a thruster that is not there.

    """
    flown, entry, faults = layout(scenario), scenario.thrusters, scenario.faults
    require_layout(scenario)
    assert flown is not None
    return OnOffThrusters.of(
        flown,
        force_limit=scenario.chaser.force_limit,
        period=scenario.control.period,
        delta_sigma=entry.modulation == "delta-sigma",
        stuck=None if faults.thruster is None else (faults.thruster, faults.thruster_stuck),
        stuck_from=faults.stuck_from,
        detection_time=entry.detection_time,
    )


def require_layout(scenario: Scenario) -> None:
    """Refuse a layout that does not give chaser.force_limit along every axis, whole or with one thruster stuck.

    Raises:
        ScenarioError: it does not, its thrusters do not span three axes, or its pulses do not fit into a period.

    """
    flown = layout(scenario)
    if flown is None:
        return
    require_periods(flown, scenario.control.period)
    if scenario.faults.thruster is not None:
        flown.require(scenario.faults.thruster)
    asked = scenario.chaser.force_limit
    whole = _whole(flown)
    if whole == 0.0:
        raise ScenarioError(
            f"thrusters.layout: its {flown.count} thrusters cannot push every way: the largest force that they give "
            "in all directions is 0 N"
        )
    if whole < asked * _ROUNDING:
        raise ScenarioError(
            f"chaser.force_limit: {asked:g} N, and the thrusters give {whole:.4g} N along every axis; lower it to "
            "that, or give stronger thrusters"
        )
    if not scenario.thrusters.survive_failure:
        return
    able = _able(flown)
    left = able.after_failure
    if left < asked * _ROUNDING:
        how: Stuck = "off" if min(able.stuck_off) <= left else "on"
        worst = int(np.argmin(able.stuck_off if how == "off" else able.stuck_on))
        raise ScenarioError(
            f"thrusters.survive_failure: with thruster {worst} stuck {how} the others give {left:.4g} N along every "
            f"axis, and chaser.force_limit is {asked:g} N; "
            + (
                f"lower it to that, or raise thrusters.force {asked / left:.3g} times"
                if left > 0.0
                else "no force limit helps: take a layout with more thrusters"
            )
        )


def errors(scenario: Scenario) -> ThrusterErrors:
    """Bound what a layout's thrusters do beyond holding the force asked for: what guard and audit must assume."""
    flown, entry = layout(scenario), scenario.thrusters
    assert flown is not None
    return thruster_errors(
        flown,
        force_limit=scenario.chaser.force_limit,
        mass=scenario.chaser.mass * (1.0 - scenario.guard.mass_error),
        period=scenario.control.period,
        delta_sigma=entry.modulation == "delta-sigma",
        detection_time=entry.detection_time if entry.survive_failure else None,
    )

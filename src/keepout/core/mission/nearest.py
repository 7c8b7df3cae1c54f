"""The nearest value that is not refused: of a number by bisection, of a place by a search in all directions."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from keepout.core.control.conditions import drift_bound
from keepout.core.control.operation import Operation
from keepout.core.control.tuning import tune
from keepout.core.errors import KeepoutError
from keepout.core.geometry.target import Target
from keepout.core.guard.braking import design
from keepout.core.mission.scenario import Scenario, with_entries
from keepout.core.mission.surroundings import Surroundings

_CLOSE = 1e-3
"""Relative: a number nearer than this to one that is refused is not looked for."""
_DIRECTIONS = 400


@dataclass(frozen=True)
class Nearest:
    """A value of one entry with which a scenario is not refused for the same reason.

    Attributes:
        entry: dotted name.
        value: a number, or a place in m.
        words: the same as a person reads it.

    """

    entry: str
    value: float | tuple[float, float, float]
    words: str


def number_refusal(scenario: Scenario, target: Target) -> KeepoutError | None:
    """Give what a scenario's numbers are refused for, whatever its field says: by the law, then by the guard."""
    try:
        bound = Surroundings(scenario).disturbance_bound
        motion = Surroundings(scenario).motion
        if scenario.control.profile == "default":
            reach = max(np.linalg.norm(scenario.goal.position), np.linalg.norm(scenario.start.position))
            chaser = Surroundings(scenario).chaser
            designed = Operation(chaser, motion, 0.0, bound, scenario.safety.margin, scenario.control.period)
            tune(designed, drift_bound=drift_bound(motion, radius=float(reach), speed=chaser.speed_limit))
        if scenario.guard.enabled:
            design(Surroundings(scenario, target).guard_assumptions)
    except KeepoutError as refusal:
        return refusal
    return None


def nearest_number(refused: Callable[[float], Any], value: float, end: float) -> float | None:
    """Give the number nearest to `value`, which is refused, on the way to `end`, that is not; None if `end` is too.

    By bisection, so of several such stretches one; the answer itself was tried. It has three or four digits.
    """
    if refused(end):
        return None
    good, bad = end, value
    while abs(bad - good) > _CLOSE * max(abs(good), 1e-9):
        low, high = min(good, bad), max(good, bad)
        # Orders of magnitude apart, the middle is that of the logarithms.
        middle = math.sqrt(low * high) if 0.0 < 4.0 * low < high else 0.5 * (low + high)
        good, bad = (good, middle) if refused(middle) else (middle, bad)
        if max(abs(good), abs(bad)) < 1e-9:
            break
    for digits in (3, 4):
        rounded = _towards(good, end, digits)
        if not refused(rounded):
            return rounded
    return good


def _towards(value: float, end: float, digits: int) -> float:
    """Round a number to some digits, in the direction of another."""
    if value == 0.0:
        return value
    unit = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    steps = value / unit
    return float(f"{(math.ceil(steps - 1e-9) if end > value else math.floor(steps + 1e-9)) * unit:.{digits}g}")


def remedies(scenario: Scenario, target: Target) -> list[Nearest]:
    """Give, for a scenario whose numbers are refused, values of single entries with which they are not.

    Tried are a lower speed limit, stronger thrusters, a weaker disturbance, and smaller errors declared to the guard.
    """
    guard, chaser = scenario.guard, scenario.chaser
    errors = ("position_error", "velocity_error", "mass_error", "gain_error")
    tried = [("chaser.speed_limit", chaser.speed_limit, 1e-3 * chaser.speed_limit, "at most", " m/s")]
    tried += [("chaser.force_limit", chaser.force_limit, 1e3 * chaser.force_limit, "at least", " N")]
    units = {"position_error": " m", "velocity_error": " m/s"}
    if guard.enabled:
        tried += [
            (f"guard.{name}", getattr(guard, name), 0.0, "at most", units.get(name, ""))
            for name in errors
            if getattr(guard, name) > 0.0
        ]
    found = []
    for entry, value, end, words, unit in tried:

        def refused(number: float, entry: str = entry) -> bool:
            return number_refusal(with_entries(scenario, {entry: number}), target) is not None

        nearest = nearest_number(refused, value, end)
        if nearest is not None:
            found.append(Nearest(entry, nearest, f"{entry} {words} {nearest:.4g}{unit}"))
    return found


def nearest_place(
    free: Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]],
    place: Float[np.ndarray, "3"],
    furthest: float,
) -> tuple[float, float, float] | None:
    """Give a place (m) that is free, near to one that is not; None where none is found within `furthest` m.

    Spheres about the place are searched in many directions from the smallest on, and the way back from what is found is
    bisected. What is given is free; that nothing nearer is, is not proved.
    """
    for radius in _radii(furthest):
        shell = place + radius * _sphere()
        found = np.flatnonzero(free(shell))
        if not len(found):
            continue
        good, bad = shell[found[0]], place
        while np.linalg.norm(good - bad) > 1e-3:
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if free(middle[None])[0] else (good, middle)
        rounded = np.round(good, 2)
        x, y, z = (rounded if free(rounded[None])[0] else good).tolist()
        return x, y, z
    return None


def _radii(furthest: float) -> Iterator[float]:
    radius = 0.05
    while radius < furthest:
        yield radius
        radius *= 1.25


def _sphere() -> Float[np.ndarray, "n 3"]:
    """Directions spread evenly over the sphere (Fibonacci's)."""
    turn = np.pi * (1.0 + math.sqrt(5.0)) * np.arange(_DIRECTIONS)
    z = 1.0 - (2.0 * np.arange(_DIRECTIONS) + 1.0) / _DIRECTIONS
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)

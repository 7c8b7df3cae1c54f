"""What became of a flight's legs and of its rule of speeds: measured at the samples, of the true motion."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from keepout.core.mission.approach import named
from keepout.core.mission.scenario import Scenario


@dataclass(frozen=True)
class LegFlown:
    """One leg, by the true positions at the control steps.

    Attributes:
        name: of the leg.
        begun: when it was begun, s; None where the flight ended before.
        reached: from when on the chaser stayed within the tolerance until the leg was over, s; None: it did not.
        left: when the next leg was begun, s; None for a leg that the flight ended on.
        held: how long it stayed there by then, s.
        largest_error: distance from the place over the last `dwell` seconds of the leg, m, at most.
        kept: whether the place was held within its tolerance for its dwell, and reached within its window.

    """

    name: str
    begun: float | None
    reached: float | None
    left: float | None
    held: float
    largest_error: float | None
    kept: bool

    def summary(self) -> dict[str, Any]:
        """Give the leg as plain values, named with their units."""
        units = {"name": "name", "kept": "kept", "largest_error": "largest_error_m"}
        return {units.get(key, f"{key}_s"): value for key, value in asdict(self).items()}


def legs_flown(
    scenario: Scenario,
    time: Float[np.ndarray, "rows"],
    position: Float[np.ndarray, "rows 3"],
    leg: Int[np.ndarray, "rows"],
) -> tuple[LegFlown, ...]:
    """Judge each leg of a flight; of one that was abandoned those that were over before.

    Args:
        scenario: as flown.
        time: of the rows, s.
        position: the true one, m.
        leg: under way in each row, counted from 0.

    """
    found: list[LegFlown] = []
    abort = scenario.faults.abort_at
    abandoned = abort is not None and scenario.approach.abort == "retreat" and time[-1] >= abort
    if abandoned:
        before = time < abort
        time, position, leg = time[before], position[before], leg[before]
    for number, entry in enumerate(scenario.leg):
        name, rows = named("leg", entry, number), np.flatnonzero(leg == number)
        if not rows.size:
            found.append(LegFlown(name, None, None, None, 0.0, None, kept=False))
            continue
        away = np.linalg.norm(position[rows] - np.asarray(entry.position), axis=1)
        outside = np.flatnonzero(~(away < entry.tolerance))
        first = 0 if not outside.size else int(outside[-1]) + 1
        there = first < len(rows)
        reached = float(time[rows[first]]) if there else None
        held = float(time[rows[-1]] - time[rows[first]]) if there else 0.0
        dwelling = time[rows] >= time[rows[-1]] - entry.dwell - 1e-6
        in_time = entry.within is None or (reached is not None and reached <= entry.within[1])
        ended = rows[-1] + 1 < len(time)
        found.append(
            LegFlown(
                name=name,
                begun=float(time[rows[0]]),
                reached=reached,
                left=float(time[rows[-1] + 1]) if ended else None,
                held=held,
                largest_error=float(away[dwelling].max()),
                kept=there and held >= entry.dwell - 1e-6 and in_time,
            )
        )
    return tuple(one for one in found if not abandoned or one.left is not None)


def speed_excess(
    scenario: Scenario,
    position: Float[np.ndarray, "rows 3"],
    velocity: Float[np.ndarray, "rows 3"],
    clearance: Float[np.ndarray, "rows"],
) -> float:
    """Give by how much, m/s, the rule of speeds was passed at most at a sample; at most 0: it was kept.

    Args:
        scenario: with the rule.
        position: the true one, m.
        velocity: likewise, m/s.
        clearance: from the chaser's surface to the mesh, m.

    """
    allowed = allowed_speed(scenario, position, clearance)
    return float(np.nanmax(np.linalg.norm(velocity, axis=1) - allowed))


def allowed_speed(
    scenario: Scenario, position: Float[np.ndarray, "rows 3"], clearance: Float[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows"]:
    """Give the largest speed, m/s, that the rule of speeds allows at each sample; arguments as of `speed_excess`."""
    rule, point = np.array(scenario.approach.speed_by_distance)[::-1], scenario.approach.distance_to
    to_mesh = clearance + scenario.chaser.radius
    distance = to_mesh if point is None else np.linalg.norm(position - np.asarray(point), axis=1)
    return np.interp(distance, rule[:, 0], rule[:, 1])

"""Runs of a campaign as drawn: the scenario of each, its start and its mission, or why it cannot be flown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.core.errors import KeepoutError
from keepout.core.mission.build import Mission
from keepout.core.mission.places import has_way_out, room_to_start
from keepout.core.mission.scenario import COMPONENTS, Scenario, with_entries
from keepout.flights.campaign.dispersion import Design
from keepout.flights.campaign.workshop import Workshop

ATTEMPTS = 100
"""How often a start is drawn before its run is refused."""


@dataclass(frozen=True)
class Run:
    """One run as drawn.

    Attributes:
        number: its place among all runs.
        values: of what varies, by name.
        position: where it starts, m, body frame.
        velocity: likewise, m/s.
        drawn_again: how often its start was drawn again.
        mission: to be flown, made for the scenario's own start; None where it is refused.
        refusal: why it is refused, or empty.

    """

    number: int
    values: Mapping[str, Any]
    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    drawn_again: int
    mission: Mission | None
    refusal: str = ""

    @property
    def scenario(self) -> Scenario:
        """What is flown, the start as the law was made for."""
        assert self.mission is not None
        return self.mission.scenario


def draw(scenario: Scenario, design: Design, workshop: Workshop, first: int, last: int) -> list[Run]:
    """Draw the runs from `first` up to `last`, each the same whichever others are drawn with it.

    Laws are made for the scenario's start; what is drawn for `start` says where the flight begins, no more. A drawn
    start that the chaser cannot begin at (too near the mesh, or no way out) is drawn again, or refused where the
    design is laid out over all runs.
    """
    drawn = design.values(first, last)
    begun = [
        _begun(scenario, workshop, first + i, {name: _plain(of[i]) for name, of in drawn.items()})
        for i in range(last - first)
    ]
    if not any(dispersion.of_start for dispersion in design.dispersions):
        return begun
    away = _away(begun)
    return [_that_can_start(scenario, design, run, away.get(run.number)) for run in begun]


def _begun(scenario: Scenario, workshop: Workshop, number: int, values: dict[str, Any]) -> Run:
    """Build a run's mission; whether it can start where it is to is not looked at."""
    position, velocity = _start(scenario, values)
    elsewhere = {name: value for name, value in values.items() if not name.startswith("start.")}
    try:
        mission = workshop.mission(with_entries(scenario, elsewhere) if elsewhere else scenario)
    except KeepoutError as refusal:
        return Run(number, values, position, velocity, 0, None, str(refusal))
    return Run(number, values, position, velocity, 0, mission)


def _away(runs: Sequence[Run]) -> dict[int, float]:
    """Give the distance from the mesh, m, of each run's start, by number."""
    around: dict[int, list[Run]] = {}
    for run in runs:
        if run.mission is not None:
            around.setdefault(id(run.mission.target), []).append(run)
    found: dict[int, float] = {}
    for some in around.values():
        assert some[0].mission is not None
        distance = some[0].mission.target.distance.distance(np.stack([run.position for run in some]))
        found |= zip((run.number for run in some), distance.tolist())
    return found


def _that_can_start(scenario: Scenario, design: Design, run: Run, away: float | None) -> Run:
    """Give the run, its start drawn again until the chaser can begin there; or refused."""
    mission = run.mission
    if mission is None:
        return run
    again = 0
    while reason := _unusable(mission, run.position, away):
        if not design.redraws or again >= ATTEMPTS:
            reason = f"start.position: {reason}" + (f" (draw {again + 1})" if again else "")
            return replace(run, mission=None, refusal=reason)
        again, away = again + 1, None
        fresh = design.start_values(run.number, again)
        values = {**run.values, **{name: _plain(value) for name, value in fresh.items()}}
        position, velocity = _start(scenario, values)
        run = replace(run, values=values, position=position, velocity=velocity, drawn_again=again)
    return run


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _start(scenario: Scenario, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    made = []
    for key in ("position", "velocity"):
        vector = np.array(values.get(f"start.{key}", getattr(scenario.start, key)), float)
        for axis, component in enumerate(COMPONENTS):
            vector[axis] = values.get(f"start.{key}.{component}", vector[axis])
        made.append(vector)
    return made[0], made[1]


def _unusable(mission: Mission, position: Float[np.ndarray, "3"], away: float | None) -> str:
    """Say why a chaser cannot start somewhere, or nothing; `away` is the distance from the mesh, m, if it is known."""
    room = room_to_start(mission.scenario)
    away = float(mission.target.distance.distance(position[None])[0]) if away is None else away
    if not away > room:
        return f"{position.round(4).tolist()} m is {away:.3f} m from the mesh, and {room:.2f} m of room is needed"
    if not has_way_out(mission.scenario, mission.target, position, away):
        return f"{position.round(4).tolist()} m has no free way out of the target for the chaser"
    return ""

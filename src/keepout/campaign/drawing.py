"""Runs of a campaign as drawn: the scenario of each, its start and its mission, or why it cannot be flown."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.campaign.dispersion import Design
from keepout.campaign.workshop import Workshop
from keepout.errors import KeepoutError, ScenarioError
from keepout.mission.build import Mission
from keepout.mission.entry_names import COMPONENTS, with_entries
from keepout.mission.places import has_way_out, room_to_start
from keepout.mission.scenario import Scenario

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
    return [
        _run(scenario, design, workshop, first + i, {name: of[i] for name, of in drawn.items()})
        for i in range(last - first)
    ]


def _run(scenario: Scenario, design: Design, workshop: Workshop, number: int, values: dict[str, Any]) -> Run:
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray | np.generic) else value for name, value in values.items()
    }
    again = 0
    position, velocity = _start(scenario, plain)
    try:
        elsewhere = {name: value for name, value in plain.items() if not name.startswith("start.")}
        mission = workshop.mission(with_entries(scenario, elsewhere) if elsewhere else scenario)
        if any(dispersion.of_start for dispersion in design.dispersions):
            while reason := _unusable(mission, position):
                if not design.redraws or again >= ATTEMPTS:
                    raise ScenarioError(f"start.position: {reason}" + (f" (draw {again + 1})" if again else ""))
                again += 1
                fresh = design.start_values(number, again)
                plain |= {n: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for n, v in fresh.items()}
                position, velocity = _start(scenario, plain)
    except KeepoutError as refusal:
        return Run(number, plain, position, velocity, again, None, str(refusal))
    return Run(number, plain, position, velocity, again, mission)


def _start(scenario: Scenario, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    made = []
    for key in ("position", "velocity"):
        vector = np.array(values.get(f"start.{key}", getattr(scenario.start, key)), float)
        for axis, component in enumerate(COMPONENTS):
            vector[axis] = values.get(f"start.{key}.{component}", vector[axis])
        made.append(vector)
    return made[0], made[1]


def _unusable(mission: Mission, position: Float[np.ndarray, "3"]) -> str:
    """Say why a chaser cannot start somewhere, or nothing."""
    room = room_to_start(mission.scenario)
    away = float(mission.target.distance.distance(position[None])[0])
    if not away > room:
        return f"{position.round(4).tolist()} m is {away:.3f} m from the mesh, and {room:.2f} m of room is needed"
    if not has_way_out(mission.scenario, mission.target, position):
        return f"{position.round(4).tolist()} m has no free way out of the target for the chaser"
    return ""

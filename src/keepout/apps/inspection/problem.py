"""What one inspection is about, worked out once: the target in patches, what can be seen of it, and from where."""

import functools
from dataclasses import dataclass

import numpy as np

from keepout.apps.inspection.equipment import patch_size, require_inspectable, rules_of
from keepout.apps.inspection.light import Light
from keepout.apps.inspection.seeing.cut import cut
from keepout.apps.inspection.seeing.judge import seeable
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.seeable import Seeable
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.ways import MOST_NODES, Ways
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of, silent

_FINE_NODES = 4_000_000


@dataclass(frozen=True, eq=False)
class Problem:
    """The equipment of one inspection; make one with `Problem.of`.

    Attributes:
        scenario: of the mission.
        target: its mesh.
        patches: of that mesh.
        rules: when a patch counts as seen.
        sight: lines of sight to the patches.
        room: where the chaser's centre may be.
        seeable: what can be seen at all.
        light: where it comes from, and when.

    """

    scenario: Scenario
    target: Target
    patches: Patches
    rules: SeeingRules
    sight: Sightlines
    room: Room
    seeable: Seeable
    light: Light

    @classmethod
    def of(
        cls, scenario: Scenario, target: Target, *, room: Room | None = None, progress: Progress = silent
    ) -> "Problem":
        """Cut the target into patches, and find out what of it can be seen.

        Args:
            scenario: its entries `camera`, `light` and `inspect`.
            target: the mesh.
            room: that `require_inspectable` gave for both; else both are looked at here.
            progress: told of the cut and the share that is decided.

        Raises:
            InspectionError: something that no plan could make good; the message names the entry.

        """
        room = require_inspectable(scenario, target) if room is None else room
        rules, stand_off = rules_of(scenario), scenario.inspect.stand_off
        patches = cut(target, patch_size(scenario, target), progress=part_of(progress, 0.0, 0.1))
        sight = Sightlines(target.vertices, target.faces, patches)
        judged = seeable(
            target,
            patches,
            sight,
            rules,
            stand_off,
            room=room,
            squares=scenario.inspect.proof_squares,
            seconds=scenario.inspect.proof_time,
            progress=part_of(progress, 0.1, 1.0),
        )
        return cls(scenario, target, patches, rules, sight, room, judged, Light.of(scenario))

    @functools.cached_property
    def ways(self) -> Ways:
        """Ways that keep the stand-off, inside `box`."""
        return Ways.build(self.target.distance, self.scenario.inspect.stand_off, *self.box)

    @functools.cached_property
    def fine_ways(self) -> Ways:
        """The same with nodes at half the stand-off, as far as memory allows: they lead through narrower room."""
        stand_off, (lower, upper) = self.scenario.inspect.stand_off, self.box
        nodes = float(np.prod(upper - lower)) / (0.5 * stand_off) ** 3
        if nodes <= MOST_NODES:
            return self.ways
        return Ways.build(self.target.distance, stand_off, lower, upper, most_nodes=int(min(nodes, _FINE_NODES)))

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners, m, of a box that holds all places from which anything is seen, and the start."""
        start = np.asarray(self.scenario.start.position)
        reach = max(self.rules.greatest_range, self.scenario.inspect.stand_off) + 1.0
        lower = np.minimum(self.target.vertices.min(axis=0) - reach, start - 1.0)
        return lower, np.maximum(self.target.vertices.max(axis=0) + reach, start + 1.0)

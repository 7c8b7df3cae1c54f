"""Missions of many scenarios of one campaign, sharing what is costly: meshes, fields, grids of the guidance."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from keepout.core.control.guidance.guidance import GeodesicGuidance, Guidance
from keepout.core.control.guidance.plan import Geodesic, GuidancePlan, Point
from keepout.core.fields.field import Field
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.mission import environment
from keepout.core.mission.build import Mission, closing_radius, load_model, load_target, prepare
from keepout.core.mission.law import named_guidance
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.arrays import as_float64
from keepout.core.progress import Progress, silent

_KEPT = 8
"""Of each kind: meshes, fields and grids take tens of megabytes."""


class _Shelf:
    """The last few things made, by what they were made of."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        if key not in self._kept:
            self._kept[key] = make()
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


class Workshop:
    """Builds missions as `prepare` does, to the same bits, and makes nothing costly twice that it still has.

    May be asked from several threads, and pickled with all that it has made.
    """

    def __init__(self) -> None:
        self._targets, self._models, self._guards, self._guidances, self._missions = (_Shelf() for _ in range(5))
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Give all but the lock, which belongs to a process."""
        return {name: value for name, value in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what another process has made."""
        vars(self).update(state, _lock=threading.Lock())

    def mission(self, scenario: Scenario, *, progress: Progress = silent) -> Mission:
        """Build a scenario.

        Raises:
            KeepoutError: it cannot be flown; the message names the entry.

        """
        with self._lock:
            if not scenario.disturbance.phase:
                return self._at_phase_zero(scenario, progress)
            # No phase enters law, guard or bounds (`environment.largest_disturbance`): they are made once for all.
            still = scenario.disturbance.model_copy(update={"phase": 0.0})
            mission = self._at_phase_zero(scenario.model_copy(update={"disturbance": still}), progress)
            return replace(
                mission, scenario=scenario, setup=replace(mission.setup, disturbance=environment.disturbance(scenario))
            )

    def _at_phase_zero(self, scenario: Scenario, progress: Progress) -> Mission:
        return self._missions.get(scenario.model_dump_json(), lambda: self._made(scenario, progress))

    def keep(self, target: Target, model: FieldModel, scenario: Scenario) -> None:
        """Take a mesh and a field that are already loaded for a scenario's own."""
        self._targets.get(scenario.target.model_dump_json(), lambda: target)
        self._models.get((scenario.field.source, scenario.target.model_dump_json()), lambda: model)

    def _made(self, scenario: Scenario, progress: Progress) -> Mission:
        source = scenario.target.model_dump_json()
        target = self._targets.get(source, lambda: load_target(scenario.target))
        model = self._models.get((scenario.field.source, source), lambda: load_model(scenario, target))
        grid = None
        if scenario.guard.enabled:
            radius, closing = scenario.chaser.radius, closing_radius(model)
            grid = self._guards.get(
                (target.sha256, radius, model.offset, closing),
                lambda: guard_field(target, radius, offset=model.offset, closing_radius=closing, progress=progress),
            )
        return prepare(
            scenario,
            target=target,
            model=model,
            guidance=self._guidance(scenario, model),
            guard_grid=grid,
            progress=progress,
        )

    def _guidance(self, scenario: Scenario, model: FieldModel) -> GuidancePlan | None:
        plan = named_guidance(scenario)
        if plan is None and scenario.control.profile == "default":
            plan = Geodesic()
        return _Remembered(plan, self._guidances, model.sha256) if isinstance(plan, Geodesic) else plan


@dataclass(frozen=True)
class _Remembered(GuidancePlan):
    """A geodesic guidance whose travel times are marched once for each field, keep-out zone, goal and start."""

    plan: Geodesic
    shelf: _Shelf
    field_sha256: str

    def guidance(
        self,
        field: Field,
        offset: float,
        goal: Point,
        *,
        speed: float,
        slowing_length: float,
        start: Point | None = None,
        progress: Progress = silent,
    ) -> Guidance:
        """Make the guidance, or give the one made before its speed and slowing length: no other part has them."""
        key = (
            self.field_sha256,
            float(offset),
            tuple(np.asarray(goal).tolist()),
            None if start is None else tuple(np.asarray(start).tolist()),
            self.plan.spacing,
        )
        made: GeodesicGuidance = self.shelf.get(
            key,
            lambda: self.plan.guidance(
                field, offset, goal, speed=speed, slowing_length=slowing_length, start=start, progress=progress
            ),
        )
        return replace(made, speed=as_float64(float(speed)), slowing_length=as_float64(float(slowing_length)))

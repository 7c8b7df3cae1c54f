"""What every rival is told of a target: field, envelope margins, chaser, motion, and the geodesic to each goal."""

import functools
import io
import time

import numpy as np
from jaxtyping import Float
from reach_case import Case

from keepout.core.control import profiles
from keepout.core.control.controller import Controller
from keepout.core.control.geodesic import GeodesicGuidance, geodesic_guidance
from keepout.core.control.guidance import Straight
from keepout.core.control.profiles import Operation
from keepout.core.errors import ControlError
from keepout.core.fields.field import Field
from keepout.core.guard.guard import Guard
from keepout.core.kept import digest
from keepout.core.mission.build import build_guard
from keepout.core.mission.law import operation
from keepout.core.mission.surroundings import Surroundings
from keepout.core.whole_file import write_whole

Point = Float[np.ndarray, "3"]


class RivalCase(Case):
    """A `reach_case.Case` with what rivals build their laws from."""

    def __init__(self, source, folder, flights, seed):
        super().__init__(source, folder, flights, seed)
        self.folder = folder
        self._geodesics, self._made = {}, {}
        self.seconds_spared = 0.0
        """Seconds of planning that laws were spared, because another rival had planned the same before."""

    def once(self, name, make):
        """Give what `make()` made the first time that it was asked for by this name: flights share prototypes."""
        key = str(name)
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    @functools.cached_property
    def reach(self) -> float:
        """Distance from the origin to the furthest start or goal, m."""
        return float(np.linalg.norm(self.pairs, axis=-1).max())

    @functools.cached_property
    def operation(self) -> Operation:
        """Chaser, motion, certified error, disturbance bound, margin and period: what a law is tuned for."""
        error_bound = self.model.certificate(self.scenario.chaser.radius).error_bound
        return operation(Surroundings(self.scenario), error_bound)

    @functools.cached_property
    def default_law(self) -> Controller:
        """Keepout's default law, led straight to the first goal: a prototype, and the gains of one that works."""
        return self.default_law_on(self.model.field, self.operation)

    def default_law_on(self, field: Field, operation: Operation) -> Controller:
        """Give the default law on another field, led straight to a goal far away; `tree_at` gives it the true one."""
        far = np.array([0.0, 0.0, 1.0]) * 2.0 * self.reach
        return profiles.default(field, operation, far, guidance=Straight(), reach=self.reach)

    @property
    def law_offset(self) -> float:
        """Value of the field, m, that the default law keeps: error bound, radius, margin and its nominal offset."""
        return self.offset + float(self.default_law.nominal_offset)

    def ways(self, offset: float) -> Float[np.ndarray, " flights"]:
        """Give the lengths of the shortest ways, kept in the folder of fields: they take minutes."""
        numbers = f"{self.model.sha256} {offset} {self.flights} {self.seed}"
        kept = self.folder / f"ways-{self.name}-{digest(numbers)[:16]}.npy"
        if self._ways is None and kept.exists():
            self._ways = np.load(kept)
        lengths = super().ways(offset)
        if not kept.exists():
            made = io.BytesIO()
            np.save(made, lengths)
            write_whole(kept, made.getvalue())
        return lengths

    def geodesic(self, start: Point, goal: Point) -> GeodesicGuidance:
        """Give the default law's geodesic guidance to a goal: planned once for all rivals.

        Raises:
            ControlError: no free way leads there.

        """
        key = (start.tobytes(), goal.tobytes())
        if key in self._geodesics:
            found, seconds = self._geodesics[key]
            self.seconds_spared += seconds
        else:
            began = time.perf_counter()
            found = self._plan(start, goal)
            self._geodesics[key] = (found, time.perf_counter() - began)
        if isinstance(found, ControlError):
            raise found
        return found

    def _plan(self, start: Point, goal: Point) -> GeodesicGuidance | ControlError:
        leader, offset = self.default_law.velocity.guidance, self.law_offset
        speed, slowing = float(leader.speed), float(leader.slowing_length)
        try:
            return geodesic_guidance(
                self.grid(offset), self.model.field, offset, goal, speed=speed, slowing_length=slowing, start=start
            )
        except ControlError as refusal:
            return refusal

    @functools.cached_property
    def guard(self) -> Guard:
        """The guard of the scenario, for starts and goals as far away as any pair's."""
        furthest = self.pairs.reshape(-1, 3)[np.argmax(np.linalg.norm(self.pairs.reshape(-1, 3), axis=1))]
        scenario = self.scenario.replace(start={"position": tuple(furthest)}, goal={"position": tuple(furthest)})
        return build_guard(Surroundings(scenario, self.target), offset=self.model.offset, closing_radius=0.25)

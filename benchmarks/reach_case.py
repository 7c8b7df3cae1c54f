"""What `reach.py` flies round: a target with its field, the pairs of starts and goals, and the shortest ways."""

from pathlib import Path

import numpy as np

from keepout.apps.reproduction.fitted import OFFSET, largest_gradient_error
from keepout.core.control.barrier_grid import BarrierGrid, travel_time
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.learning.training import fit
from keepout.core.mission.scenario import Scenario
from keepout.core.proof.certificate import certify
from keepout.flights.pages import terminal

FIELDS = Path(__file__).parent / "results" / "fields"
"""Fields that the kept rows were flown by."""
CLEARANCE = 0.5
"""Room round every start and goal, from the chaser's surface, m."""
ALONG = 0.1
"""Between samples of a straight way, m."""
TOGETHER = 100
"""Straight ways looked along at a time."""


class Case:
    """A target with its field, the pairs flown round it, and the lengths of the shortest free ways between them."""

    def __init__(self, source, folder, flights, seed):
        mesh, _, path = source.partition("=")
        built_in = Path(mesh).suffix == ""
        self.name = mesh if built_in else Path(mesh).stem
        self.target = Target.load(mesh) if built_in else Target.load(mesh, units="m")
        self.scenario = Scenario().replace(seed=seed)
        self.model = self._field(path, folder)
        self.flights, self.seed = flights, seed
        self.lower = self.target.vertices.min(axis=0) - 5.0
        self.upper = self.target.vertices.max(axis=0) + 5.0
        self._pairs = self._grid = self._ways = None
        self.guidances = {}
        """Of each pair, or why there is none."""

    def _field(self, path, folder):
        if path:
            return FieldModel.load(path, target=self.target)
        if self.name in shipped_names():
            return load_shipped(self.name, target=self.target)
        file = f"{self.name}-{self.target.sha256[:12]}.keepout"
        kept = folder / file
        for place in (kept, FIELDS / file):
            if place.exists():
                return FieldModel.load(place, target=self.target)
        with terminal.progress(f"field of {self.name}") as progress:
            model = fit(self.target, progress=lambda f, m: progress(0.8 * f, m))
            radius = self.scenario.chaser.radius
            model = certify(model, self.target, chaser_radius=radius, progress=lambda f, m: progress(0.8 + 0.2 * f, m))
        model.save(kept)
        return model

    @property
    def certificate(self):
        """The field's certificate for the chaser."""
        return self.model.certificate(self.scenario.chaser.radius)

    @property
    def offset(self):
        """What the barrier h takes off the field, m, without a law's own offset."""
        return self.certificate.error_bound + self.scenario.chaser.radius + self.scenario.safety.margin

    @property
    def gradient_error(self):
        """The largest ‖∇d − ∇f̃‖ sampled outside, as the reproduction of Case 3 takes it."""
        skin = {"offset": OFFSET} if self.name in shipped_names() else {"closing_radius": 0.25}
        return largest_gradient_error(self.model, OffsetSolid.build(self.target.distance, **skin), seed=0)

    @property
    def pairs(self):
        """Starts and goals (flights, 2, 3) m, uniform in the box, outside the target, with CLEARANCE of room."""
        if self._pairs is None:
            radius = self.scenario.chaser.radius
            solid = OffsetSolid.build(self.target.distance, closing_radius=min(radius, 0.25))
            generator = np.random.default_rng(self.seed)
            kept = np.empty((0, 3))
            while len(kept) < 2 * self.flights:
                points = generator.uniform(self.lower, self.upper, (4 * self.flights, 3))
                points = points[self.target.distance.distance(points) > radius + CLEARANCE]
                kept = np.concatenate([kept, points[solid.is_exterior(points)]])
            self._pairs = kept[: 2 * self.flights].reshape(self.flights, 2, 3)
        return self._pairs

    def grid(self, offset):
        """Barrier on a grid, for one offset (m): every law here has the same."""
        if self._grid is None:
            with terminal.progress(f"grid round {self.name}") as progress:
                self._grid = BarrierGrid.build(
                    self.model.field, offset, self.lower - 3.0, self.upper + 3.0, progress=progress
                )
        return self._grid

    def ways(self, offset):
        """Lengths (flights,) m of the shortest free ways: the straight one where it is free, else by fast marching.

        First-order marching over-states a length by a few per cent.
        """
        if self._ways is None:
            starts, goals = self.pairs[:, 0], self.pairs[:, 1]
            lengths = np.linalg.norm(goals - starts, axis=1)
            fractions = np.linspace(0.0, 1.0, int(np.ceil(lengths.max() / ALONG)))[:, None]
            free = np.empty(len(starts), dtype=bool)
            for begin in range(0, len(starts), TOGETHER):
                some = slice(begin, begin + TOGETHER)
                points = starts[some, None] + fractions * (goals - starts)[some, None]
                barrier = values(self.model.field, points.reshape(-1, 3)).reshape(points.shape[:2])
                free[some] = barrier.min(axis=1) > offset
            grid = self.grid(offset)
            speed = np.where(grid.values > 0.0, 1.0, 0.0)
            with terminal.progress(f"shortest ways round {self.name}") as progress:
                hidden = np.flatnonzero(~free)
                for done, i in enumerate(hidden):
                    node = grid.node(goals[i])
                    first = float(np.linalg.norm(grid.origin + grid.spacing * node - goals[i]))
                    reached = travel_time(speed, grid.walls, node[None], np.array([first]), grid.spacing)
                    lengths[i] = reached[tuple(grid.node(starts[i]))]
                    progress((done + 1) / len(hidden), "")
            self._ways = lengths
        return self._ways

    @property
    def seconds(self):
        """Length of a flight: twice the box's diagonal at the speed limit, and ten minutes."""
        way = 2.0 * float(np.linalg.norm(self.upper - self.lower))
        return round(600.0 + way / self.scenario.chaser.speed_limit)

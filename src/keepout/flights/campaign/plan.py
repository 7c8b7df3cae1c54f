"""A campaign made flyable: everything that a chunk of it depends on, and that makes it the same campaign again."""

import json
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import keepout
from keepout.core.digest import digest
from keepout.core.errors import ScenarioError
from keepout.core.fields.model import FieldModel
from keepout.core.flight.batches import BATCH
from keepout.core.flight.setup import flown_setup
from keepout.core.geometry.target import Target
from keepout.core.guard.guard import Guard
from keepout.core.mission.assumptions import guard_numbers
from keepout.core.mission.build import load_model, load_target
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, silent
from keepout.flights.campaign.bands import Bands
from keepout.flights.campaign.dispersion import Design, design
from keepout.flights.campaign.drawing import Run, draw
from keepout.flights.campaign.programs import Program, programs_of
from keepout.flights.campaign.workshop import Workshop

FORMAT = 2
"""To be raised when the same campaign would give other files."""

_PROBED = 16
"""Runs, from the first on, that settle which numbers vary within a compiled program."""
_MOST_BATCHES = 4
"""In a chunk; fewer where there are few batches, so that a kill loses little and every core has a chunk to fly."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A campaign as a value: with it and a number `fly_chunk` flies any part of it, on any machine, in any order.

    It pickles, with mesh, fields and grids; hand it to a worker once.

    Attributes:
        scenario: of all runs, with its `campaign` table.
        design: what varies.
        batch: flights flown at once by one compiled program. Results depend on it in their last bits, which a flight
            amplifies, so that it is part of what a campaign is.
        chunk: runs in a chunk, whole batches.
        programs: which numbers vary within one compiled program.
        workshop: what the missions share.
        target_sha256: digest of the scenario's own mesh.
        field_sha256: digest of its field.

    """

    scenario: Scenario
    design: Design
    batch: int
    chunk: int
    programs: tuple[Program, ...]
    workshop: Workshop
    target_sha256: str
    field_sha256: str

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return self.scenario.campaign.runs

    @property
    def chunks(self) -> int:
        """How many chunks there are, numbered from 0 on."""
        return -(-self.runs // self.chunk)

    def chunk_runs(self, number: int) -> tuple[int, int]:
        """Give a chunk's first run and the one after its last."""
        return number * self.chunk, min((number + 1) * self.chunk, self.runs)

    def draw(self, first: int, last: int) -> list[Run]:
        """Draw the runs from `first` up to `last`."""
        return draw(_of_a_run(self.scenario), self.design, self.workshop, first, last)

    def bands(self) -> Bands:
        """Begin the campaign's bands, with no flights."""
        return Bands.empty(self.scenario.duration, self.scenario.control.period)

    def guard_numbers(self) -> dict[str, Any] | None:
        """Give what the guard of the first run that can be flown assumes, and what follows; None without a guard."""
        guard = self.programs[0].setup.guard
        return guard_numbers(guard, self.scenario) if isinstance(guard, Guard) else None

    def identity(self) -> dict[str, Any]:
        """Give all that the campaign's table depends on, as JSON values: two campaigns are one where these agree."""
        return {
            "format": FORMAT,
            "scenario": json.loads(self.scenario.model_dump_json()),
            "batch": self.batch,
            "chunk": self.chunk,
            "target_sha256": self.target_sha256,
            "field_sha256": self.field_sha256,
            "versions": {"keepout": keepout.__version__, "jax": jax.__version__, "numpy": np.__version__},
        }

    @property
    def sha256(self) -> str:
        """Digest of `identity`."""
        return digest(json.dumps(self.identity(), sort_keys=True))

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        *,
        target: Target | None = None,
        model: FieldModel | None = None,
        batch: int | None = None,
        progress: Progress = silent,
    ) -> "Plan":
        """Build what a campaign's runs share, and look at its first few.

        Args:
            scenario: what to fly, with its `campaign` table.
            target: already loaded; else the scenario's.
            model: its field, already loaded; else the scenario's.
            batch: flights flown at once; by default 128, or all where there are fewer.
            progress: called while it is built.

        Raises:
            KeepoutError: what holds for every run is not valid, or none of the first runs can be flown.

        """
        varied = design(scenario)
        if batch is not None and batch < 1:
            raise ScenarioError(f"batch: {batch} flights; it must be at least 1")
        runs = scenario.campaign.runs
        batch = batch or min(runs, BATCH)
        workshop = Workshop()
        target = load_target(scenario.target) if target is None else target
        model = load_model(scenario, target) if model is None else model
        model.require_target(target, where="field")
        workshop.keep(target, model, scenario)
        progress(0.1, "preparing")
        probed = draw(_of_a_run(scenario), varied, workshop, 0, min(runs, _PROBED))
        flyable = [run.mission for run in probed if run.mission is not None]
        if not flyable:
            raise ScenarioError(f"campaign: none of the first {len(probed)} runs can be flown; {probed[0].refusal}")
        batches = -(-runs // batch)
        return cls(
            scenario,
            varied,
            batch,
            batch * int(np.clip(batches // 64, 1 if batches < 8 else 2, _MOST_BATCHES)),
            programs_of([flown_setup(mission.setup) for mission in flyable]),
            workshop,
            target.sha256,
            model.sha256,
        )


def _of_a_run(scenario: Scenario) -> Scenario:
    """Give what each run's scenario is made of: one without a campaign of its own, but for today's box of starts."""
    if not scenario.campaign.dispersions:
        return scenario
    at = scenario.start.position
    return scenario.replace(campaign={"runs": 1, "lower": at, "upper": at, "dispersions": {}, "sampling": "random"})

"""A campaign made flyable: everything that a chunk of it depends on, and that makes it the same campaign again.

Missions of its runs share what is costly (`Workshop`), and so do their compiled programs (`Program`). The setups of two
runs are flown by one program where they have the same structure and differ in small arrays only: these are then
stacked, one entry a flight. Which arrays are stacked is settled once for the whole campaign, from its first few runs,
and not for each batch, since a compiled program's last bits depend on it. A run that differs elsewhere is flown by a
program of its structure in which all small arrays are stacked: again whatever is flown beside it.
"""

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

import keepout
from keepout.core.control.geodesic import Geodesic
from keepout.core.control.guidance import Guidance, GuidancePlan, Point, Travel
from keepout.core.errors import ScenarioError
from keepout.core.fields.field import Field
from keepout.core.fields.model import FieldModel
from keepout.core.flight.batches import TARGET, usual_batch
from keepout.core.flight.setup import FlightSetup, flown_setup
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.guard.guard import Guard
from keepout.core.kept import digest
from keepout.core.mission.approach import LegPlan, wants_drift_safety
from keepout.core.mission.build import Mission, closing_radius, load_model, load_target, prepare
from keepout.core.mission.law import named_guidance
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import guard_numbers
from keepout.core.mission.zones import with_digests
from keepout.core.progress import Progress, silent
from keepout.flights.campaign.dispersion import Design, Run, design, draw

FORMAT = 2
"""To be raised when the same campaign would give other files."""

_PROBED = 16
"""Runs, from the first on, that settle which numbers vary within a compiled program."""
_MOST_BATCHES = 4
"""In a chunk; fewer where there are few batches, so that a kill loses little and every core has a chunk to fly.

Two batches or one are one chunk, which flies them side by side and keeps whole logs (`Plan.in_full`).
"""
_KEPT = 8
"""Of each kind: meshes, fields and grids take tens of megabytes."""
LARGE = 4096
"""Arrays of more numbers are shared, never stacked: networks and grids. Runs that differ in them fly apart."""


_ROW_BYTES = 400
"""Of a flight's whole log, a control step; with sensors somewhat more."""
_MOST_BYTES = 2**29
"""Of whole logs in memory at once."""


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

    def mission(self, scenario: Scenario) -> Mission:
        """Build a scenario.

        Raises:
            KeepoutError: it cannot be flown; the message names the entry.

        """
        with self._lock:
            if not scenario.disturbance.phase:
                return self._at_phase_zero(scenario)
            # No phase enters law, guard or bounds (`Surroundings.largest_disturbance`): they are made once for all.
            still = scenario.disturbance.model_copy(update={"phase": 0.0})
            mission = self._at_phase_zero(scenario.model_copy(update={"disturbance": still}))
            around = replace(mission.surroundings, scenario=scenario)
            return replace(mission, surroundings=around, setup=replace(mission.setup, disturbance=around.disturbance))

    def _at_phase_zero(self, scenario: Scenario) -> Mission:
        return self._missions.get(scenario.model_dump_json(), lambda: self._made(scenario))

    def keep(self, target: Target, model: FieldModel, scenario: Scenario) -> None:
        """Take a mesh and a field that are already loaded for a scenario's own."""
        self._targets.get(scenario.target.model_dump_json(), lambda: target)
        self._models.get(_field_of(scenario), lambda: model)

    def target(self, scenario: Scenario) -> Target:
        """Give a scenario's mesh."""
        return self._targets.get(scenario.target.model_dump_json(), lambda: load_target(scenario.target))

    def model(self, scenario: Scenario) -> FieldModel:
        """Give the field that a scenario flies by."""
        return self._models.get(_field_of(scenario), lambda: load_model(scenario, self.target(scenario)))

    def guard_field(self, scenario: Scenario, *, progress: Progress = silent) -> FieldModel:
        """Give the field of the guard of a scenario that has one."""
        target, model, radius = self.target(scenario), self.model(scenario), scenario.chaser.radius
        closing = closing_radius(model)
        return self._guards.get(
            (target.sha256, radius, model.offset, closing),
            lambda: guard_field(target, radius, offset=model.offset, closing_radius=closing, progress=progress),
        )

    def _made(self, scenario: Scenario) -> Mission:
        target, model = self.target(scenario), self.model(scenario)
        plan = named_guidance(scenario)
        if plan is None and scenario.control.profile == "default":
            plan = Geodesic()
        return prepare(
            scenario,
            target=target,
            model=model,
            guidance=_Remembered(plan, self._guidances, model.sha256) if isinstance(plan, Geodesic) else plan,
            guard_grid=self.guard_field(scenario) if scenario.guard.enabled else None,
        )


def _field_of(scenario: Scenario) -> Hashable:
    return scenario.field.model_dump_json(), scenario.target.model_dump_json()


@dataclass(frozen=True)
class _Remembered(GuidancePlan):
    """A geodesic guidance whose travel times are marched once for each field, keep-out zone, goal and start."""

    plan: Geodesic | LegPlan
    shelf: _Shelf
    field_sha256: str

    @property
    def refuses(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the plan that is remembered does."""
        return self.plan.refuses

    def of_legs(self, made: Callable[[GuidancePlan], GuidancePlan]) -> GuidancePlan:
        """Remember the guidance of all legs together."""
        plan = made(self.plan)
        assert isinstance(plan, LegPlan)
        return replace(self, plan=plan)

    def guidance(self, field: Field, offset: float, goal: Point, travel: Travel) -> Guidance:
        """Make the guidance, or give the one made before its speed and slowing length."""
        key = (
            self.field_sha256,
            float(offset),
            tuple(np.asarray(goal).tolist()),
            None if travel.start is None else tuple(np.asarray(travel.start).tolist()),
            *self.plan.identity(field),
        )
        made: Guidance = self.shelf.get(key, lambda: self.plan.guidance(field, offset, goal, travel))
        return self.plan.again(made, travel.speed, travel.slowing_length)


@dataclass(frozen=True, eq=False)
class Program:
    """A structure of setups, and which of its leaves are stacked.

    Attributes:
        setup: one that has the structure; its shared small leaves are those of all setups of the program.
        stacked: for each leaf, whether each flight has its own.

    """

    setup: FlightSetup
    stacked: tuple[bool, ...]

    def takes(self, setup: FlightSetup) -> bool:
        """Whether a setup (`flown_setup`) may be flown by this program."""
        if _structure(setup) != _structure(self.setup):
            return False
        return self.widened(setup).stacked == self.stacked

    @property
    def vary(self) -> FlightSetup | None:
        """A tree of truth values for the `vary` of `fly_batches`; None where nothing is stacked."""
        return jax.tree.unflatten(jax.tree.structure(self.setup), self.stacked) if any(self.stacked) else None

    @property
    def alike(self) -> tuple[str, ...]:
        """What of the target's motion flights have in common (`flight.batches.TARGET`): all where none varies it."""
        vary = self.vary
        turned = vary is not None and any(jax.tree.leaves(vary.motion))
        return ("time",) if turned else TARGET

    def widened(self, setup: FlightSetup) -> "Program":
        """Give the program that takes a setup of its structure too: what differs in small arrays is stacked."""
        pairs = zip(jax.tree.leaves(self.setup), jax.tree.leaves(setup), self.stacked, strict=True)
        return Program(self.setup, tuple(own or not (_is_large(a) or _same(a, b)) for a, b, own in pairs))

    def stack(self, setups: Sequence[FlightSetup]) -> FlightSetup:
        """Give the setup of flights that fly together: one entry a flight in the stacked leaves, else the first's."""
        if not any(self.stacked):
            return setups[0]
        columns = zip(*(jax.tree.leaves(setup) for setup in setups), strict=True)
        leaves = [
            np.stack([np.asarray(leaf) for leaf in column]) if own else column[0]
            for column, own in zip(columns, self.stacked, strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(setups[0]), leaves)


@dataclass(frozen=True, eq=False)
class Programs:
    """What flies the runs of a campaign.

    Attributes:
        known: settled for the campaign as a whole.
        seed: of the campaign.
        batch: flights flown at once by one program, a last batch filled up; 0: as many as `fly_batches` takes.

    """

    known: tuple[Program, ...]
    seed: int
    batch: int

    @classmethod
    def of(cls, missions: Sequence[Mission], batch: int) -> "Programs":
        """Settle the programs of a campaign from the missions of some of its runs."""
        made: list[Program] = []
        for setup in (flown_setup(mission.setup) for mission in missions):
            place = next((i for i, program in enumerate(made) if _structure(program.setup) == _structure(setup)), None)
            if place is None:
                made.append(Program(setup, tuple(False for _ in jax.tree.leaves(setup))))
            else:
                made[place] = made[place].widened(setup)
        return cls(tuple(made), missions[0].scenario.seed, batch)

    def find(self, setup: FlightSetup) -> tuple[Any, Program]:
        """Find the program of a setup (`flown_setup`), and a key that setups flown together have in common."""
        large = tuple(id(leaf) for leaf in jax.tree.leaves(setup) if _is_large(leaf))
        for i, program in enumerate(self.known):
            if program.takes(setup):
                return (i, large), program
        wide = Program(setup, tuple(_is_number(leaf) and not _is_large(leaf) for leaf in jax.tree.leaves(setup)))
        return ("wide", *_structure(setup), large), wide


def _structure(setup: FlightSetup) -> tuple[Any, ...]:
    """Give a setup's structure and the shapes of its leaves."""
    leaves, structure = jax.tree.flatten(setup)
    return structure, tuple(np.shape(leaf) for leaf in leaves)


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, float | int | np.ndarray | np.generic | jax.Array)


def _is_large(leaf: Any) -> bool:
    return np.size(leaf) > LARGE if _is_number(leaf) else True


def _same(one: Any, other: Any) -> bool:
    return one is other or np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)


@dataclass(frozen=True, eq=False)
class Plan:
    """A campaign as a value: with it and a number `fly_chunk` flies any part of it, on any machine, in any order.

    It pickles, with mesh, fields and grids; hand it to a worker once.

    Attributes:
        scenario: of all runs, with its `campaign` table.
        design: what varies.
        chunk: runs in a chunk, whole batches.
        programs: which numbers vary within one compiled program, and how many flights it flies at once. Results depend
            on both in their last bits, which a flight amplifies, so that they are part of what a campaign is.
        workshop: what the missions share.
        target_sha256: digest of the scenario's own mesh.
        field_sha256: digest of its field.
        keep: how many flights are wanted in full, those of least clearance; None: all.

    """

    scenario: Scenario
    design: Design
    chunk: int
    programs: Programs
    workshop: Workshop
    target_sha256: str
    field_sha256: str
    keep: int | None = 0

    @property
    def in_full(self) -> bool:
        """Whether its programs give out whole logs: all runs are one chunk, whose logs fit into memory.

        What is kept is then kept as it lands; else it is flown again, by another program.
        """
        steps = self.scenario.duration / self.scenario.control.period
        return self.chunks == 1 and self.runs * steps * _ROW_BYTES <= _MOST_BYTES

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return self.scenario.campaign.runs

    @property
    def batch(self) -> int:
        """Flights flown at once."""
        return self.programs.batch

    @property
    def chunks(self) -> int:
        """How many chunks there are, numbered from 0 on."""
        return -(-self.runs // self.chunk)

    def chunk_runs(self, number: int) -> tuple[int, int]:
        """Give a chunk's first run and the one after its last."""
        return number * self.chunk, min((number + 1) * self.chunk, self.runs)

    def draw(self, first: int, last: int) -> list[Run]:
        """Draw the runs from `first` up to `last`.

        Raises:
            ScenarioError: on this machine the mesh of a zone is not there, or is another.

        """
        with_digests(self.scenario)
        return draw(_of_a_run(self.scenario), self.design, self.workshop.mission, first, last)

    def guard_numbers(self) -> dict[str, Any] | None:
        """Give what the guard of the first run that can be flown assumes, and what follows; None without a guard."""
        guard = self.programs.known[0].setup.guard
        return guard_numbers(guard, self.scenario) if isinstance(guard, Guard) else None

    def identity(self) -> dict[str, Any]:
        """Give all that the campaign's table depends on, as JSON values: two campaigns are one where these agree.

        What is required of the flights is not among it: the same flights are judged by it anew.
        """
        return {
            "format": FORMAT,
            "scenario": json.loads(self.scenario.model_dump_json(exclude={"require"})),
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
            model: the scenario's field, already loaded; else the scenario's.
            batch: flights flown at once, a last batch filled up; by default 8, 32, 64 or 128, the least of which two
                take all runs.
            progress: called while it is built.

        Raises:
            KeepoutError: what holds for every run is not valid, or none of the first runs can be flown.

        """
        varied = design(scenario)
        if batch is not None and batch < 1:
            raise ScenarioError(f"batch: {batch} flights; it must be at least 1")
        target = load_target(scenario.target) if target is None else target
        model = load_model(scenario, target) if model is None else model
        model.require_target(target, where="field")
        scenario = with_digests(scenario)
        if wants_drift_safety(scenario):  # once for all runs, on the way of the scenario's own start
            scenario = prepare(scenario, target=target, model=model).scenario
            varied = design(scenario)
        runs = scenario.campaign.runs
        batch = batch or usual_batch(runs)
        workshop = Workshop()
        workshop.keep(target, model, scenario)
        progress(0.1, "preparing")
        probed = draw(_of_a_run(scenario), varied, workshop.mission, 0, min(runs, _PROBED))
        flyable = [run.mission for run in probed if run.mission is not None]
        if not flyable:
            raise ScenarioError(f"campaign: none of the first {len(probed)} runs can be flown; {probed[0].refusal}")
        batches = -(-runs // batch)
        return cls(
            scenario,
            varied,
            batch * (batches if batches <= 2 else int(np.clip(batches // 64, 1 if batches < 8 else 2, _MOST_BATCHES))),
            Programs.of(flyable, batch),
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

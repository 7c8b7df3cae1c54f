"""The pairs of `reach.py` flown with the guard: what `navigation.py` and `stuck_thrusters.py` have in common."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
from reach import travel_times, with_goals
from reach_case import Case

from keepout.core.audit.audit import Contact
from keepout.core.control.guidance import Straight
from keepout.core.flight.batches import BATCH, states_at
from keepout.core.mission.build import build_guard, closing_radius
from keepout.core.mission.flight import fly_audited
from keepout.core.mission.law import build_law, room_for_guard
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.pages import terminal


@dataclasses.dataclass(frozen=True)
class Flown:
    """What became of the pairs: the numbers of those flown, their outcomes and audits, and why the others were not."""

    pairs: np.ndarray
    outcome: object
    audits: tuple
    refused: list

    def figures(self):
        """Give the figures that every row has."""
        row = {"refused": len(self.refused), "reached": 0, "contacts": 0}
        if not len(self.pairs):
            return row
        return row | {
            "reached": int(self.outcome.reached.sum()),
            "contacts": sum(a.contact is Contact.YES for a in self.audits),
            "undecided": sum(a.contact is Contact.UNDECIDED for a in self.audits),
            "minimum_clearance_m": min(a.minimum_clearance for a in self.audits),
            "saturated_fraction": float(np.mean(self.outcome.saturated_fraction)),
            "guard_share": float(np.mean([a.guard_interventions / a.steps for a in self.audits])),
        }


class GuardedCase(Case):
    """A case flown by law and guard together, whose grid and guidances belong to one law's offset at a time."""

    _offset = None

    def furthest(self, **changes):
        """Give the scenario of a row: the farthest start and goal bound the drift for all."""
        points = self.pairs.reshape(-1, 3)
        furthest = tuple(points[np.argmax(np.linalg.norm(points, axis=1))].tolist())
        ends = {"start": {"position": furthest}, "goal": {"position": furthest}}
        return self.scenario.replace(**ends, duration=float(self.seconds), **changes)

    def setup(self, scenario):
        """Give the flight of a row, law and guard included, but without goals; the grid is then that of its law."""
        around = Surroundings(scenario, self.target)
        room = room_for_guard(around)
        reach = float(np.linalg.norm(self.pairs, axis=-1).max())
        law = build_law(scenario, self.model, guidance=Straight(), from_start=False, reach=reach, **room)
        guard = build_guard(around, offset=self.model.offset, closing_radius=closing_radius(self.model))
        self._use(self.offset + float(law.nominal_offset))
        return around.setup(law, guard=guard)

    def _use(self, offset):
        """Forget the grid and the guidances of another offset."""
        if self._offset != offset:
            self._offset, self._grid, self.guidances = offset, None, {}

    def fly(self, scenario, setup, title, vary, changed=lambda flown, part: flown):
        """Fly the pairs that a way joins, a batch at a time.

        Args:
            scenario: as `furthest` gives it.
            setup: as `setup` gives it, or with other parts but for the law.
            title: of the row, in messages.
            vary: entries of a flight that differ from pair to pair (`fly_audited`).
            changed: gives the flights of a batch, with their goals, as they are flown; it is told their pairs.

        """
        refused, pairs, outcomes, audits = [], [], [], []
        grid = self.grid(self._offset)
        with terminal.progress(title) as progress:
            for begin in range(0, self.flights, BATCH):
                part = np.arange(begin, min(begin + BATCH, self.flights))
                part, guidances = travel_times(self, grid, self._offset, setup.controller, part, refused)
                if len(part) == 0:
                    continue
                outcome, of_part = fly_audited(
                    scenario,
                    self.target,
                    changed(with_goals(setup, jnp.asarray(self.pairs[part, 1]), guidances), part),
                    states_at(setup.motion, self.pairs[part, 0]),
                    vary=vary,
                    batch=BATCH,
                    seed=self.seed + begin,
                    progress=lambda f, m, begin=begin: progress(
                        (begin + f * min(BATCH, self.flights - begin)) / self.flights, m
                    ),
                )
                pairs.extend(part)
                outcomes.append(outcome)
                audits.extend(of_part)
        for line in sorted(set(refused))[:3]:
            sys.stderr.write(f"{title}: refused: {line}\n")
        outcome = jax.tree.map(lambda *arrays: np.concatenate(arrays), *outcomes) if outcomes else None
        return Flown(np.array(pairs, dtype=int), outcome, tuple(audits), refused)

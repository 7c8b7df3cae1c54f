"""Fly the standard missions on what sensors say: does the law reach, without contact, and at what cost.

    python benchmarks/navigation.py --targets intelsat30 iss pocket ../shared/meshes/ssl1300.glb [--flights 1000]
        [--suites close wide late] [--estimates raw observer filter] [--out benchmarks/results/navigation.json] [--json]

The pairs of starts and goals are those of `reach.py`. Law and guard fly on on/off thrusters (`layout`, Δ-Σ, 20 ms), and
each flight is audited between samples. Suites: "close" is ± 0.05 m and ± 2 mm/s, once a period; "wide" ± 0.2 m and
± 10 mm/s; "late" is "close" with commands that take effect two periods late. Estimates: "raw", the last samples
alone; "observer", the samples and the law's own observer, as a law flew before there was a filter; "filter".

`delta_v_over_noise_free` is the median over the flights that reached of Δv over that of the same pair flown on
the true state (row "none") with the same thrusters. `refused` pairs, whose start or goal the law would not keep, count
as flights that did not reach. Rows are kept in `--out` as they are flown; a run that was stopped goes on from there.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import Rows, show
from reach import travel_times, with_goals
from reach_case import Case

import keepout
from keepout.audit.audit import Contact
from keepout.control.guidance.plan import Straight
from keepout.flight.batches import BATCH, states_at
from keepout.mission import environment
from keepout.mission.audited import fly_audited
from keepout.mission.build import build_guard, closing_radius, flight_setup
from keepout.mission.law import build_law, flown_law, room_for_guard
from keepout.mission.navigation import navigation
from keepout.report import terminal

SUITES = {
    "close": {},
    "wide": {"navigation": {"position_noise": 0.2, "velocity_noise": 0.01}},
    "late": {"guard": {"delay": 2}, "faults": {"delay": 2}},
}
ESTIMATES = ("raw", "observer", "filter")
PLACE = ("target", "suite", "estimate", "layout", "flights", "seed")
SETTINGS = ("field_sha256", "version")
SHOWN = ("target", "suite", "estimate", "flights", "refused", "reached", "contacts", "undecided")
SHOWN += ("minimum_clearance_m", "saturated_fraction", "delta_v_mps", "delta_v_over_noise_free", "guard_share")
SHOWN += ("uncertified", "flagged", "seconds")


def scenario_of(case, suite, estimate, layout):
    """Give the scenario of a row: the farthest start and goal bound the drift for all."""
    points = case.pairs.reshape(-1, 3)
    furthest = tuple(points[np.argmax(np.linalg.norm(points, axis=1))].tolist())
    changes = SUITES.get(suite, {})
    # The row without noise is flown with the same delay as those it is compared with.
    sensed = {} if estimate == "none" else {"suite": "close", "estimate": estimate} | changes.get("navigation", {})
    return case.scenario.replace(
        start={"position": furthest},
        goal={"position": furthest},
        duration=float(case.seconds),
        thrusters={"layout": layout, "modulation": "delta-sigma"},
        navigation=sensed,
        guard=changes.get("guard", {}),
        faults=changes.get("faults", {}),
    )


def fly_row(case, suite, estimate, layout):
    """Fly a row: its figures, and Δv of each pair (not a number where it was refused or did not reach)."""
    began, refused = time.perf_counter(), []
    scenario = scenario_of(case, suite, estimate, layout)
    room = room_for_guard(scenario, case.target)
    reach = float(np.linalg.norm(case.pairs, axis=-1).max())
    prototype = build_law(scenario, case.model, guidance=Straight(), from_start=False, reach=reach, **room)
    offset = case.offset + float(prototype.nominal_offset)
    guard = build_guard(scenario, case.target, offset=case.model.offset, closing_radius=closing_radius(case.model))
    setup = flight_setup(scenario, prototype, guard=guard)
    if estimate != "none":
        assumed = environment.guard_assumptions(scenario, case.target)
        setup = dataclasses.replace(setup, navigation=navigation(scenario, setup.motion, assumed))
    case.use(offset)
    grid = case.grid(offset)
    found = {name: [] for name in ("pairs", "outcomes", "audits")}
    with terminal.progress(f"{case.name}, {suite}, {estimate}") as progress:
        for begin in range(0, case.flights, BATCH):
            part = np.arange(begin, min(begin + BATCH, case.flights))
            part, guidances = travel_times(case, grid, offset, prototype, part, refused)
            if len(part) == 0:
                continue
            outcome, audits = fly_audited(
                scenario,
                case.target,
                delayed(scenario, case, with_goals(setup, jnp.asarray(case.pairs[part, 1]), guidances)),
                states_at(setup.motion, case.pairs[part, 0]),
                vary=(lambda s: (s.goal, s.controller.law.velocity.guidance))
                if scenario.guard.delay
                else (lambda s: (s.goal, s.controller.velocity.guidance)),
                batch=BATCH,
                seed=case.seed + begin,
                progress=lambda f, m, begin=begin: progress(
                    (begin + f * min(BATCH, case.flights - begin)) / case.flights, m
                ),
            )
            for name, value in (("pairs", part), ("outcomes", outcome), ("audits", audits)):
                found[name].append(value)
    for line in sorted(set(refused))[:3]:
        sys.stderr.write(f"{case.name} {suite} {estimate}: refused: {line}\n")
    return figures(case, found, len(refused)) | {"seconds": time.perf_counter() - began}


def delayed(scenario, case, setup):
    """Tell the law of the delay, now that it has its goals."""
    return dataclasses.replace(setup, controller=flown_law(scenario, setup.controller, case.model))


def figures(case, found, refused):
    """Give a row's figures."""
    row = {"refused": refused, "reached": 0, "contacts": 0}
    if not found["pairs"]:
        return row | {"delta_v": [None] * case.flights}
    outcome = jax.tree.map(lambda *arrays: np.concatenate(arrays), *found["outcomes"])
    audits, pairs = sum(found["audits"], ()), np.concatenate(found["pairs"])
    delta_v = np.full(case.flights, np.nan)
    delta_v[pairs] = np.where(outcome.reached, outcome.delta_v, np.nan)
    return row | {
        "reached": int(outcome.reached.sum()),
        "contacts": sum(a.contact is Contact.YES for a in audits),
        "undecided": sum(a.contact is Contact.UNDECIDED for a in audits),
        "minimum_clearance_m": min(a.minimum_clearance for a in audits),
        "saturated_fraction": float(np.mean(outcome.saturated_fraction)),
        "delta_v_mps": float(np.nanmedian(delta_v)) if np.isfinite(delta_v).any() else None,
        "guard_share": float(np.mean([a.guard_interventions / a.steps for a in audits])),
        "flagged": int(np.sum(outcome.guard_flags != 0)),
        "delta_v": [None if np.isnan(value) else round(float(value), 6) for value in delta_v],
    }


class GuardedCase(Case):
    """A case whose grid and guidances belong to one offset at a time."""

    _offset = None

    def use(self, offset):
        """Forget the grid and the guidances of another offset."""
        if self._offset != offset:
            self._offset, self._grid, self.guidances = offset, None, {}


def compared(row, free):
    """Add what the flights cost over those on the true state."""
    pairs = [(one, other) for one, other in zip(row["delta_v"], free["delta_v"], strict=True) if one and other]
    ratio = float(np.median([one / other for one, other in pairs])) if pairs else None
    return {name: value for name, value in row.items() if name != "delta_v"} | {"delta_v_over_noise_free": ratio}


def main():
    arguments = parsed()
    rows = Rows(arguments.out, PLACE, SETTINGS)
    shown = []
    for source in arguments.targets:
        case = GuardedCase(source, Path("out/navigation"), arguments.flights, 0)
        for suite in arguments.suites:
            free = None
            for estimate in ("none", *arguments.estimates):
                # Without noise nothing tells the wide suite from the close one.
                named = "close" if estimate == "none" and suite == "wide" else suite
                plan = dict(zip(PLACE, (case.name, named, estimate, arguments.layout, case.flights, 0), strict=True))
                plan |= dict(zip(SETTINGS, (case.model.sha256, keepout.__version__), strict=True))
                row = rows.find(plan)
                if row is None:
                    try:
                        row = plan | fly_row(case, named, estimate, arguments.layout)
                    except keepout.KeepoutError as refusal:
                        sys.stderr.write(f"{case.name} {suite} {estimate}: {refusal}\n")
                        row = plan | {"refused": case.flights, "reached": 0, "contacts": 0}
                        row |= {"delta_v": [None] * case.flights, "reason": str(refusal)}
                    rows.keep(row)
                free = row if estimate == "none" else free
                shown.append(compared(row, free))
    if arguments.json:
        sys.stdout.write(json.dumps(shown, indent=2) + "\n")
    else:
        show(shown, [name for name in SHOWN if any(name in row for row in shown)])


def parsed():
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--targets", nargs="+", default=["intelsat30"], help="built-in targets or mesh files in metres")
    parser.add_argument("--flights", type=int, default=1000, help="pairs round each target")
    parser.add_argument("--suites", nargs="+", choices=SUITES, default=["close"])
    parser.add_argument("--estimates", nargs="+", choices=ESTIMATES, default=list(ESTIMATES))
    parser.add_argument("--layout", default="six", help="of the thrusters: six, 12, 24, or ideal")
    parser.add_argument("--out", type=Path, help="JSON file of the rows")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser.parse_args()


if __name__ == "__main__":
    main()

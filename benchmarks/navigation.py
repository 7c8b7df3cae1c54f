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

import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
from guarded_case import GuardedCase
from kept_rows import Rows, command, tell

import keepout
from keepout.core.mission.law import broken_as
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.navigation.suites import navigation

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
    """Give the scenario of a row."""
    changes = SUITES.get(suite, {})
    # The row without noise is flown with the same delay as those it is compared with.
    sensed = {} if estimate == "none" else {"suite": "close", "estimate": estimate} | changes.get("navigation", {})
    return case.furthest(
        thrusters={"layout": layout, "modulation": "delta-sigma"},
        navigation=sensed,
        guard=changes.get("guard", {}),
        faults=changes.get("faults", {}),
    )


def fly_row(case, suite, estimate, layout):
    """Fly a row: its figures, and Δv of each pair (not a number where it was refused or did not reach)."""
    began = time.perf_counter()
    scenario = scenario_of(case, suite, estimate, layout)
    setup = case.setup(scenario)
    if estimate != "none":
        assumed = Surroundings(scenario, case.target).guard_assumptions
        setup = dataclasses.replace(setup, navigation=navigation(scenario, setup.motion, assumed))

    def of_each(s):
        law = s.controller.law if scenario.guard.delay else s.controller
        return s.goal, law.velocity.guidance

    def delayed(flown, _):
        """Tell the law of the delay, now that it has its goals."""
        return dataclasses.replace(flown, controller=broken_as(scenario, flown.controller, case.model.field))

    flown = case.fly(scenario, setup, f"{case.name}, {suite}, {estimate}", of_each, delayed)
    return figures(case, flown) | {"seconds": time.perf_counter() - began}


def figures(case, flown):
    """Give a row's figures."""
    row = flown.figures()
    if not len(flown.pairs):
        return row | {"delta_v": [None] * case.flights}
    delta_v = np.full(case.flights, np.nan)
    delta_v[flown.pairs] = np.where(flown.outcome.reached, flown.outcome.delta_v, np.nan)
    return row | {
        "delta_v_mps": float(np.nanmedian(delta_v)) if np.isfinite(delta_v).any() else None,
        "flagged": int(np.sum(flown.outcome.guard_flags != 0)),
        "delta_v": [None if np.isnan(value) else round(float(value), 6) for value in delta_v],
    }


def compared(row, free):
    """Add what the flights cost over those on the true state."""
    pairs = [(one, other) for one, other in zip(row["delta_v"], free["delta_v"], strict=True) if one and other]
    ratio = float(np.median([one / other for one, other in pairs])) if pairs else None
    return {name: value for name, value in row.items() if name != "delta_v"} | {"delta_v_over_noise_free": ratio}


def main():
    parser = command(__doc__)
    parser.add_argument("--targets", nargs="+", default=["intelsat30"], help="built-in targets or mesh files in metres")
    parser.add_argument("--flights", type=int, default=1000, help="pairs round each target")
    parser.add_argument("--suites", nargs="+", choices=SUITES, default=["close"])
    parser.add_argument("--estimates", nargs="+", choices=ESTIMATES, default=list(ESTIMATES))
    parser.add_argument("--layout", default="six", help="of the thrusters: six, 12, 24, or ideal")
    parser.add_argument("--out", type=Path, help="JSON file of the rows")
    arguments = parser.parse_args()
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
    tell(shown, arguments, [name for name in SHOWN if any(name in row for row in shown)])


if __name__ == "__main__":
    main()

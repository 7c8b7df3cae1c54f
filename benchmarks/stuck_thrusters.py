"""Stick every thruster of a layout, off and on, and fly: does the guard's theorem cover it, and is anything touched.

    python benchmarks/stuck_thrusters.py [--targets intelsat30 tiangong] [--flights 384] [--layouts 12] [--json]
        [--out benchmarks/results/stuck_thrusters.json]

A row for each target, layout and way to stick: the flights are spread evenly over the thrusters, from the pairs of
starts and goals of `reach.py`. A thruster sticks 20 s after the start and is known `--detection` seconds later; until
then the others are fired as if it worked. `covered` says whether the scenario declares it (`thrusters.survive_failure`)
and the guard could be built for it; only there is no contact a promise. Flights start certified and are audited between
samples.
"""

import dataclasses
import functools
import time
from pathlib import Path

import jax
import numpy as np
from guarded_case import GuardedCase
from kept_rows import Rows, command, tell

import keepout
from keepout.core.flight.batches import states_at
from keepout.core.guard.start import starts_certified
from keepout.core.mission.surroundings import Surroundings

STUCK_FROM = 20.0
"""Seconds after the start: on the way, at full speed."""
FORCE = {"12": 0.1, "24": 0.0334}
"""Of each thruster, N: so much that the others give chaser.force_limit, 0.1 N, when one is stuck."""
COUNT = {"12": 12, "24": 24}
PLACE, SETTINGS = ("target", "layout", "stuck", "flights", "detection_s", "seed"), ("field_sha256", "version")
SHOWN = (*PLACE[:-1], "covered", "reached", "contacts", "undecided", "minimum_clearance_m", "uncertified_starts")
SHOWN += ("guard_share", "saturated_fraction", "delta_v_mps", "propellant_kg", "seconds")


def fly_row(case, layout, stuck, detection):
    """Fly a row, and give its figures."""
    began = time.perf_counter()
    chosen = {"layout": layout, "force": FORCE[layout], "survive_failure": True, "detection_time": detection}
    scenario = case.furthest(thrusters=chosen)
    setup = case.setup(scenario)
    told = {"thruster_stuck": stuck, "stuck_from": STUCK_FROM}
    faulty = [Surroundings(scenario.replace(faults=told | {"thruster": i})).thrusters for i in range(COUNT[layout])]

    def of_each(s):
        return s.goal, s.controller.velocity.guidance, s.thrusters

    def struck(flown, part):
        each = jax.tree.map(lambda *leaves: np.stack(leaves), *(faulty[i % len(faulty)] for i in part))
        return dataclasses.replace(flown, thrusters=each)

    flown = case.fly(scenario, setup, f"{case.name}, {layout}, stuck {stuck}", of_each, struck)
    row = {"covered": True} | flown.figures()
    if len(flown.pairs):
        starts = states_at(setup.motion, case.pairs[flown.pairs, 0])
        row |= {
            "uncertified_starts": int(np.sum(~starts_certified(setup.guard, starts))),
            "delta_v_mps": float(np.median(flown.outcome.delta_v)),
            "propellant_kg": float(np.median(flown.outcome.propellant)),
        }
    return row | {"seconds": time.perf_counter() - began}


def flown(case, layout, stuck, detection):
    """Fly a row, or say why not."""
    try:
        return fly_row(case, layout, stuck, detection)
    except keepout.KeepoutError as refusal:
        return {"covered": False, "reason": str(refusal)}


def main():
    parser = command(__doc__)
    parser.add_argument("--targets", nargs="+", default=["intelsat30", "tiangong"])
    parser.add_argument("--flights", type=int, default=384, help="of each row")
    parser.add_argument("--layouts", nargs="+", choices=sorted(FORCE), default=["12"])
    parser.add_argument("--detection", type=float, default=3.0, help="s until a stuck thruster is known")
    parser.add_argument("--out", type=Path, help="JSON file of the rows")
    arguments = parser.parse_args()
    rows, shown = Rows(arguments.out, PLACE, SETTINGS), []
    for source in arguments.targets:
        case = GuardedCase(source, Path("out/navigation"), arguments.flights, 0)
        for layout in arguments.layouts:
            for stuck in ("off", "on"):
                place = (case.name, layout, stuck, case.flights, arguments.detection, 0)
                plan = dict(zip(PLACE, place, strict=True))
                plan |= dict(zip(SETTINGS, (case.model.sha256, keepout.__version__), strict=True))
                shown.append(rows.made(plan, functools.partial(flown, case, layout, stuck, arguments.detection)))
    tell(shown, arguments, [name for name in (*SHOWN, "reason") if any(name in row for row in shown)])


if __name__ == "__main__":
    main()

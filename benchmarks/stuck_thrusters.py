"""Stick every thruster of a layout, off and on, and fly: does the guard's theorem cover it, and is anything touched.

    python benchmarks/stuck_thrusters.py [--targets intelsat30 tiangong] [--flights 384] [--layouts 12] [--json]
        [--out benchmarks/results/stuck_thrusters.json]

A row for each target, layout and way to stick: the flights are spread evenly over the thrusters, from the pairs of
starts and goals of `reach.py`. A thruster sticks 20 s after the start and is known `--detection` seconds later; until
then the others are fired as if it worked. `covered` says whether the scenario declares it (`thrusters.survive_failure`)
and the guard could be built for it; only there is no contact a promise. Flights start certified and are audited between
samples.
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
from navigation import GuardedCase
from reach import travel_times, with_goals

import keepout
from keepout.audit.audit import Contact
from keepout.control.guidance.plan import Straight
from keepout.flight.batches import BATCH, states_at
from keepout.guard.start import starts_certified
from keepout.mission.audited import fly_audited
from keepout.mission.build import build_guard, closing_radius, flight_setup
from keepout.mission.law import build_law, room_for_guard
from keepout.mission.thrusters import thrusters
from keepout.report import terminal

STUCK_FROM = 20.0
"""Seconds after the start: on the way, at full speed."""
FORCE = {"12": 0.1, "24": 0.0334}
"""Of each thruster, N: so much that the others give chaser.force_limit, 0.1 N, when one is stuck."""
COUNT = {"12": 12, "24": 24}
PLACE, SETTINGS = ("target", "layout", "stuck", "flights", "detection_s", "seed"), ("field_sha256", "version")
SHOWN = (*PLACE[:-1], "covered", "reached", "contacts", "undecided", "minimum_clearance_m", "uncertified_starts")
SHOWN += ("guard_share", "saturated_fraction", "delta_v_mps", "propellant_kg", "seconds")


def scenario_of(case, layout, detection):
    """Give the scenario of a row: the farthest start and goal bound the drift for all."""
    points = case.pairs.reshape(-1, 3)
    furthest = tuple(points[np.argmax(np.linalg.norm(points, axis=1))].tolist())
    chosen = {"layout": layout, "force": FORCE[layout], "survive_failure": True, "detection_time": detection}
    return case.scenario.replace(
        start={"position": furthest}, goal={"position": furthest}, duration=float(case.seconds), thrusters=chosen
    )


def fly_row(case, layout, stuck, detection):
    """Fly a row, and give its figures."""
    began, refused = time.perf_counter(), []
    scenario = scenario_of(case, layout, detection)
    room = room_for_guard(scenario, case.target)
    reach = float(np.linalg.norm(case.pairs, axis=-1).max())
    prototype = build_law(scenario, case.model, guidance=Straight(), from_start=False, reach=reach, **room)
    offset = case.offset + float(prototype.nominal_offset)
    guard = build_guard(scenario, case.target, offset=case.model.offset, closing_radius=closing_radius(case.model))
    setup = flight_setup(scenario, prototype, guard=guard)
    faulty = [
        thrusters(scenario.replace(faults={"thruster": i, "thruster_stuck": stuck, "stuck_from": STUCK_FROM}))
        for i in range(COUNT[layout])
    ]
    case.use(offset)
    grid = case.grid(offset)
    outcomes, all_audits, uncertified = [], [], 0
    with terminal.progress(f"{case.name}, {layout}, stuck {stuck}") as progress:
        for begin in range(0, case.flights, BATCH):
            part = np.arange(begin, min(begin + BATCH, case.flights))
            part, guidances = travel_times(case, grid, offset, prototype, part, refused)
            flown = with_goals(setup, jnp.asarray(case.pairs[part, 1]), guidances)
            chosen = [faulty[i % len(faulty)] for i in part]
            flown = dataclasses.replace(flown, thrusters=jax.tree.map(lambda *leaves: np.stack(leaves), *chosen))
            initial = states_at(setup.motion, case.pairs[part, 0])
            uncertified += int(np.sum(~starts_certified(guard, initial)))
            outcome, audits = fly_audited(
                scenario,
                case.target,
                flown,
                initial,
                vary=lambda s: (s.goal, s.controller.velocity.guidance, s.thrusters),
                batch=BATCH,
                seed=case.seed + begin,
                progress=lambda f, m, begin=begin: progress((begin + f * min(BATCH, case.flights)) / case.flights, m),
            )
            outcomes.append(outcome)
            all_audits.extend(audits)
    for line in sorted(set(refused))[:3]:
        sys.stderr.write(f"{case.name} {layout} {stuck}: refused: {line}\n")
    outcome = jax.tree.map(lambda *arrays: np.concatenate(arrays), *outcomes)
    return {
        "covered": True,
        "refused": len(refused),
        "reached": int(outcome.reached.sum()),
        "contacts": sum(a.contact is Contact.YES for a in all_audits),
        "undecided": sum(a.contact is Contact.UNDECIDED for a in all_audits),
        "minimum_clearance_m": min(a.minimum_clearance for a in all_audits),
        "uncertified_starts": uncertified,
        "guard_share": float(np.mean([a.guard_interventions / a.steps for a in all_audits])),
        "saturated_fraction": float(np.mean(outcome.saturated_fraction)),
        "delta_v_mps": float(np.median(outcome.delta_v)),
        "propellant_kg": float(np.median(outcome.propellant)),
        "seconds": time.perf_counter() - began,
    }


def main():
    arguments = parsed()
    rows, shown = Rows(arguments.out, PLACE, SETTINGS), []
    for source in arguments.targets:
        case = GuardedCase(source, Path("out/navigation"), arguments.flights, 0)
        for layout in arguments.layouts:
            for stuck in ("off", "on"):
                place = (case.name, layout, stuck, case.flights, arguments.detection, 0)
                plan = dict(zip(PLACE, place, strict=True))
                plan |= dict(zip(SETTINGS, (case.model.sha256, keepout.__version__), strict=True))
                row = rows.find(plan)
                if row is None:
                    try:
                        row = plan | fly_row(case, layout, stuck, arguments.detection)
                    except keepout.KeepoutError as refusal:
                        row = plan | {"covered": False, "reason": str(refusal)}
                    rows.keep(row)
                shown.append(row)
    if arguments.json:
        sys.stdout.write(json.dumps(shown, indent=2) + "\n")
    else:
        show(shown, [name for name in (*SHOWN, "reason") if any(name in row for row in shown)])


def parsed():
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--targets", nargs="+", default=["intelsat30", "tiangong"])
    parser.add_argument("--flights", type=int, default=384, help="of each row")
    parser.add_argument("--layouts", nargs="+", choices=sorted(FORCE), default=["12"])
    parser.add_argument("--detection", type=float, default=3.0, help="s until a stuck thruster is known")
    parser.add_argument("--out", type=Path, help="JSON file of the rows")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser.parse_args()


if __name__ == "__main__":
    main()

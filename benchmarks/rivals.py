"""Fly Keepout's laws and what an expert would pick instead on one loop, on equal terms.

    python benchmarks/rivals.py [--rivals NAME …] [--targets intelsat30 iss pocket ../shared/meshes/ssl1300.glb]
        [--flights 500] [--guard | --no-guard] [--out benchmarks/results/rivals.json] [--json] [--figure | --sweep]

Every rival has the same dynamics, thruster limits, disturbance, starts, goals and speed limit, and is judged between
samples by the same audit on the exact mesh. Pairs of start and goal keep 0.5 m between chaser and mesh
(`reach_case.py`). One row a rival, target and guard: alone, and with Keepout's guard under it. Flights that are
`refused` (start or goal inside a rival's envelope, say) count as not reached. `time_over_bound` (median of time to
reach over shortest way / speed limit), `delta_v_mps` and `plan_s` are medians over flights; `step_ms` is the median
control step on board, one flight on one core. A rival whose package is missing has a row that says what to install.

Each row is written to `--out` as soon as it is flown. Rows already there with the same settings (`digest`) are printed,
not flown again; so a run that was stopped goes on. `--figure` draws all rivals on one start and goal instead. `--sweep`
flies each rival at each of its `choices`, 64 pairs of seed 1 round `intelsat30` without the guard (fewer where it is
slow), one row a setting.
"""

import argparse
import dataclasses
import functools
import itertools
import warnings
from pathlib import Path

import kept_rows
from kept_rows import command, tell
from rivals_laws.registry import RIVALS
from rivals_laws.rival_case import RivalCase
from rivals_laws.rows import COLUMNS, PLACE, SETTINGS, Rows, flown_row, planned

from keepout.core.control.profiles import ControlWarning
from keepout.flights.pages import terminal

TARGETS = ("intelsat30", "iss", "pocket", "../shared/meshes/ssl1300.glb")
HERE = Path(__file__).resolve().parent
SHOWN = (*COLUMNS[: COLUMNS.index("step_ms") + 1], "refused", "plan_s", "largest_speed_mps", "note")


SWEEP = HERE / "results" / "rival_sweeps.json"


def sweep(arguments):
    store, rows = kept_rows.Rows(SWEEP, place=(*PLACE, "setting"), settings=SETTINGS), []
    case = RivalCase("intelsat30", arguments.fields, 64, 1)
    for rival in (rival for rival in RIVALS if rival.name in arguments.rivals and rival.choices):
        for numbers in itertools.product(*rival.choices.values()):
            setting = dict(zip(rival.choices, numbers))
            tried = dataclasses.replace(rival, **setting)
            plan = planned(case, tried, False, rival.swept) | {"setting": setting, "chosen": tried == rival}
            with terminal.progress(f"{rival.name}, {setting}") as progress:
                row = store.made(plan, functools.partial(flown_row, case, tried, plan, progress))
            rows.append(row | {"chosen": plan["chosen"]})
            store.keep(rows[-1])
    return rows


def fly_all(arguments):
    store, rows = Rows(arguments.out), []
    guards = (False, True) if arguments.guard is None else (arguments.guard,)
    for source in arguments.targets:
        case = RivalCase(source, arguments.fields, arguments.flights, arguments.seed)
        for rival in (rival for rival in RIVALS if rival.name in arguments.rivals):
            for guarded in guards:
                plan = planned(case, rival, guarded, arguments.flights)
                with terminal.progress(f"{rival.name}, {case.name}") as progress:
                    rows.append(store.made(plan, functools.partial(flown_row, case, rival, plan, progress)))
    return rows


def main():
    parser = command(__doc__)
    names = [rival.name for rival in RIVALS]
    parser.add_argument("--rivals", nargs="+", default=names, choices=names, metavar="NAME", help=", ".join(names))
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), help="names, mesh files in m, or MESH=FIELD")
    parser.add_argument("--flights", type=int, default=500, help="pairs for each row")
    parser.add_argument("--guard", action=argparse.BooleanOptionalAction, help="only with, or only without the guard")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "rivals.json", help="rows flown so far")
    parser.add_argument("--fields", type=Path, default=Path("out"), help="folder of fields fitted to mesh files")
    parser.add_argument("--figure", action="store_true", help="draw paths into docs/figures instead")
    parser.add_argument("--sweep", action="store_true", help="fly the choices of each rival instead")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ControlWarning)
    arguments.fields.mkdir(parents=True, exist_ok=True)
    if arguments.figure:
        from rivals_laws.figure import draw

        draw([rival for rival in RIVALS if rival.name in arguments.rivals], arguments.fields, arguments.seed)
        return
    if arguments.sweep:
        shown = ("rival", "setting", "chosen", "flights", "reached_without_contact", "contacts", "time_over_bound")
        tell(sweep(arguments), arguments, shown)
        return
    rows = fly_all(arguments)
    tell(rows, arguments, SHOWN)


if __name__ == "__main__":
    main()

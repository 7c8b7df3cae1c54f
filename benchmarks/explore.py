"""A target nobody has a model of: what the known-free map says falsely, how close it comes, and whole flights by it.

Run: python benchmarks/explore.py [PART ...] [--targets NAME ...] [--out FILE] [--json] and the options below.

Parts:
  approaches  random approaches to closed targets, errors at their bounds with adversarial signs: no cube that is said
              to be free may meet a triangle, and the field may over-state nowhere
  sheets      the same with meshes as they are in their files, whose sheets have no thickness: no sensor is promised to
              see those edge-on, so that what is left is counted
  broken      the same as `approaches` with one promise of the sensor broken: here bad cubes must be found
  accuracy    the same with random errors: gap from the seen surface to free room, and distance less field 1 m out
  flights     whole flights to goals near targets of which a panel is not where the mission believes (not by default)
  ordinary    the same flights by an ordinary truncated-distance map, to which the unseen is free (not by default)

Rows are kept in the file as they come, and none is made twice with the same settings.
"""

import json
import sys
from pathlib import Path

from closed_targets import FILES, NAMES
from explore_approaches import ACCURATE, BROKEN, OUTSIDE, SOUND, VIEWS, Approaching, run
from explore_flights import PILOTS, flight, row
from kept_rows import Rows, command, tell

OUT = Path(__file__).with_name("results") / "explore.json"
SENSORS = {"approaches": (SOUND,), "accuracy": ACCURATE, "broken": BROKEN, "sheets": (SOUND,)}
SPACING = {"tiangong": 0.2}
"""Metres, where it is not 0.1: the ball round Tiangong holds 734³ cubes of 0.1 m, 1.2 GB a map."""
FEWER = 10
"""The maps of other sensors than the sound one are checked at one so manieth of the points."""
PLACE = ("part", "target", "mesh", *SOUND.told, "seed")
SETTINGS = ("approaches", "views_each", "spacing_m", "outside_m")
COLUMNS = (*PLACE, "approaches", "bad_cubes", "over_statements", "points", "gap_p95_m", "under_median_m", "under_p95_m")
COLUMNS += ("contacts", "complete")
DURATION = 6000.0
"""Of a flight at most, s."""


def say(text):
    """Tell how it goes on."""
    print(text, file=sys.stderr, flush=True)


def fly_approaches(arguments, rows):
    """Make the rows of the parts asked for: of one target and mesh together, so that rays are cast once."""
    parts = [part for part in SENSORS if part in arguments.parts]
    for name in arguments.targets:
        for mesh in ("closed", "as it is"):
            spacing = SPACING.get(name, 0.1)
            plans = []
            for part in parts:
                if (part == "sheets") is (mesh == "as it is") and (part != "sheets" or name in FILES):
                    plans += [_plan(arguments, part, name, mesh, sensor, spacing) for sensor in SENSORS[part]]
            plans = [plan for plan in plans if rows.find(plan) is None]
            if not plans:
                continue
            found = run(
                name,
                mesh,
                [plan["sensor"] for plan in plans],
                Approaching(arguments.approaches, arguments.views, spacing, arguments.seed),
                points=[arguments.points // (1 if plan["sensor"] == SOUND else FEWER) for plan in plans],
                say=say,
            )
            for plan, made in zip(plans, found, strict=True):
                rows.keep({"part": plan["part"]} | made)
                say(json.dumps(rows.kept[-1]))


def fly_missions(arguments, rows):
    """Make the rows of whole flights: the pilots asked for fly the same ones."""
    for seed in range(arguments.seed, arguments.seed + arguments.flights):
        name = arguments.targets[seed % len(arguments.targets)]
        spacing, drawn = SPACING.get(name, 0.1), None
        for part in PILOTS:
            like = {"part": part, "target": name, "seed": seed, "spacing_m": spacing}
            if part not in arguments.parts or any(like.items() <= kept.items() for kept in rows.kept):
                continue
            drawn = drawn or flight(name, seed, spacing=spacing, duration=DURATION)
            rows.keep(row(part, drawn, name))
            say(json.dumps(rows.kept[-1]))


def _plan(arguments, part, name, mesh, sensor, spacing):
    place = {"part": part, "target": name, "mesh": mesh, "seed": arguments.seed, "sensor": sensor, **sensor.told}
    settings = (arguments.approaches, arguments.views, spacing, OUTSIDE)
    return place | dict(zip(SETTINGS, settings, strict=True))


def main():
    """Make the rows that are asked for and not kept yet, and print them all."""
    parser = command(__doc__)
    parser.add_argument("parts", nargs="*", default=list(SENSORS), help=f"of {', '.join((*SENSORS, *PILOTS))}")
    parser.add_argument("--flights", type=int, default=200, help="with seeds from --seed on, over the targets in turn")
    parser.add_argument("--targets", nargs="+", default=list(NAMES), help=f"of {', '.join(NAMES)}")
    parser.add_argument("--approaches", type=int, default=20, help="to each target")
    parser.add_argument("--views", type=int, default=VIEWS, help="of each approach")
    parser.add_argument("--points", type=int, default=2_000_000, help="at which a sound map's field is checked")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=OUT, help="rows kept")
    arguments = parser.parse_args()
    for part in arguments.parts:
        if part not in SENSORS and part not in PILOTS:
            parser.error(f"no part {part!r}; it must be one of {', '.join((*SENSORS, *PILOTS))}")
    rows = Rows(arguments.out, PLACE, SETTINGS)
    fly_approaches(arguments, rows)
    fly_missions(arguments, rows)
    tell(rows.kept, arguments, COLUMNS)


if __name__ == "__main__":
    main()

"""The evidence for the exported C: what was asked, what was reached, each part by itself.

python benchmarks/flight_code.py                              # every part, a few minutes a mission
python benchmarks/flight_code.py answers --steps 72000 --directed 72000 --missions 17 --kept out/flight-code
python benchmarks/flight_code.py fuzz --fuzz 10000000 --kept out/flight-code --out benchmarks/results/flight_code.json

`answers` compares with Python (`flight_code_states`, `_directed`, `_thrusters`, `_navigation`) and leaves the
folders of the missions in `--kept`, with stored steps; the other parts take them from there. A tool that is not there
is named, its part skipped.
With `--out` what each part has reached is put into a file, from which docs/results.md is written.
"""

import argparse
import collections
import datetime
import functools
import json
import platform
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flight_code_checks as checks
import flight_code_mutants as mutants
import flight_code_navigation as navigation
import flight_code_stored as stored
import flight_code_thrusters as thrusters
import numpy as np
from flight_code_directed import Directed
from flight_code_missions import MISSIONS, exported, folder_of
from flight_code_states import CLOSED, FLIGHTS, TOGETHER, Flights, closed_loops, compared, pulsed_loops

from keepout.core.whole_file import write_whole
from keepout.flights.thrusters.on_off import OnOffThrusters

QUICK = (
    *("errors of the estimate", "strong, errors and delay", "law by the spline", "24 thrusters, late, owed"),
    "laser, tumbling",
)
"""The missions of a run that names no number of them."""

SAMPLED = 300
"""Steps of a closed loop by samples."""
TO_ITSELF = 1e-10
"""Within it (m) Python's flight ends of itself from last bits beside, where rounding stays rounding."""
ROW, LOOPS = "compared.json", "loops.json"
"""In a mission's folder: what the comparison with Python has shown, and how far apart closed loops have ended."""
Rows = list[dict[str, Any]]


def answers(options: argparse.Namespace) -> Rows:
    """Compare with Python, mission by mission; a mission that is in `--kept` with its row is not compared again."""
    names = list(MISSIONS)[: options.missions] if options.missions else list(QUICK)
    missions = []
    for name in names:
        row = _once(folder_of(name, options.kept) / ROW, functools.partial(_compared, name, options))
        missions.append(row)
        print(json.dumps({key: value for key, value in row.items() if key not in ("listed", "crossed")}), flush=True)
    steps, differ, beyond = (
        sum(row[key] for row in missions) for key in ("steps", "statuses that differ", "steps beyond 1e-11")
    )
    force, memory, share = (max(row[key] for row in missions) for key in ("force", "memory", "times a last bit"))
    many = f"{len(names)} missions"
    reached = f"{steps:,} over {many}: {differ} statuses differ; force {force:.1e}, memory {memory:.1e}"
    if beyond:
        reached += (
            f"; {beyond} steps are beyond 1e-11, by at most {share:.2g} times what a last bit of their inputs does"
        )
    rows = [_row("random steps, memory synced", "10⁶, 12 missions: statuses equal, ≤ 1e-11", reached)]
    guarded = [row for row in missions if "guard states" in row]
    states, close, far = (sum(row[key] for row in guarded) for key in ("guard states", "differ on it", "differ off it"))
    force, memory = (max(row[key] for row in guarded) for key in ("guard force", "guard memory"))
    modes = sum((collections.Counter(row["modes"]) for row in guarded), collections.Counter())
    reached = (
        f"{states:,}, {', '.join(f'{number:,} {mode}' for mode, number in modes.most_common())}: force {force:.1e}, "
        f"memory {memory:.1e}; statuses differ on {close} thresholds, on {far} of them further than 1e-12 away"
    )
    rows.append(_row("guard states on thresholds", "10⁶ in four modes: statuses equal, ≤ 1e-12", reached))
    if pulsed := [row for row in missions if "forces" in row]:
        forces, close, far = (sum(row[key] for row in pulsed) for key in ("forces", "pulses on it", "pulses off it"))
        given, memory = (max(row[key] for row in pulsed) for key in ("pulses", "pulses' memory"))
        reached = f"{forces:,} over {len(pulsed)} layouts: force and on-times {given:.1e}, memory {memory:.1e}; "
        reached += f"other thrusters fire on {close} thresholds, in {far} cases elsewhere"
        rows.append(_row("forces for thrusters of a layout", "the same thrusters fire, ≤ 1e-12", reached))
    if sensed := [row for row in missions if "samples" in row]:
        samples, close, far = (
            sum(row[key] for row in sensed) for key in ("samples", "decided on it", "decided off it")
        )
        known, memory = (max(row[key] for row in sensed) for key in ("known", "navigation"))
        reached = f"{samples:,} over {len(sensed)} suites: what is known {known:.1e}, memory {memory:.1e}; "
        reached += f"one alone leaves a sample out on {close} thresholds, in {far} cases beside one"
        rows.append(
            _row(
                "samples of sensors on thresholds",
                "counts and flags equal, ≤ 1e-11; radii of balls that touch ≤ 1e-8",
                reached,
            )
        )
    rows[0]["missions"] = missions
    return rows


def _compared(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Compare one mission with Python; leave its folder with stored steps."""
    flown = exported(name, options.kept)
    by_samples = flown.made.mission.setup.navigation is not None
    flights = navigation.SampledFlights(flown.made) if by_samples else Flights(flown.made)
    random = compared(flown, flights, options.steps)
    records = [stored.of_step(flown.made, row) for row in random.kept[:16]]
    if not isinstance(flights, navigation.SampledFlights):
        records.append(stored.of_beginnings(flown.made, random.kept[0].estimate))
    row: dict[str, Any] = {"mission": name, "steps": random.steps, "statuses that differ": random.differ}
    row |= {"force": random.force, "memory": random.memory, "most in": random.worst}
    row |= {"steps beyond 1e-11": random.beyond, "times a last bit": random.share}
    if isinstance(flights, navigation.SampledFlights):
        records.append(flights.beginnings(np.random.default_rng(5)))
        samples = navigation.compared(flown, flights, random.kept, options.directed)
        records += samples.records
        row |= {"samples": samples.states, "decided on it": samples.on_it, "decided off it": samples.beside}
        row |= {"known": samples.known, "navigation": samples.memory, "most of it in": samples.worst}
    if isinstance(flown.made.mission.setup.thrusters, OnOffThrusters):
        forces = thrusters.compared(flown, options.directed)
        records += forces.records
        row |= {"forces": forces.forces, "pulses on it": forces.on_it, "pulses off it": forces.beside}
        row |= {"pulses": forces.given, "pulses' memory": forces.memory}
    if flown.made.mission.guard is not None:
        pieces = Directed(flown, random.kept, max(96, options.directed // 100))
        found = pieces.compare(options.directed)
        records += pieces.stored
        row |= {"guard states": found.states, "differ on it": found.differ_close, "differ off it": found.differ_far}
        row |= {"guard force": found.force, "guard memory": found.memory, "modes": dict(found.modes)}
        row["crossed"] = {", ".join(key): number for key, number in found.crossed.most_common()}
        row["listed"] = found.listed
    row["stored"] = stored.write(flown, records)
    return row


def _once(place: Path, make: Callable[[], Any]) -> Any:
    """Give what a file keeps as JSON, or make it and keep it."""
    if not place.is_file():
        write_whole(place, json.dumps(make(), ensure_ascii=False))
    return json.loads(place.read_text(encoding="utf-8"))


def _looped(name: str, options: argparse.Namespace) -> Any:
    """Fly a mission's closed loops; how far apart they end is kept beside its code."""

    def fly() -> Any:
        flown = exported(name, options.kept)
        if flown.made.mission.setup.navigation is not None:
            return navigation.sampled_loops(flown, navigation.SampledFlights(flown.made), SAMPLED)
        loops = pulsed_loops if isinstance(flown.made.mission.setup.thrusters, OnOffThrusters) else closed_loops
        return loops(flown, Flights(flown.made), CLOSED)

    found = _once(folder_of(name, options.kept) / LOOPS, fly)
    print(json.dumps({"mission": name, "closed loops": found}), flush=True)
    return found


def loops(options: argparse.Namespace, folders: list[Path]) -> Rows:
    """Fly closed loops of the first missions, each code its own; one that is in `--kept` is not flown again."""
    there = [name for name in MISSIONS if folder_of(name, options.kept) in folders]
    layouts = [name for name in there if MISSIONS[name].get("thrusters", {}).get("layout", "ideal") != "ideal"]
    suites = [name for name in there if "navigation" in MISSIONS[name]]
    ideal = [name for name in there if name not in layouts + suites]
    sensed, ends, pulsed = (
        [_looped(name, options) for name in some[: options.loops]] for some in (suites, ideal, layouts)
    )
    rows: Rows = []
    if ends:
        flights = [flight for mission in ends for flight in mission]
        near = [by_c for by_c, own in flights if own <= TO_ITSELF]
        parted = [flight for flight in flights if flight[1] > TO_ITSELF]
        asked = "20 missions, 3,000 steps: ≤ 1e-10 m"
        reached = (
            f"{len(flights)} flights, missions: {len(ends)}, {CLOSED} steps; Python with positions a last bit off "
        )
        reached += f"ends within {TO_ITSELF:.0e} m of itself in {len(near)}, C from it {max(near, default=0.0):.1e} m"
        if parted:
            medians = [float(np.median(far)) for far in zip(*parted, strict=True)]
            reached += "; in the other {} rounding grows, in the median to: C {:.1e} m, Python {:.1e} m".format(
                len(parted), *medians
            )
        rows.append(_row("closed loops, each its own", asked, reached))
    if sensed:
        reached = f"{len(sensed) * FLIGHTS} flights, missions: {len(sensed)}, {SAMPLED} steps: {max(sensed):.1e} m"
        rows.append(_row("closed loops by samples, each its own", f"{SAMPLED} steps: ≤ 1e-9 m", reached))
    if pulsed:
        asked = f"{TOGETHER} steps: ≤ 1e-10 m; then as near as Python to itself from a last bit beside"
        reached = f"{len(pulsed) * FLIGHTS} flights, missions: {len(pulsed)}, {TOGETHER} steps: "
        reached += f"{max(early for early, _, _ in pulsed):.1e} m; after {CLOSED}, in the median: "
        reached += ", ".join(f"{by_c:.1e} m, Python {own:.1e} m" for _, by_c, own in pulsed)
        rows.append(_row("closed loops by pulses, each its own", asked, reached))
    return rows


def _row(evidence: str, asked: str, reached: str) -> dict[str, Any]:
    return {"evidence": evidence, "asked": asked, "reached": reached}


PARTS: dict[str, Callable[[argparse.Namespace, list[Path]], Rows]] = {
    "answers": lambda options, _: answers(options),
    "loops": loops,
    "bits": checks.bits,
    "eva": checks.eva,
    "style": checks.style,
    "coverage": checks.coverage,
    "mutants": mutants.table,
    "fuzz": checks.fuzz,
    "budget": checks.budget,
}


def put(path: Path, part: str, rows: Rows) -> None:
    """Put what a part has reached into the file of results, with where and when."""
    whole = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    commit = subprocess.run(["git", "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=False)
    whole[part] = {
        "machine": f"{platform.system()}, {platform.machine()}",
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "commit": commit.stdout.strip() or "unknown",
        "rows": rows,
    }
    whole = {name: whole[name] for name in PARTS if name in whole}
    path.write_text(json.dumps(whole, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def main() -> None:
    """Run parts and print what each has reached."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all if none is named")
    parser.add_argument("--steps", type=int, default=6400, help="random ones of each mission")
    parser.add_argument("--directed", type=int, default=10_000, help="states of each mission's guard")
    parser.add_argument("--missions", type=int, default=0, help="how many; four quick ones if left out")
    parser.add_argument("--loops", type=int, default=1, help="missions that are flown in closed loops")
    parser.add_argument("--fuzz", type=int, default=50_000, help="fuzzed steps")
    parser.add_argument("--fuzzed", type=int, default=3, help="missions that are fuzzed")
    parser.add_argument("--eva", type=int, default=1, help="missions that Frama-C Eva goes through")
    parser.add_argument("--kept", type=Path, help="folder of the missions' flight code")
    parser.add_argument("--out", type=Path, help="JSON file of results, into which the parts are put")
    options = parser.parse_args()
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no part is called {', '.join(sorted(unknown))}; valid: {', '.join(PARTS)}")
    if not checks.found("gcc"):
        raise SystemExit("skipped: gcc is not installed")
    with tempfile.TemporaryDirectory() as room:
        options.kept = options.kept or Path(room)
        options.kept.mkdir(parents=True, exist_ok=True)
        for part in options.parts or PARTS:
            folders = [folder for name in MISSIONS if stored.stored_in(folder := folder_of(name, options.kept))]
            if part != "answers" and not folders:
                raise SystemExit(f"{part}: {options.kept} has no missions; run `answers` with this --kept first")
            rows = PARTS[part](options, folders)
            for row in rows:
                print(f"| {row['evidence']} | {row['asked']} | {row['reached']} |", flush=True)
            if options.out is not None and rows:
                put(options.out, part, rows)


if __name__ == "__main__":
    main()

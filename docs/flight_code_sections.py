"""The sections of docs/results.md on the flight code in C."""

from typing import Any

from result_tables import kept_file, measured, note, table

ROWS = {"evidence": "evidence", "asked": "asked", "reached": "reached"}
WHENCE = {"part": "part", "machine": "machine", "date": "date", "commit": "commit"}
MISSIONS = {
    "mission": "mission",
    "steps": "random steps",
    "statuses that differ": "statuses that differ",
    "force": "force",
    "memory": "memory",
    "most in": "most in",
    "steps beyond 1e-11": "steps beyond 1e-11",
    "times a last bit": "times what a last bit of the inputs does",
    "guard states": "guard states",
    "guard force": "their force",
    "guard memory": "their memory",
}


def flight_code() -> list[str]:
    """Give what was asked of the exported C, and what was reached."""
    kept = kept_file("flight_code")
    rows = [row for part in kept.values() for row in part["rows"]]
    words = [
        "`make flight-code`, and with more of everything the commands of `python benchmarks/flight_code.py --help`; "
        "discussed in [On board](on-board.md#flight-code-in-c). Differences of numbers are over their size and 1e-3 of "
        "their unit in random steps, and over their size and 1 of their unit in states of the guard. Each component is "
        "taken by itself: 1e-14 N of one near zero counts as 1e-11, however large the others are.",
    ]
    lines = measured("Flight code in C", words, rows, ROWS)
    lines += note("flight_code")
    lines += [""]
    lines += table([{"part": name, **part} for name, part in kept.items()], WHENCE)
    missions = _listed(kept, "missions")
    if missions:
        told = [{key: row.get(key) for key in MISSIONS} for row in missions]
        lines += ["Mission by mission, in the order of the command:", "", *table(told, MISSIONS)]
    if crossed := _crossed(missions):
        lines += ["Thresholds on which states of the guard stand, as mode or flag changes there:", "", *table(crossed)]
    if deviations := _listed(kept, "deviations"):
        lines += ["Deviations from MISRA C:2012 that cppcheck counts:", "", *table(deviations)]
    if left := _listed(kept, "left"):
        lines += ["Branches that nothing reached:", "", *table(left)]
    return lines


def _listed(kept: dict[str, Any], name: str) -> list[dict[str, Any]]:
    return [one for part in kept.values() for row in part["rows"] for one in row.get(name, [])]


def _crossed(missions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add up thresholds by the line that leads through them."""
    counted: dict[str, int] = {}
    for row in missions:
        for name, number in row.get("crossed", {}).items():
            line = name.split(", ")[0]
            counted[line] = counted.get(line, 0) + number
    return [{"line": line, "thresholds": number} for line, number in sorted(counted.items(), key=lambda one: -one[1])]

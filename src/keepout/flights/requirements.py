"""What a scenario requires (`[require]`), and whether the figures of a flight, or of a campaign's flights, meet it."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:  # a terminal must be there at once
    from keepout.core.mission.scenario import Scenario
    from keepout.core.mission.task_entries import RequireEntry
    from keepout.flights.campaign.dataset import Dataset

FAILED = 3
"""Exit code of a command that flew and found a requirement not met."""


class _Asked(NamedTuple):
    """How one entry of `[require]` is judged: its words, what it looks at, and when that meets it."""

    words: str
    figure: str
    column: str
    met: Callable[[Any, Any], Any]


_ASKED: Mapping[str, _Asked] = {
    "contact": _Asked("proved free of contact", "contact_verdict", "contact", lambda found, _: found == "no"),
    "certified": _Asked(
        "guard's theorem holds from the start", "start_certified", "start_certified", lambda found, _: found == 1
    ),
    "clearance_m": _Asked(
        "proved clearance of at least {:g} m",
        "minimum_clearance_m",
        "minimum_clearance",
        lambda found, asked: found >= asked,
    ),
    "delta_v_mps": _Asked("Δv of at most {:g} m/s", "delta_v_mps", "delta_v", lambda found, asked: found <= asked),
    "time_s": _Asked(
        "goal reached within {:g} s", "time_to_reach_s", "time_to_reach", lambda found, asked: found <= asked
    ),
    "reached": _Asked("goal reached", "reached", "reached", lambda found, _: found == 1),
    "zones": _Asked(
        "proved to enter no zone and leave no corridor",
        "zones_entered",
        "zones_entered",
        lambda found, _: found == "no",
    ),
    "holds": _Asked("every hold kept", "holds_kept", "holds_kept", lambda found, _: found == 1),
}


def required(require: "RequireEntry") -> dict[str, str]:
    """Give the entries of `[require]` that ask for something, each with what it asks for in words."""
    given = {name: getattr(require, name) for name in _ASKED}
    there = [name for name, asked in given.items() if asked is not None and asked is not False]  # 0.0 is there
    return {name: _ASKED[name].words.format(given[name]) for name in there}


def judged(scenario: "Scenario", summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Judge a flight by the figures of its summary.

    Args:
        scenario: as flown.
        summary: of the flight, of an exploration or of an inspection.

    Returns:
        One row a requirement, plain values: `entry`, `required` (in words), `found`, and `met`: whether the figure
        meets it; None where the flight has no such figure, as an inspection has no goal to reach.

    """
    figures = dict(summary)
    if "time_to_reach_s" not in figures and "reached" in figures:  # an exploration ends where it reaches its goal
        figures["time_to_reach_s"] = figures["duration_s"] if figures["reached"] else None
    rows = []
    for name, words in required(scenario.require).items():
        asked, known = _ASKED[name], _ASKED[name].figure in figures
        found = figures.get(asked.figure)
        met = found is not None and bool(asked.met(found, getattr(scenario.require, name)))
        rows.append({"entry": f"require.{name}", "required": words, "found": found, "met": met if known else None})
    return rows


def judged_campaign(require: "RequireEntry", dataset: "Dataset") -> list[dict[str, Any]]:
    """Judge the runs of a campaign that are done; one that was refused and never flown meets no requirement.

    Args:
        require: what is asked of the runs, and of which share of them.
        dataset: of the campaign's folder, as `read_campaign` gives it.

    Returns:
        One row a requirement, plain values: `entry`, `required` (in words), `count` of `of` runs that meet it, `low`
        and `high` of the 95 % interval of their share (Clopper and Pearson), and `met`: whether the lower end is at
        least `require.share`, or every run meets it where no share is given.

    """
    from keepout.flights.campaign.statistics import clopper_pearson
    from keepout.flights.campaign.table import FLOWN

    asked = required(require)
    columns = [_ASKED[name].column for name in asked]
    found = dataset.arrays(list(dict.fromkeys(["status", "reached", *columns]))) if asked else {}
    rows = []
    for name, words in asked.items():
        given = found[_ASKED[name].column]
        meets = given.equal("no") if name in ("contact", "zones") else _ASKED[name].met(given, getattr(require, name))
        meets = meets & found["status"].equal(FLOWN) & ((name != "time_s") | (found["reached"] == 1.0))
        count, runs = int(meets.sum()), len(meets)
        low, high = clopper_pearson(count, runs)
        met = count == runs if require.share is None else bool(low >= require.share)
        rows.append({"entry": f"require.{name}", "required": words, "count": count, "of": runs})
        rows[-1] |= {"low": low, "high": high, "share": require.share, "met": met}
    return rows


def failed(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Give a line for each requirement that is not met, with what was found instead."""
    return [f"{row['entry']}: {row['required']}: not met, {_found(row)}" for row in rows if row["met"] is False]


def told(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Give requirements as the rows of a table for people."""
    verdict = {True: "pass", False: "FAIL", None: "not judged here"}
    return [{"requirement": row["required"], "found": _found(row), "verdict": verdict[row["met"]]} for row in rows]


def _found(row: Mapping[str, Any]) -> str:
    """Say what a requirement was judged by."""
    if "of" in row:
        wanted = "all asked" if row["share"] is None else f"lower end asked {100.0 * row['share']:g} %"
        shares = f"95 % interval {100.0 * row['low']:.4g} % to {100.0 * row['high']:.4g} %"
        return f"{row['count']} of {row['of']} runs; {shares}; {wanted}"
    found = row["found"]
    if isinstance(found, bool):
        return "yes" if found else "no"
    if found is None:
        return "none"
    return f"contact: {found}" if isinstance(found, str) else f"{found:.4g}"

"""What a person sees in the terminal: progress bars, and tables of flights, fits and targets."""

import contextlib
import functools
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from keepout.core import progress as keepout_progress
from keepout.flights.pages.page import shown, verdict_of

if TYPE_CHECKING:  # which compiles, and a terminal must be there at once
    from keepout.flights.campaign.run import Standing


@dataclass
class _Heard:
    """Who hears what a command says: the terminal, unless it is to be quiet, and a log where there is one."""

    quiet: bool = False
    log: TextIO | None = None


_heard = _Heard()


@contextmanager
def heard(quiet: bool, log: Path | None) -> Iterator[None]:
    """Let nobody but a log hear what the block says, where `quiet`; refusals and warnings are always heard.

    Args:
        quiet: whether progress, tables and words stay off the terminal.
        log: a file that all is added to, each line with its time, UTC.

    """
    began = time.monotonic()
    with contextlib.ExitStack() as stack:
        stack.callback(vars(_heard).update, vars(_heard).copy())
        _heard.quiet = quiet
        _heard.log = None if log is None else stack.enter_context(log.open("a", encoding="utf-8"))
        note(shlex.join(["keepout", *sys.argv[1:]]))
        try:
            yield
        except BaseException as stop:
            code = getattr(stop, "exit_code", None)  # of a command that did its work
            said = f"exit code {code}" if code is not None else str(stop) or type(stop).__name__
            note(f"ended after {time.monotonic() - began:.1f} s: {said}")
            raise
        note(f"done after {time.monotonic() - began:.1f} s")


def note(line: str) -> None:
    """Add a line to the log, where there is one."""
    if _heard.log is not None:
        _heard.log.write(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {line}\n")
        _heard.log.flush()


def tell(part: Any) -> None:
    """Print a table or words for a person, as they are."""
    words = isinstance(part, str)
    look: Any = {"highlight": not words, "markup": not words, "soft_wrap": isinstance(part, Line)}
    if not _heard.quiet:
        Console().print(part, **look)
    if _heard.log is not None:
        Console(file=_heard.log, width=WIDTH).print(part, **look)


def say(line: str) -> None:
    """Write a line on standard error, as refusals and warnings are, quiet or not."""
    sys.stderr.write(f"keepout: {line}\n")
    note(line)


@contextmanager
def progress(title: str) -> Iterator[keepout_progress.Progress]:
    """Show how far the block is on standard error: a bar on a terminal, else a line every ten seconds; log it too."""
    console = Console(stderr=True)
    noted = _every(1.0, note, title)
    if _heard.quiet:
        yield noted
        return
    if not console.is_terminal:  # a line at most every ten seconds, so that logs stay short
        show = functools.partial(console.print, highlight=False, markup=False, soft_wrap=True)
        yield _both(_every(10.0, show, title, time.monotonic()), noted)
        return
    columns = (
        SpinnerColumn(),
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[message]}"),
    )
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task(title, total=1.0, message="")
        yield _both(lambda fraction, message: bars.update(task, completed=fraction, message=message), noted)


def _both(one: keepout_progress.Progress, other: keepout_progress.Progress) -> keepout_progress.Progress:
    def report(fraction: float, message: str) -> None:
        one(fraction, message)
        other(fraction, message)

    return report


def _every(
    seconds: float, write: Callable[[str], Any], title: str, last: float = -math.inf
) -> keepout_progress.Progress:
    def report(fraction: float, message: str) -> None:
        nonlocal last
        if time.monotonic() - last > seconds:
            last = time.monotonic()
            write(f"{title}: {fraction:.0%} {message}")

    return report


def standing_lines() -> "Callable[[Standing], None]":
    """Give what writes how far a campaign is on standard error: a line of JSON a second, and one at its end."""
    last = -math.inf

    def tell(standing: "Standing") -> None:
        nonlocal last
        if time.monotonic() - last >= 1.0 or standing.done == standing.runs:
            last = time.monotonic()
            line = {**asdict(standing), "flights_per_second": standing.rate, "seconds_left": standing.seconds_left}
            sys.stderr.write(json.dumps(line, allow_nan=False) + "\n")
            sys.stderr.flush()

    return tell


class Line(str):
    """Words that are printed as one line, however long: they end in a path."""


@dataclass(frozen=True)
class MissionCommand:
    """A command that flies a scenario into a folder, as an application adds it (`core/plug_ins.py`).

    Attributes:
        help: what it does.
        example: a command line.
        scenario: what its scenario is.
        fly: flies a scenario into a folder that there is, with `figures` and `progress`; gives the summary.
        table: gives the summary for a person.
        check: refuses a file by its name.

    """

    help: str
    example: str
    scenario: str
    fly: Callable[..., dict[str, Any]]
    table: Callable[[dict[str, Any]], Table]
    check: Callable[[Path], None] = lambda path: None


WIDTH = 80
"""Columns of the narrowest terminal that the tables are laid out for; in a wider one they look the same."""


Column = str | tuple[str, ...] | Callable[[Mapping[str, Any]], str]
"""What a column shows of an entry: one of its figures, several, or what is made of it."""


def facts_table(title: str, summary: Mapping[str, Any]) -> Table:
    """One row a figure, in the order of the summary."""
    return _laid_out(title, None, [[key, shown(value)] for key, value in summary.items()], named=True)


_IN_METRES = ("lower", "upper", "extents", "offset", "closing_radius", "envelope")


def mesh_table(summary: Mapping[str, Any]) -> Table:
    """One row a figure of a mesh, each with its unit."""
    units = {**dict.fromkeys(_IN_METRES, "m"), **dict.fromkeys(("sealed_volume_at_offset", "sealed_volume"), "m³")}
    return facts_table("Mesh", {f"{key} {units[key]}" if key in units else key: of for key, of in summary.items()})


def entries_table(title: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """One row an entry, one column a key; what an entry has no value for is a dash."""
    headings = list(rows[0]) if rows else []
    cells = [["–" if value is None else shown(value) for value in row.values()] for row in rows]
    return _laid_out(title, headings, cells)


def _table(title: str, columns: Mapping[str, Column], entries: Sequence[Mapping[str, Any]], **look: Any) -> Table:
    """One row an entry, one column a heading."""
    return _laid_out(title, list(columns), [[_cell(of, entry) for of in columns.values()] for entry in entries], **look)


def _cell(of: Column, entry: Mapping[str, Any]) -> str:
    if callable(of):
        return of(entry)
    return ", ".join(shown(entry[key]) for key in ((of,) if isinstance(of, str) else of))


def _percent(key: str) -> Callable[[Mapping[str, Any]], str]:
    return lambda row: "–" if row[key] is None else f"{100.0 * row[key]:.4g}"


def rates_table(rates: Sequence[Mapping[str, Any]]) -> Table:
    """One row a rate of a campaign, with its interval."""
    columns = {"": "name", "runs": lambda rate: f"{rate['count']} of {rate['of']}", "rate %": _percent("rate")}
    return _table("Rates", columns | {"95 % from": _percent("low"), "to": _percent("high")}, rates, named=True)


def comparison_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Rates of two campaigns and their differences, and medians and their differences."""
    percents = {"A %": "A", "B %": "B", "A − B": "A - B", "95 % from": "low", "to": "high"}
    columns = {"": "what", **{heading: _percent(key) for heading, key in percents.items()}, "p": "p"}
    tables = [_table("Rates", columns, summary["rates"], named=True)]
    medians = [row for row in summary["quantiles"] if row["quantile"] == "50 %"]
    if medians:
        tables.append(entries_table("Medians", [{k: v for k, v in row.items() if k != "quantile"} for row in medians]))
    if summary["by_run"]:
        tables.append(entries_table("A less B, run by run", summary["by_run"]))
    return tables


def measures_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Give the single figures of a field, then one table for each kind of measure; lengths in metres."""
    single = {key: value for key, value in summary.items() if not isinstance(value, list | dict)}
    certificates = [
        {**entry, "stand_off_mean": entry["margin"]["mean"], "stand_off_95": entry["margin"]["percentile_95"]}
        for entry in summary["certificates"]
    ]
    entries = ([summary["near"], summary["far"]], summary["curvature"], [summary["surface"]], summary["volumes"])
    tables = [facts_table("Field", single)]
    tables += [_table(title, columns, of) for (title, columns), of in zip(_MEASURES.items(), (*entries, certificates))]
    pictures = [facts_table("Pictures", {"written": summary["pictures"]})] if "pictures" in summary else []
    return tables + pictures


_MEASURES: Mapping[str, Mapping[str, Column]] = {
    "Off the surface, against the exact signed distance g": {
        "d from, to m": ("from_m", "to_m"),
        "mean |f̃ - g| m": "mean_absolute",
        "RMS m": "root_mean_square",
        "p99.9 |f̃ - g| m": "absolute_999",
        "p99.9 f̃ - g m": "over_999",
        "mean |‖∇f̃‖ - 1|": "eikonal",
    },
    "‖∇²f̃‖, 1/m": {"d m": "level", "median": "median", "p99": "percentile_99", "largest": "maximum"},
    "Marching-cubes surface against the target's visible surface": {
        "f̃ m": "level",
        "Chamfer m": "chamfer",
        "Hausdorff m": "hausdorff",
        "learned to target mean, p95, max m": (
            "learned_to_target",
            "learned_to_target_95",
            "learned_to_target_maximum",
        ),
        "target to learned mean, max m": ("target_to_learned", "target_to_learned_maximum"),
    },
    "Volume kept out of, m³": {
        **{"R m": "chaser_radius", "f̃ ≤ m": "level", "learned": "learned", "exact contact": "contact"},
        **{"IoU": "iou", "hull + R": "hull", "ellipsoid + R": "ellipsoid"},
    },
    "Certificates": {
        **{"R m": "chaser_radius", "e_h m": ("error_bound", "kind"), "found m": "sampled_maximum"},
        **{"‖∇f̃‖ ≤": ("gradient_bound", "gradient_kind"), "‖∇f̃‖ found": "gradient_found"},
        "stands off mean, p95 m": ("stand_off_mean", "stand_off_95"),
    },
}
"""By title of a table: the entries of a measure that each column shows."""


def _laid_out(title: str, headings: list[str] | None, rows: list[list[str]], *, named: bool = False) -> Table:
    """Lay a table out in `WIDTH` columns so that text breaks at spaces only, and nothing is left out.

    Where the longest words do not fit side by side, rows and columns change places. What is still too long, as a path
    can be, is folded. `named` says that the first column names the rows.
    """
    if headings is not None and sum(_longest_words([headings, *rows])) + _frame(len(headings)) > WIDTH:
        turned = [list(line) for line in zip(headings, *rows)]
        headings, rows, named = turned[0], turned[1:], True
    widths = _widths(rows if headings is None else [headings, *rows])
    table = Table(title=title, show_header=headings is not None, title_justify="left")
    for place, width in enumerate(widths):
        first = named and place == 0
        table.add_column(
            "" if headings is None else headings[place],
            style="bold" if first else None,
            justify="left" if first else "right",
            overflow="fold",
            max_width=width,
        )
    for row in rows:
        table.add_row(*row)
    return table


def _frame(columns: int) -> int:
    """Characters of the lines between and around columns, with a space on either side of each text."""
    return 3 * columns + 1


def _longest_words(lines: Sequence[Sequence[str]]) -> list[int]:
    return [max(cell_len(word) for text in column for word in (text.split() or [""])) for column in zip(*lines)]


def _widths(lines: Sequence[Sequence[str]]) -> list[int]:
    """Width of each column: its longest word's, then as far as there is room its longest line's."""
    widths = _longest_words(lines)
    spare = WIDTH - _frame(len(widths)) - sum(widths)
    while spare < 0 and max(widths) > 1:  # from the widest, and so never from a figure before a name
        widths[widths.index(max(widths))] -= 1
        spare += 1
    for place, column in enumerate(zip(*lines)):
        wanted = max(cell_len(line) for text in column for line in (text.splitlines() or [""])) - widths[place]
        grown = max(min(wanted, spare), 0)
        widths[place] += grown
        spare -= grown
    return [max(width, 1) for width in widths]


FLIGHT_COLUMNS = {
    "reached": "reached",
    "contact": "contact",
    "minimum_clearance_m": "min clearance m",
    "final_error_m": "final error m",
    "delta_v_mps": "Δv m/s",
    "saturated_fraction": "saturated",
    "guard_interventions": "guard steps",
}
"""Headings of a table of flights after the first, "flight", by entry of a flight's summary."""
FLIGHT_ROWS = {
    "reached": "reached its goal",
    "time_to_reach_s": "after s",
    "final_error_m": "distance to the goal at the end m",
    "contact_verdict": "contact, on the mesh",
    "minimum_clearance_m": "clearance, proved lower bound m",
    "start_certified": "start certified",
    "delta_v_mps": "Δv m/s",
    "propellant_kg": "propellant kg",
    "largest_speed_mps": "largest speed m/s",
    "saturated_fraction": "share of steps saturated",
    "guard_interventions": "guard steps",
}
"""Words for the entries of a flight's summary that a person is shown; one that is None is left out."""


def flight_table(summary: Mapping[str, Any]) -> Table:
    """One row a figure: how a flight ended, whether it was safe, what it cost, and what its sensors left to know."""
    rows, known = dict(FLIGHT_ROWS), dict(summary)

    def add(key: str, words: str, value: Any) -> None:
        rows[key], known[key] = words, value

    navigation = summary["navigation"] or {}
    if navigation:
        add("navigation", "navigation: sensors, estimate", f"{navigation['suite']}, {navigation['estimate']}")
    for of, unit, shown_unit in (("position", "m", "m"), ("velocity", "mps", "m/s")):
        for kind, words in (("rms", "rms"), ("largest", "largest"), ("cap", "bound")):
            key = f"{of}_error_{kind}_{unit}"
            if key in navigation:
                add(key, f"{of} error, {words} {shown_unit}", navigation[key])
    known, rows = with_zones(known, rows)
    if "legs" in summary:
        kept = sum(leg["kept"] for leg in summary["legs"])
        add("holds", "holds kept", f"{kept} of {len(summary['legs'])}")
    if "drifts" in summary:
        judged, free = (sum(leg[key] for leg in summary["drifts"]) for key in ("judged", "proved_free"))
        add("drifts_free", "drifts without thrust proved free", f"{free} of {judged}")
    if "speed_rule_excess_mps" in summary:
        rows["speed_rule_excess_mps"] = "beyond the rule of speeds, at most m/s"
    return result_table(f"Flight {summary['name']}", known, rows)


def with_zones(summary: Mapping[str, Any], rows: Mapping[str, str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Give a flight's summary, and words for its entries, with what a person is told of zones, where there are some."""
    known, words = dict(summary), dict(rows)
    if "zones" in summary:
        said = {"no": "none, proved", "yes": "yes", "undecided": "not excluded"}
        away = [of for zone in summary["zones"] if (of := zone["minimum_clearance_m"]) is not None]
        known |= {"zones_entered": said[summary["zones_entered"]], "zone_clearance_m": min(away, default=None)}
        words |= {
            "zones_entered": "zones entered, corridors left",
            "zone_clearance_m": "away from them, proved lower bound m",
        }
    return known, words


def verdict(summary: Mapping[str, Any]) -> str:
    """Say in a sentence what became of a flight, of one of several legs, or of many: the last word of a command."""
    if "said" in summary:  # of a rare event
        return summary["said"]
    if "rates" in summary:
        rates = {rate["name"]: rate for rate in summary["rates"]}
        reached, touched = rates["reached"], rates["contact or undecided"]
        free = f"{touched['count']} are not" if touched["count"] else "all are"
        return f"{reached['count']} of {reached['of']} flights reached their goal; {free} proved free of contact."
    if "outcome" in summary:
        ended = f"{summary['outcome'][0].upper()}{summary['outcome'][1:]}: {summary['why']}"
    elif summary["reached"]:
        ended = f"Reached its goal after {summary['time_to_reach_s']:g} s"
    elif summary["final_error_m"] is None:
        ended = "Did not reach its goal, and where it ended is no number"
    else:
        ended = f"Did not reach its goal: {summary['final_error_m']:.3g} m away at the end"
    head = verdict_of(summary)
    return f"{ended}. {head.said} {head.theorem}"


def result_table(title: str, summary: Mapping[str, Any], rows: Mapping[str, str]) -> Table:
    """One row a figure: how a flight of several legs ended, whether it was safe, and what it cost.

    Args:
        title: of the table.
        summary: of the flight.
        rows: words for the entries that are shown, in order; one that is None is left out.

    """
    told = {words: summary[key] for key, words in rows.items() if summary[key] is not None}
    table = facts_table(title, told)
    if broken := summary["assumptions_broken"]:
        table.caption_justify = "left"
        table.caption = f"{summary['name']}: beyond the guard's assumptions, nothing is promised: {'; '.join(broken)}"
    return table


def check_parts(summary: Mapping[str, Any]) -> list[Table | str]:
    """Say what a scenario would fly, in words and tables, and what would be refused, with values that would not be."""
    parts: list[Table | str] = list(summary["words"])
    if summary["conditions"]:
        columns = {"": "name", "asked": "statement", "found": "value", "limit": "limit", "margin": "margin"}
        parts.append(_table("Conditions", columns, summary["conditions"], named=True))
    if summary["guard"] is not None:
        promised = {"start certified": summary["start_certified"], **summary["guard"]}
        parts.append(facts_table("Guard: what it assumes, and what follows", promised))
    if summary["expected"] is not None:
        parts.append(facts_table("Expected (estimates)", summary["expected"]))
    parts += [f"note: {remark}" for remark in summary["remarks"]]
    for refusal in summary["refusals"]:
        parts.append(f"refused: {refusal['said']}")
        parts += [f"  would do: {nearest['words']}" for nearest in refusal["nearest"]]
    parts.append("It flies." if summary["flies"] else "It would not be flown.")
    return parts


_TARGETS: Mapping[str, Column] = {
    "name": "name",
    "extents m": lambda row: "×".join(f"{extent:.1f}" for extent in row["extents_m"]),
    "volume m³": lambda row: f"{row['volume_m3']:.1f}",
    "triangles": "triangles",
    "field": lambda row: "shipped" if row["shipped_field"] else "to fit",
    "parameters": lambda row: "\n".join(f"{key}={value:g}" for key, value in row["parameters"].items()),
}


def targets_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """One row a built-in target."""
    return _table("Built-in targets", _TARGETS, rows, named=True)

"""A folder of results as a report to be printed or passed on: four pages of A4, as one PDF.

Mission and assumptions, what is proved, what was flown, requirements: of a flight, an exploration, an inspection or a
campaign. The verdict is the audit's of the flight file, worked out anew.
"""

import json
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.image
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages

from keepout.core.errors import ScenarioError, UsageError
from keepout.core.mission.approach import has_rules
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place, write_whole
from keepout.flights import requirements
from keepout.flights.campaign.dataset import read_campaign
from keepout.flights.campaign.results import results
from keepout.flights.pages import campaign_page
from keepout.flights.pages.approach_drawn import STILL
from keepout.flights.pages.figures import drawn
from keepout.flights.pages.flight_page import paint_motion
from keepout.flights.pages.mesh_pictures import PATHS_FROM, eye_axes, paint_paths
from keepout.flights.pages.page import Headline, Provenance, as_toml, bracketed, shown, verdict_of
from keepout.flights.pages.replay_page import paint_clearance
from keepout.flights.pages.replayed import Replayed, of_files

_WIDTH, _HEIGHT, _MARGIN, _FOOT = 8.27, 11.69, 0.8, 0.7
"""Of a sheet, inches."""
_LINE = 0.165
"""Inches from a line of text to the next."""
_CHARACTERS = 104
"""Of a line of text over the whole width."""
_LABEL, _VALUE = 30, 52
"""Characters of the two columns of a table of facts: digests are wider than words."""
_LEFT_OUT = ("name", "flight", "map", "unseen", "frames_file", "contact", "seconds")
"""Entries of a summary that are files, or said by another entry."""
_UNITS = {
    **{"per_s2": "1/s²", "radps2": "rad/s²", "radps": "rad/s", "mps2": "m/s²", "mps": "m/s"},
    **{"m3": "m³", "kg": "kg", "m": "m", "N": "N", "s": "s"},
}
"""By the ending of an entry's name."""
_QUIET = {"color": "#5c6675"}
_WORDS = {"good": "#00845f", "bad": "#b00020", "open": "#8a6a00"}
_AUDIT = (
    "The audit bounds the clearance of the recorded path from below at every instant, between the samples too, on the "
    "exact mesh. It does not look at field, law or guard. It rests on the recorded forces and on the bounds of what is "
    "not recorded: disturbance and gravity."
)


def print_report(folder: Path, out: Path | None = None, *, progress: Progress = silent) -> Path:
    """Write the report of a folder of results as a PDF.

    Args:
        folder: that `fly`, `explore`, `inspect` or `campaign` wrote.
        out: the file; by default `report.pdf` in that folder.
        progress: told how far it is.

    Returns:
        The file's path.

    Raises:
        ScenarioError: the folder holds no flight and no campaign.
        KeepoutError: its files cannot be read, or the mesh is another now.

    """
    out = folder / "report.pdf" if out is None else out
    if out.suffix.lower() != ".pdf":
        raise UsageError(f"{out}: a report ends in .pdf")
    require_place(out, refusal=ScenarioError)
    if (folder / "campaign.json").exists():
        parts = _campaign_parts(folder, progress)
    else:
        parts = _flight_parts(folder, progress)
    stored = BytesIO()
    with PdfPages(stored, metadata={"Title": parts.title, "Creator": "Keepout"}) as pdf:
        for number, (heading, fill) in enumerate(parts.sheets.items()):
            progress(0.5 + 0.5 * number / len(parts.sheets), heading)
            with _Sheet.begun(pdf, parts.title, heading) as sheet:
                fill(sheet)
    write_whole(out, stored.getvalue(), refusal=ScenarioError)
    progress(1.0, "")
    return out


class _Parts(NamedTuple):
    """Of a report: its title, and what fills each sheet, by heading."""

    title: str
    sheets: Mapping[str, Callable[["_Sheet"], None]]


class _Sheet:
    """A sheet that is filled from the top; what does not fit goes on on a further one."""

    def __init__(self, pdf: PdfPages, title: str, heading: str) -> None:
        self._pdf, self._title, self._heading = pdf, title, heading
        self._open = ExitStack()

    @classmethod
    @contextmanager
    def begun(cls, pdf: PdfPages, title: str, heading: str) -> Iterator["_Sheet"]:
        """Begin a sheet, and finish it and those after it at the end of the block."""
        sheet = cls(pdf, title, heading)
        with sheet._open:
            sheet._begin(heading)
            yield sheet
            sheet._finish()

    def _begin(self, heading: str) -> None:
        self._figure = self._open.enter_context(drawn(width=_WIDTH, height=_HEIGHT))
        self._figure.set_layout_engine("none")
        self._down = _MARGIN
        self._write(self._title, 0.0, size=8.0, **_QUIET)
        self._figure.text(0.5, 0.4 / _HEIGHT, str(self._pdf.get_pagecount() + 1), ha="center", fontsize=8)
        self._down += 0.3
        self._write(heading, 0.0, size=16.0, weight="bold")
        self._down += 0.4

    def _finish(self) -> None:
        self._pdf.savefig(self._figure)
        self._open.close()

    def _room(self, inches: float) -> None:
        if self._down + inches > _HEIGHT - _FOOT:
            self._finish()
            self._begin(f"{self._heading}, continued")

    def _write(self, line: str, across: float, *, size: float = 8.5, **look: Any) -> None:
        x, y = (_MARGIN + across) / _WIDTH, 1.0 - self._down / _HEIGHT
        self._figure.text(x, y, line, fontsize=size, va="top", parse_math=False, **look)

    def _lines(self, columns: Sequence[tuple[float, Sequence[str], Mapping[str, Any]]]) -> None:
        """Add lines side by side, not parted by the end of the sheet: from where (inches), the lines, how they look."""
        count = max(len(lines) for _, lines, _ in columns)
        self._room(count * _LINE)
        for k in range(count):
            for across, lines, look in columns:
                self._write(lines[k] if k < len(lines) else "", across, **look)
            self._down += _LINE

    def heading(self, words: str) -> None:
        """Add a heading."""
        self._room(4.0 * _LINE)
        self._down += 0.12
        self._write(words, 0.0, size=11.0, weight="bold")
        self._down += 0.25

    def words(self, text: str, **look: Any) -> None:
        """Add a paragraph."""
        for line in textwrap.wrap(text, _CHARACTERS) or [""]:
            self._room(_LINE)
            self._write(line, 0.0, **look)
            self._down += _LINE
        self._down += 0.06

    def verdict(self, verdict: Headline) -> None:
        """Add a verdict, and whether the theorem held."""
        kind = {True: "good", False: "bad", None: "open"}[verdict.good]
        self.words(verdict.said, color=_WORDS[kind], weight="bold")
        if verdict.theorem:
            self.words(verdict.theorem)

    def facts(self, rows: Mapping[str, Any]) -> None:
        """Add a table of two columns: words, and a value."""
        for words, value in rows.items():
            left = textwrap.wrap(words, _LABEL)
            lines = (textwrap.wrap(line, _VALUE) or [""] for line in _plain(value).split("\n"))
            right = [line for some in lines for line in some]
            self._lines([(0.0, left, _QUIET), (2.3, right, {})])
        self._down += 0.1

    def figures(self, rows: Mapping[str, Any]) -> None:
        """Add a table of short values, two pairs of words and value a line."""
        pairs, half = [(words, _plain(value)) for words, value in rows.items()], (len(rows) + 1) // 2
        columns: list[tuple[float, list[str], Mapping[str, Any]]] = []
        for across, some in ((0.0, pairs[:half]), (3.4, pairs[half:])):
            columns += [(across, [words for words, _ in some], _QUIET), (across + 2.3, [of for _, of in some], {})]
        self._lines(columns)
        self._down += 0.1

    def table(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Add a table with headings, its columns as wide as their longest line; a row that says FAIL stands out."""
        if not rows:
            return
        cells = [list(rows[0]), *([_plain(value) for value in row.values()] for row in rows)]
        wanted = np.array([max(len(line[k]) for line in cells) for k in range(len(cells[0]))], float) + 2.0
        widths = np.maximum(wanted * min(1.0, _CHARACTERS / wanted.sum()), 6.0)
        for place, line in enumerate(cells):
            wrapped = [textwrap.wrap(cell, max(int(width) - 1, 4)) for cell, width in zip(line, widths)]
            look = {"weight": "bold"} if place == 0 else {"color": _WORDS["bad"]} if "FAIL" in line else {}
            places = np.cumsum([0.0, *widths[:-1]]) * _inches()
            self._lines([(across, cell, look) for across, cell in zip(places, wrapped)])
        self._down += 0.1

    def panels(self, height: float, count: int = 1, *, stacked: bool = False) -> list[Axes]:
        """Add panels of so many inches in height, side by side or below each other."""
        self._room(height)
        wide, tall, gap = _WIDTH - 2.0 * _MARGIN, height - 0.6, 0.22 if stacked else 0.0
        made = []
        for k in range(count):
            left, width = (0.0, wide) if stacked else (k * wide / count, wide / count)
            below, share = (k * tall / count, tall / count) if stacked else (0.0, tall)
            bottom = 1.0 - (self._down + 0.1 + below + share) / _HEIGHT
            box = (_MARGIN + left + 0.55) / _WIDTH, bottom, (width - 0.65) / _WIDTH, (share - gap) / _HEIGHT
            made.append(self._figure.add_axes(box))
            made[-1].tick_params(labelsize=7, labelbottom=not stacked or k + 1 == count)
            made[-1].yaxis.label.set_size(8)
        self._down += height
        return made

    def picture(self, path: Path, height: float) -> None:
        """Add a picture from a file, where it is there, at most so many inches high."""
        if not path.exists():
            return
        image = matplotlib.image.imread(path)
        wide = _WIDTH - 2.0 * _MARGIN
        tall = min(height, wide * image.shape[0] / image.shape[1])
        self._room(tall + 0.1)
        across = tall * image.shape[1] / image.shape[0]
        x, y = (_MARGIN + 0.5 * (wide - across)) / _WIDTH, 1.0 - (self._down + tall) / _HEIGHT
        axes = self._figure.add_axes((x, y, across / _WIDTH, tall / _HEIGHT))
        axes.imshow(image, aspect="auto")
        axes.set_axis_off()
        self._down += tall + 0.1


def _inches() -> float:
    return (_WIDTH - 2.0 * _MARGIN) / _CHARACTERS


def _plain(value: Any) -> str:
    return "–" if value is None else shown(value)


def _worded(key: str) -> str:
    """Give an entry's name as words with its unit: `range_limit_m` is "range limit, m"."""
    for ending, unit in _UNITS.items():
        if key.endswith(f"_{ending}"):
            return f"{key[: -len(ending) - 1].replace('_', ' ')}, {unit}"
    return key.replace("_", " ")


def _numbers(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Give the entries of a summary that are one number, yes or no, in words; a share of the surface in per cent."""
    shares = {key: f"{100.0 * value:.3f} %" for key, value in entries.items() if key.startswith(("coverage", "seen_"))}
    kept = {key: value for key, value in entries.items() if key not in _LEFT_OUT and not isinstance(value, dict | list)}
    return {_worded(key): shares.get(key, value) for key, value in kept.items() if value is not None}


def _mission(sheet: _Sheet, scenario: Scenario) -> None:
    """Say what a scenario is: what every mission has, and what is not at its default."""
    chaser, start, goal, guard = scenario.chaser, scenario.start, scenario.goal, scenario.guard
    sheet.facts(
        {
            "target": scenario.target.source,
            "chaser": f"{chaser.mass:g} kg, within a ball of {chaser.radius:g} m; an axis at most "
            f"{chaser.force_limit:g} N and {chaser.speed_limit:g} m/s",
            "start, body frame": f"{bracketed(start.position)} m at {bracketed(start.velocity)} m/s",
            "goal, body frame": f"{bracketed(goal.position)} m within {goal.tolerance:g} m",
            "at most": f"{scenario.duration:g} s, steps of {scenario.control.period:g} s",
            "margin of the operator": f"{scenario.safety.margin:g} m",
            "law, guard": f'"{scenario.control.profile}", guard {"on" if guard.enabled else "off"}',
            "field": scenario.field.source,
        }
    )
    changed = scenario.model_copy(update={"name": Scenario().name, "seed": 0})
    own, usual = (re.split(r"\n(?=\[)|\n", as_toml(one)) for one in (changed, Scenario()))
    sheet.heading("Entries that are not at their defaults")
    table, told = "", {}
    for line in own:
        if line.startswith("["):
            table = line.strip("[]") + "."
        elif line and line not in usual:
            key, _, value = line.partition(" = ")
            told[f"{table}{key}"] = value
    sheet.facts(told or {"none": ""})


def _proofs(sheet: _Sheet, flight: Replayed) -> None:
    """Say what the law's field and the guard's level are certified for."""
    for level in flight.levels:
        what = "The law's field" if level.kind == "envelope" else "The guard's own field"
        kind = "certified" if level.proved else "sampled only, which proves nothing"
        sheet.words(
            f"{what}: e_h = {level.error_bound:.4g} m ({kind}), ‖∇f̃‖ ≤ {level.steepest:.4g}. With the chaser's centre "
            f"where f̃ > {level.level:.4g} m there is no contact."
        )


def _requirements(sheet: _Sheet, summary: Mapping[str, Any], provenance: Provenance) -> None:
    rows = summary.get("requirements") or []
    sheet.words("" if rows else "The scenario requires nothing: it has no table [require].")
    sheet.table(requirements.told(rows))
    sheet.heading("What this report was made of")
    sheet.facts(provenance.rows())


def _flight_parts(folder: Path, progress: Progress) -> _Parts:
    """Read the folder of one flight, of one leg or several."""
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        path = folder / Path(summary["flight"]).name
    except (OSError, ValueError, KeyError, TypeError):
        raise ScenarioError(
            f"{folder}: holds neither a flight nor a campaign; give the folder of fly, explore, inspect or campaign"
        ) from None
    [flight] = of_files([path], progress=part_of(progress, 0.0, 0.5))
    least = flight.verdict.minimum_clearance
    summary |= {"contact_verdict": str(flight.verdict.contact), "minimum_clearance_m": least}
    verdict, scenario, record = verdict_of(summary), flight.scenario, flight.shown

    def mission(sheet: _Sheet) -> None:
        _mission(sheet, scenario)
        goals = [] if "coverage" in summary else [scenario.goal.position]  # who inspects flies to none
        for panel, side in zip(sheet.panels(2.9, 2), PATHS_FROM):
            path = {flight.name: record.position}
            paint_paths(panel, flight.target, path, goals, eye_axes(*side), scenario=scenario)
        words = "The path from two sides, dotted where hidden. Square: start; disc: end; star: goal."
        sheet.words(words + (f" {STILL}" if has_rules(scenario) else ""), **_QUIET)
        if summary.get("guard"):
            sheet.heading("What the guard assumes, and what follows")
            sheet.figures(_numbers(summary["guard"]))

    def proved(sheet: _Sheet) -> None:
        sheet.verdict(verdict)
        sheet.words(_AUDIT)
        for remark in flight.verdict.remarks:
            sheet.words(remark)
        [panel] = sheet.panels(2.6)
        paint_clearance(panel, [flight])
        sheet.words(
            "Clearance on the exact mesh, shaded down to its proved lower bound over each step.", color="#5c6675"
        )
        sheet.heading("Certificates")
        _proofs(sheet, flight)
        sheet.words("" if flight.levels else "The flight was led by a map; what is not known free is an obstacle.")
        violated = summary.get("violated_conditions") or []
        sheet.heading("Conditions of the law's design")
        sheet.words("; ".join(violated) or "All are met, or the law has none.")

    def flown(sheet: _Sheet) -> None:
        told, pictures = _numbers(summary), summary.get("pictures", [])[:1]
        sentences = [words for words, value in told.items() if isinstance(value, str) and len(value) > 12]
        sheet.facts({words: told.pop(words) for words in sentences})
        sheet.figures(told)
        paint_motion(sheet.panels(3.4 if pictures else 4.8, 3, stacked=True), record, scenario, flight.clearance)
        for picture in pictures:
            sheet.picture(folder / Path(picture).name, 2.9)

    sheets = {
        "Mission and assumptions": mission,
        "What is proved": proved,
        "What was flown": flown,
        "Requirements": lambda sheet: _requirements(sheet, summary, Provenance.of([flight])),
    }
    return _Parts(f"{scenario.name} around {flight.target.name}", sheets)


def _campaign_parts(folder: Path, progress: Progress) -> _Parts:
    """Read a campaign's folder, finished or not; its pictures are those of its page."""
    found = results(read_campaign(folder), progress=part_of(progress, 0.0, 0.5))
    reading, place = found.reading, folder / campaign_page.PLACE
    scenario, summary = reading.scenario, {}
    if (folder / "summary.json").exists():
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))

    def proved(sheet: _Sheet) -> None:
        sheet.verdict(campaign_page.verdict(found))
        sheet.words(f"Each flight was audited by itself. {_AUDIT}")
        sheet.table(campaign_page.rate_rows(found, "how often"))
        sheet.words(campaign_page.SAMPLING[scenario.campaign.sampling])

    def flown(sheet: _Sheet) -> None:
        for name in ("distributions", "worst"):
            sheet.picture(place / f"{name}.png", 3.4)
        sheet.heading("The flights with the least clearance")
        keys = ("run", "contact", "reached", "minimum_clearance", "delta_v", "time_to_reach")
        sheet.table([{campaign_page.LABELS.get(key, key): row[key] for key in keys} for row in found.worst])

    sheets = {
        "Mission and assumptions": lambda sheet: _mission(sheet, scenario),
        "What is proved": proved,
        "What was flown": flown,
        "Requirements": lambda sheet: _requirements(sheet, summary, campaign_page.provenance(reading)),
    }
    return _Parts(f"Campaign {scenario.name}, {found.runs} of {reading.runs} runs", sheets)

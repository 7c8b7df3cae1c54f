"""Experiments: the source paper's Section VI, repeated by one command, part by part."""

import dataclasses
import datetime
import functools
import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import keepout
from keepout.apps.reproduction import case1, case2, case3, runtime, shapes, table1
from keepout.apps.reproduction.work import Part, Work, side_by_side
from keepout.core.audit.audit import Contact
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import ScenarioError, UsageError
from keepout.core.progress import Progress, never_back, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.pages.folder import results_in, write_summary
from keepout.flights.pages.page import Headline, Markup, Page, Provenance, machine, text
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_flights

PARTS: dict[str, Callable[[Work], Part]] = {
    "table1": table1.table1,
    "surfaces": shapes.surfaces,
    "volumes": shapes.volumes,
    "case1": case1.case1,
    "case2": case2.case2,
    "runtime": runtime.runtime,
    "case3": case3.case3,
}
"""In the paper's order."""
LONG = ("case3", "case1", "case2")
"""Begun first, so that the last ones, side by side, end at about the same time."""
ALONE = ("runtime",)
"""Parts that measure times, and so run while nothing else does."""

INTRODUCTION = (
    "Zhou et al., Spacecraft Safe Robust Control Using Implicit Neural Representation for Geometrically Complex "
    "Targets in Proximity Operations (arXiv 2507.13672), Section VI. For each table and figure: what the paper "
    "states, what its printed constants give here, and what Keepout's defaults give. Clearances are those of the "
    "chaser's ball to the exact mesh, bounded between samples. Every number stands in a CSV file beside this page."
)


def reproduce(
    names: str | Sequence[str],
    out: str | Path,
    *,
    quick: bool = False,
    seed: int = 0,
    fields: str | Path | None = None,
    progress: Progress = silent,
) -> list[Part]:
    """Repeat parts of the paper's Section VI in a folder; a run that was stopped goes on where it was.

    Args:
        names: of a part or of several, or "all".
        out: folder for the page, `summary.json`, and a folder for each part with its CSV files and figures.
        quick: fewer flights and shipped fields.
        seed: of every draw.
        fields: folder with fields of the paper's network, fitted before.
        progress: told how far the work is.

    Raises:
        UsageError: a part of that name does not exist.
        ScenarioError: the folder cannot be written to.

    """
    keep_programs()
    names, out, fields = (
        [names] if isinstance(names, str) else names,
        Path(out),
        None if fields is None else Path(fields),
    )
    chosen = [name for name in PARTS if name in names or "all" in names]
    for name in names:
        if name not in PARTS and name != "all":
            raise UsageError(f"experiment: {name!r} is not known; valid: all, {', '.join(PARTS)}")
    if fields is not None and not fields.is_dir():
        raise ScenarioError(f"--fields: {fields} is not a folder; give the one that an earlier run has written")
    done: dict[str, Part] = {}
    progress = never_back(progress)
    writing = threading.Lock()

    def repeated(name: str, progress: Progress) -> Part:
        began = time.perf_counter()
        part = PARTS[name](Work(out / name, quick, seed, fields, progress))
        part = dataclasses.replace(part, seconds=round(time.perf_counter() - began, 1))
        with writing:
            done[name] = part
            # After each part, so that a page stands even if a later part is stopped.
            finished = [done[name] for name in chosen if name in done]
            write_reproduction(out, finished, quick=quick)
            write_summary(out, [row for part in finished for row in part.named_rows])
        return part

    alone = [name for name in chosen if name in ALONE]
    share = 1.0 - len(alone) / len(chosen)
    order = sorted(chosen, key=lambda name: LONG.index(name) if name in LONG else len(LONG))
    jobs = {name: functools.partial(repeated, name) for name in order if name not in ALONE}
    with ExitStack() as folders:
        for name in chosen:
            folders.enter_context(results_in(out / name))
        side_by_side(jobs, part_of(progress, 0.0, share))
        for name in alone:
            repeated(name, part_of(progress, share, 1.0))
    progress(1.0, "")
    return [done[name] for name in chosen]


def write_reproduction(out: Path, parts: Sequence[Part], *, quick: bool) -> None:
    """Write the CSV files of all parts, `tables.json` with all of them, and one page.

    Args:
        out: folder; each part's figures and replay stand in the folder of its name.
        parts: in the paper's order.
        quick: whether the figures come from a quick run; the page says so.

    """
    for part in parts:
        for table in part.tables:
            table.write(out / part.name)
    told = {
        "machine": machine(),
        "date": datetime.date.today().isoformat(),
        "version": keepout.__version__,
        "quick": quick,
        "sections": [
            {
                **{"name": part.name, "title": part.title, "seconds": part.seconds},
                **{"paper": part.paper, "ours": list(part.ours)},
                "tables": [
                    {"name": table.name, "caption": table.caption, "rows": [dict(row) for row in table.rows]}
                    for table in part.tables
                ],
            }
            for part in parts
        ],
    }
    write_whole(out / "tables.json", json.dumps(told, indent=1, ensure_ascii=False) + "\n")
    page = Page(
        out / "index.html", "The paper's Section VI, repeated", _verdict(parts, quick=quick), _provenance(parts)
    )
    page.words(
        INTRODUCTION + (" This is a quick run: fewer flights, and the fields that are at hand." if quick else "")
    )
    contents = "".join(
        f'<li><a href="#{part.name}">{text(part.title)}</a>, {part.seconds:.0f} s</li>' for part in parts
    )
    page.markup(f"<ul>{contents}</ul>")
    for part in parts:
        _tell(page, part)
    page.write()


def _verdict(parts: Sequence[Part], *, quick: bool) -> Headline:
    """Say how much of it was repeated, and what became of the flights that are replayed."""
    flights = [flight for part in parts for flight in part.flights.values()]
    free = sum(flight.audit.contact is Contact.NO for flight in flights)
    said = f"{len(parts)} of {len(PARTS)} parts repeated{', quickly' if quick else ''}"
    if flights:
        said += f"; of the {len(flights)} flights replayed below {free} touched nothing, proved on the exact mesh"
    return Headline(f"{said}.", True if flights and free == len(flights) else None)


def _provenance(parts: Sequence[Part]) -> Provenance:
    named = {f"{part.name}, {name}": flight for part in parts for name, flight in part.flights.items()}
    return Provenance.of(of_flights(named))


def _tell(page: Page, part: Part) -> None:
    folder = page.path.parent / part.name
    page.heading(part.title, name=part.name)
    page.words(Markup(f"<b>The paper:</b> {text(part.paper)}"), *part.ours)
    for table in part.tables:
        link = page.link(folder / f"{table.name}.csv", f"{table.name}.csv")
        page.words(Markup(f"{text(table.caption)} ({link})"))
        page.table(table.rows, wide=True)
    if part.flights:
        write_replay(folder / "replay.html", of_flights(part.flights), title=part.title)
        page.heading("Replay", 3)
        page.replay(folder / "replay.html")
    for name, caption in part.drawings.items():
        page.picture(folder / f"{name}.png", caption, vector=True)

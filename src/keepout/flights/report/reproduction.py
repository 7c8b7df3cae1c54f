"""The folder and the page of a reproduction: what the paper states, ours, and every number as CSV."""

import base64
import csv
import datetime
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import keepout
from keepout.core.mission.flight import Flight
from keepout.core.whole_file import write_whole
from keepout.flights.replay.flights import of_flights
from keepout.flights.report.machine import machine
from keepout.flights.report.page import STYLE, embedded
from keepout.flights.report.replay_view import write_replay
from keepout.flights.report.terminal import shown


@dataclass(frozen=True)
class Table:
    """A table of a reproduction.

    Attributes:
        name: of its CSV file, without ending.
        caption: what it shows, plain text with units.
        rows: one dictionary a row, all with the same keys, which are the headings.

    """

    name: str
    caption: str
    rows: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Drawing:
    """A figure of a reproduction: `<name>.png` and `<name>.svg` in the part's folder.

    Attributes:
        name: of its files, without ending.
        caption: what it shows, plain text.

    """

    name: str
    caption: str


@dataclass(frozen=True)
class Section:
    """What the page shows of one part; see `keepout.apps.reproduction.part.Part`."""

    name: str
    title: str
    paper: str
    ours: Sequence[str]
    tables: Sequence[Table]
    drawings: Sequence[Drawing]
    flights: Mapping[str, Flight] = field(default_factory=dict)


def write_table(folder: Path, table: Table) -> Path:
    """Write a table's CSV file into a folder and return its path."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, fieldnames=list(table.rows[0]) if table.rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(table.rows)
    path = folder / f"{table.name}.csv"
    write_whole(path, stream.getvalue())
    return path


def write_reproduction(out: Path, sections: Sequence[Section], *, introduction: str, quick: bool) -> None:
    """Write the CSV files of all sections, `tables.json` with all of them, and one page.

    Args:
        out: folder; each section's figures and replay stand in the folder of its name.
        sections: in the paper's order.
        introduction: of the page, plain text.
        quick: whether the figures come from a quick run; the page says so.

    """
    for section in sections:
        for table in section.tables:
            write_table(out / section.name, table)
    write_whole(out / "tables.json", json.dumps(_tables(sections, quick=quick), indent=1, ensure_ascii=False) + "\n")
    if quick:
        introduction += " This is a quick run: fewer flights, and the fields that are at hand."
    body = [_section(out, section) for section in sections]
    contents = "".join(f'<li><a href="#{s.name}">{html.escape(s.title)}</a></li>' for s in sections)
    title = "The paper's Section VI, repeated"
    write_whole(
        out / "index.html",
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><p>{html.escape(introduction)}</p><ul>{contents}</ul>"
        f"{''.join(body)}</html>",
    )


def _tables(sections: Sequence[Section], *, quick: bool) -> dict[str, Any]:
    """Gather the words and tables of all sections as plain values, with the machine and the day."""
    return {
        "machine": machine(),
        "date": datetime.date.today().isoformat(),
        "version": keepout.__version__,
        "quick": quick,
        "sections": [
            {
                "name": section.name,
                "title": section.title,
                "paper": section.paper,
                "ours": list(section.ours),
                "tables": [
                    {"name": table.name, "caption": table.caption, "rows": [dict(row) for row in table.rows]}
                    for table in section.tables
                ],
            }
            for section in sections
        ],
    }


def _section(out: Path, section: Section) -> str:
    parts = [f'<h2 id="{section.name}">{html.escape(section.title)}</h2>']
    parts.append(f"<p><b>The paper:</b> {html.escape(section.paper)}</p>")
    parts += [f"<p>{html.escape(paragraph)}</p>" for paragraph in section.ours]
    for table in section.tables:
        link = f'<a href="{section.name}/{table.name}.csv">{table.name}.csv</a>'
        parts.append(f"<p>{html.escape(table.caption)} ({link})</p>{_table(table)}")
    if section.flights:
        write_replay(out / section.name / "replay.html", of_flights(section.flights), title=section.title)
        parts.append(f"<h3>Replay</h3>{embedded(f'{section.name}/replay.html')}")
    for drawing in section.drawings:
        image = base64.b64encode((out / section.name / f"{drawing.name}.png").read_bytes()).decode("ascii")
        link = f'<a href="{section.name}/{drawing.name}.svg">SVG</a>'
        parts.append(
            f'<figure><img alt="{html.escape(drawing.name)}" src="data:image/png;base64,{image}">'
            f"<figcaption>{html.escape(drawing.caption)} ({link})</figcaption></figure>"
        )
    return "".join(parts)


def _table(table: Table) -> str:
    if not table.rows:
        return "<p>no rows</p>"
    head = "".join(f"<th>{html.escape(key)}</th>" for key in table.rows[0])
    rows = (
        "".join(f"<td>{html.escape('–' if value is None else shown(value))}</td>" for value in row.values())
        for row in table.rows
    )
    lines = "".join(f"<tr>{row}</tr>" for row in rows)
    return f"<div class=wide><table><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table></div>"

"""The folder and the page of a reproduction: what the paper states, ours, and every number as CSV."""

import datetime
import json
from collections.abc import Sequence
from pathlib import Path

import keepout
from keepout.apps.reproduction.work import Part
from keepout.core.whole_file import write_whole
from keepout.flights.pages.folder import machine
from keepout.flights.pages.page import Markup, Page, text
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_flights


def write_reproduction(out: Path, parts: Sequence[Part], *, introduction: str, quick: bool) -> None:
    """Write the CSV files of all parts, `tables.json` with all of them, and one page.

    Args:
        out: folder; each part's figures and replay stand in the folder of its name.
        parts: in the paper's order.
        introduction: of the page, plain text.
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
                **{"name": part.name, "title": part.title, "paper": part.paper, "ours": list(part.ours)},
                "tables": [
                    {"name": table.name, "caption": table.caption, "rows": [dict(row) for row in table.rows]}
                    for table in part.tables
                ],
            }
            for part in parts
        ],
    }
    write_whole(out / "tables.json", json.dumps(told, indent=1, ensure_ascii=False) + "\n")
    page = Page(out / "index.html", "The paper's Section VI, repeated")
    page.words(
        introduction + (" This is a quick run: fewer flights, and the fields that are at hand." if quick else "")
    )
    contents = "".join(f'<li><a href="#{part.name}">{text(part.title)}</a></li>' for part in parts)
    page.markup(f"<ul>{contents}</ul>")
    for part in parts:
        _tell(page, part)
    page.write()


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
    for drawing in part.drawings:
        page.picture(folder / f"{drawing.name}.png", drawing.caption, vector=True)

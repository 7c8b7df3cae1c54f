"""One HTML page with the table and the figures of some flights, and their replay. It needs no network to open."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from keepout.core.whole_file import write_whole
from keepout.flights.report.terminal import FLIGHT_COLUMNS, broken_assumptions, shown

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#1c2430}
table{border-collapse:collapse;margin:1em 0}th,td{border-bottom:1px solid #d5dae0;padding:.35em .8em;text-align:right}
th:first-child,td:first-child{text-align:left}img{max-width:100%}.bad{color:#b00020;font-weight:600}
.wide{overflow-x:auto}.wide td,.wide th{white-space:nowrap}
code.line{display:block;white-space:pre;overflow-x:auto;user-select:all;background:#f3f5f7}
code.line{padding:.35em .6em;margin:.3em 0}
iframe{width:100%;height:660px;border:0;border-radius:6px;background:#14171c}@media print{iframe{display:none}}
"""


def write_page(
    path: Path,
    *,
    title: str,
    introduction: str,
    summaries: Sequence[Mapping[str, Any]],
    replay: Path,
    figures: Sequence[Path],
) -> None:
    """Write a page of flights that shows the replay beside it.

    Args:
        path: the HTML file to write.
        title: heading.
        introduction: what was flown and what the table says, plain text.
        summaries: one row a flight, as `fly` reports it.
        replay: the page of their replay, in the same folder.
        figures: PNG files to embed, in order.

    """
    images = "\n".join(
        f'<p><img alt="{html.escape(image.stem)}" src="data:image/png;base64,{_base64(image)}"></p>'
        for image in figures
    )
    write_whole(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><p>{html.escape(introduction)}</p>"
        f"{_table(summaries)}<h2>Replay</h2>{embedded(replay.name)}<h2>Figures</h2>{images}</html>",
    )


def embedded(address: str) -> str:
    """Give the HTML that shows a replay's page within another, with a link to it; the address is relative."""
    address = html.escape(address)
    return (
        f'<p><a href="{address}">Open the replay</a> in a window of its own: one file, to be passed on as it is.</p>'
        f'<iframe src="{address}" title="Replay" loading="lazy"></iframe>'
    )


def _table(summaries: Sequence[Mapping[str, Any]]) -> str:
    head = "".join(f"<th>{html.escape(label)}</th>" for label in ("flight", *FLIGHT_COLUMNS.values()))
    rows = []
    for summary in summaries:
        cells = [f"<td>{html.escape(str(summary['name']))}</td>"]
        for key in FLIGHT_COLUMNS:
            bad = (key == "contact" and summary[key]) or (key == "reached" and not summary[key])
            cells.append(f"<td{' class=bad' if bad else ''}>{html.escape(shown(summary[key]))}</td>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    notes = "".join(f"<p class=bad>{html.escape(line)}</p>" for line in broken_assumptions(summaries))
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>{notes}"


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")

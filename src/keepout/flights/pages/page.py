"""An HTML page of parts, words, tables, pictures and replays, that needs no network to open; and tables as CSV."""

import base64
import csv
import html
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from keepout.core.whole_file import write_whole
from keepout.flights.pages.terminal import shown

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#1c2430}
table{border-collapse:collapse;margin:1em 0}th,td{border-bottom:1px solid #d5dae0;padding:.35em .8em;text-align:right}
th:first-child,td:first-child{text-align:left}img{max-width:100%}.bad{color:#b00020;font-weight:600}
.scroll,.wide{overflow-x:auto}.wide td,.wide th{white-space:nowrap}
code.line{display:block;white-space:pre;overflow-x:auto;user-select:all;background:#f3f5f7}
code.line{padding:.35em .6em;margin:.3em 0}
iframe{width:100%;height:660px;border:0;border-radius:6px;background:#14171c}@media print{iframe{display:none}}
"""


class Markup(str):
    """Text that is HTML already."""


def text(value: Any) -> Markup:
    """Give a value for people as HTML: escaped, if it is not HTML already; None is a dash."""
    return value if isinstance(value, Markup) else Markup(html.escape("–" if value is None else shown(value)))


def bad(value: Any) -> Markup:
    """Give a value as HTML that stands out."""
    return Markup(f"<span class=bad>{text(value)}</span>")


def embedded(image: bytes, words: str) -> Markup:
    """Give a PNG as an element that holds it, with words for who cannot see it."""
    content = base64.b64encode(image).decode("ascii")
    return Markup(f'<img alt="{html.escape(words)}" src="data:image/png;base64,{content}">')


@dataclass(frozen=True)
class Table:
    """A table that stands on a page and in a CSV file.

    Attributes:
        name: of its CSV file, without ending.
        caption: what it shows, plain text with units.
        rows: one dictionary a row, all with the same keys, which are the headings.

    """

    name: str
    caption: str
    rows: Sequence[Mapping[str, Any]]

    def write(self, folder: Path) -> Path:
        """Write the CSV file into a folder and return its path; None is an empty cell."""
        stream = io.StringIO()
        writer = csv.DictWriter(stream, fieldnames=list(self.rows[0]) if self.rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        path = folder / f"{self.name}.csv"
        write_whole(path, stream.getvalue())
        return path


def rows_of(things: Iterable[Any], columns: Mapping[str, str]) -> list[dict[str, Any]]:
    """Give a table's row for each thing: under each heading the attribute of that (dotted) name; infinite is None."""
    read = {heading: attrgetter(name) for heading, name in columns.items()}
    return [{heading: finite(of(thing)) for heading, of in read.items()} for thing in things]


def finite(value: Any) -> Any:
    """Give a value as it is, or None where it is a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Page:
    """A page whose parts stand in the order in which they are added.

    Args:
        path: the HTML file that `write` writes; what the page links to is given by paths below its folder.
        title: and heading, plain text.

    """

    def __init__(self, path: Path, title: str) -> None:
        self.path, self.title = path, title
        self._parts = [f"<h1>{text(title)}</h1>"]

    def heading(self, words: str, level: int = 2, *, name: str | None = None) -> None:
        """Add a heading, which `name` can be linked to by."""
        named = "" if name is None else f' id="{html.escape(name)}"'
        self._parts.append(f"<h{level}{named}>{text(words)}</h{level}>")

    def words(self, *paragraphs: str) -> None:
        """Add paragraphs: plain text, or `Markup`."""
        self._parts += [f"<p>{text(paragraph)}</p>" for paragraph in paragraphs]

    def markup(self, element: str) -> None:
        """Add an element that is HTML already."""
        self._parts.append(element)

    def table(self, rows: Sequence[Mapping[str, Any]], *, headings: bool = True, wide: bool = False) -> None:
        """Add a table of rows with the same keys, which are its headings; `wide`: no line breaks, and it scrolls."""
        if not rows:
            self.words("no rows")
            return
        body = "".join(f"<tr>{''.join(f'<td>{text(value)}</td>' for value in row.values())}</tr>" for row in rows)
        head = f"<thead><tr>{''.join(f'<th>{text(key)}</th>' for key in rows[0])}</tr></thead>" if headings else ""
        self._parts.append(
            f"<div class={'wide' if wide else 'scroll'}><table>{head}<tbody>{body}</tbody></table></div>"
        )

    def picture(self, path: Path, caption: str = "", *, vector: bool = False) -> None:
        """Add a PNG file, held by the page; where there is an SVG beside it (`vector`), with links to both."""
        files = f"({self.link(path, 'PNG')}, {self.link(path.with_suffix('.svg'), 'SVG')})" if vector else ""
        caption = f"<figcaption>{text(caption)} {files}</figcaption>" if caption or files else ""
        self._parts.append(f"<figure>{embedded(path.read_bytes(), path.stem)}{caption}</figure>")

    def replay(self, path: Path) -> None:
        """Add another page that is a replay, with a link to it."""
        link = self.link(path, "Open the replay")
        self.words(Markup(f"{link} in a window of its own: one file, to be passed on as it is."))
        self._parts.append(f'<iframe src="{self._address(path)}" title="Replay" loading="lazy"></iframe>')

    def link(self, path: Path, words: str) -> Markup:
        """Give a link to a file below the page's folder."""
        return Markup(f'<a href="{self._address(path)}">{text(words)}</a>')

    def file(self, path: Path) -> None:
        """Add a link to a file by its name."""
        self.words(self.link(path, path.name))

    def write(self) -> None:
        """Write the page."""
        write_whole(
            self.path,
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{text(self.title)}</title>'
            f"<style>{_STYLE}</style>{''.join(self._parts)}</html>",
        )

    def _address(self, path: Path) -> str:
        return html.escape(path.relative_to(self.path.parent).as_posix())

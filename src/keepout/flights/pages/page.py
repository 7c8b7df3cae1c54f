"""An HTML page of parts, words, tables, pictures and replays, that needs no network to open; and tables as CSV.

Every page begins with its verdict and whether the theorem held, and ends with what it was made of. The head is read off
a summary, so that page, terminal and printed report say the same. The foot names all that is needed to make the page
again; `SOURCE_DATE_EPOCH` (s since 1970) stands for the date where pages are to be equal.
"""

import base64
import csv
import datetime
import html
import io
import json
import math
import os
import platform
import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import keepout
from keepout.core.whole_file import write_whole
from keepout.flights.requirements import told

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario
    from keepout.flights.pages.replayed import Replayed

_HARMLESS = "command"
"""The guard's flag that breaks no assumption: a command that was not finite was replaced."""
_BARE = re.compile(r"[A-Za-z0-9_-]+")
"""A key that TOML takes without quotes."""
_STYLE = """
:root{--ink:#1c2430;--quiet:#5c6675;--line:#d5dae0;--raised:#f3f5f7}*{box-sizing:border-box}
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:0 auto;padding:1.5em 1em;color:var(--ink)}
h1{margin:0 0 .4em;line-height:1.2}h1,p{overflow-wrap:anywhere}h2{display:inline;font-size:1.3em}
.verdict{margin:0;padding:.5em .8em;border-left:5px solid #b58a00;background:#fbf5e1;font-weight:600}
.verdict.good{border-color:#00845f;background:#e4f4ee}.verdict.bad{border-color:#b00020;background:#fbe7ea}
.theorem{margin:0 0 1em;padding:.2em .8em .5em;border-left:5px solid var(--line)}
.part{margin:1em 0;border-top:1px solid var(--line);padding-top:.6em}summary{cursor:pointer}
table{border-collapse:collapse;margin:1em 0}tr:hover td{background:var(--raised)}
th,td{border-bottom:1px solid var(--line);padding:.35em .8em;text-align:right}
th:first-child,td:first-child{text-align:left}.bad{color:#b00020}td .bad{font-weight:600}
.scroll,.wide{overflow-x:auto;max-width:100%}.wide td,.wide th,.n{white-space:nowrap}
figure{margin:1em 0;display:flex;flex-wrap:wrap;gap:.5em 1.5em;align-items:center}
img{max-width:100%;height:auto}figcaption{flex:1 1 15em;color:var(--quiet)}
code.line{display:block;white-space:pre;overflow-x:auto;user-select:all;background:var(--raised)}
code.line{padding:.35em .6em;margin:.3em 0}
iframe{width:100%;height:660px;border:0;border-radius:6px;background:#14171c}
footer{margin-top:2em;border-top:2px solid var(--line);padding-top:.6em;font-size:13px;color:var(--quiet)}
dl{display:grid;grid-template-columns:max-content minmax(0,1fr);gap:.1em 1em;margin:0 0 .6em}
dd{margin:0;overflow-wrap:anywhere}pre{overflow-x:auto;background:var(--raised);padding:.6em;color:var(--ink)}
@media(max-width:600px){body{padding:1em .6em}th,td{padding:.3em .4em}dl{display:block}dt{font-weight:600}
iframe{height:85vh}figcaption{flex-basis:100%}img{max-width:640px}}
@media print{iframe{display:none}.part{break-inside:avoid}}
"""


def shown(value: Any) -> str:
    """Format a value for a person: four digits, yes or no, counts by name."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {shown(entry)}" for key, entry in value.items()) or "none"
    if isinstance(value, list | tuple):
        numbers = all(isinstance(entry, int | float) for entry in value)
        return (", " if numbers else "\n").join(shown(entry) for entry in value) or "none"
    return str(value)


def bracketed(place: Iterable[float]) -> str:
    """Format a place, or another vector, for a person."""
    return f"[{', '.join(f'{x:g}' for x in place)}]"


@dataclass(frozen=True)
class Headline:
    """What a page says first.

    Attributes:
        said: the verdict, a sentence.
        good: whether it is what one wants; None where it is neither good nor bad, or open.
        theorem: whether the guard's theorem held, a sentence; empty where there is none to hold.

    """

    said: str
    good: bool | None = None
    theorem: str = ""


def verdict_of(summary: Mapping[str, Any]) -> Headline:
    """Say what became of one flight, by the summary that `Flight`, `Exploration` and `Inspection` give."""
    contact = str(summary["contact_verdict"])
    said = contact_said(contact, summary["minimum_clearance_m"])
    return Headline(f"{said} at every instant." if contact == "no" else f"{said}.", contact == "no", _theorem(summary))


def contact_said(contact: str, least: float, of: str = "the clearance") -> str:
    """Say what an audit says of contact and, where there was none, how large a clearance (m) is at least."""
    if contact == "no":
        return f"No contact, proved: {at_least(least, of)}"
    return {"yes": "Contact", "undecided": "Contact not excluded"}[contact]


def at_least(least: float, of: str = "the clearance") -> str:
    """Say that a clearance is at least so many metres: down to a millimetre, as it is a lower bound."""
    return f"{of} is at least {math.floor(1e3 * least) / 1e3:.3f} m"


def _theorem(summary: Mapping[str, Any]) -> str:
    certified, broken = summary.get("start_certified"), summary.get("assumptions_broken") or ()
    if certified is None or not summary.get("guard"):
        return "No guard flew, so no theorem promised anything beforehand."
    if broken:
        return f"The guard's theorem does not hold: it was flown beyond what is assumed: {'; '.join(broken)}."
    if not certified:
        return "The guard's theorem does not hold: the start is not one that it covers."
    flags = {name: steps for name, steps in (summary.get("guard_flags") or {}).items() if name != _HARMLESS}
    if flags:
        seen = ", ".join(f"{name.replace('_', ' ')} in {steps} steps" for name, steps in flags.items())
        return f"The guard's theorem covers the start; then the guard saw an assumption fail: {seen}."
    return "The guard's theorem held: it covers the start, and the guard saw no assumption fail."


@dataclass(frozen=True)
class Provenance:
    """What a page was made of.

    Attributes:
        scenarios: by words that tell them apart; a single one has none.
        digests: SHA-256 of what was flown around and by, by words.
        seed: of every draw.

    """

    scenarios: Mapping[str, "Scenario"] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None

    @classmethod
    def of(cls, flights: Iterable["Replayed"]) -> "Provenance":
        """Gather what some flights were made of."""
        flights = list(flights)
        digests = {f"mesh {flight.target.name}": flight.target.sha256 for flight in flights}
        digests |= {f"field of {flight.target.name}": flight.field_sha256 for flight in flights if flight.field_sha256}
        seeds = {flight.scenario.seed for flight in flights}
        seed = seeds.pop() if len(seeds) == 1 else None
        return cls({flight.name: flight.scenario for flight in flights}, digests, seed)

    def rows(self) -> dict[str, str]:
        """Give what stands at the foot, by words."""
        return {
            "version": f"keepout {keepout.__version__}, Python {platform.python_version()}",
            **({} if self.seed is None else {"seed": str(self.seed)}),
            **self.digests,
            "date": date(),
            "machine": machine(),
            "command": command(),
        }


def date() -> str:
    """Give the minute of now, or of `SOURCE_DATE_EPOCH`, in UTC."""
    told = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.datetime.now(datetime.UTC)
    then = datetime.datetime.fromtimestamp(int(told), datetime.UTC) if told and told.isdecimal() else now
    return f"{then:%Y-%m-%d %H:%M} UTC"


def machine() -> str:
    """Name the processor, its number of cores, and the operating system."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text(encoding="utf-8").splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, {platform.system()}"


def command() -> str:
    """Give the command line of this process where it is Keepout's, else the program that called Keepout."""
    program = Path(sys.argv[0]) if sys.argv and sys.argv[0] else Path("python")
    if program.stem == "keepout" or program.parts[-3:-1] == ("keepout", "cli"):
        return shlex.join(["keepout", *sys.argv[1:]])
    return f"Python: {program.name}"


def as_toml(scenario: "Scenario") -> str:
    """Write a scenario with every entry that has a value, as a file that `keepout fly` takes."""
    tree = json.loads(scenario.model_dump_json())
    alone = [f"{key} = {toml(value)}" for key, value in tree.items() if not isinstance(value, dict | None)]
    tables = [
        "\n".join(["", f"[{key}]", *_lines(value)]) for key, value in tree.items() if isinstance(value, dict) and value
    ]
    return "\n".join([*alone, *tables]) + "\n"


def _lines(tree: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for key, value in tree.items():
        name = f"{above}{key if _BARE.fullmatch(key) else json.dumps(key, ensure_ascii=False)}"
        if isinstance(value, dict) and value:
            yield from _lines(value, f"{name}.")
        elif value is not None:
            yield f"{name} = {toml(value)}"


def toml(value: Any) -> str:
    """Write a value of an entry as TOML does."""
    if isinstance(value, dict):
        return f"{{{', '.join(_lines(value))}}}"
    if isinstance(value, list):
        return f"[{', '.join(toml(entry) for entry in value)}]"
    # As JSON does, which is TOML but for the one control character that JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


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


def _cell(value: Any) -> str:
    """Give a table's cell; a number, which may have a minus in its exponent, stays on one line."""
    return f"<td{' class=n' if isinstance(value, float) else ''}>{text(value)}</td>"


def foot(provenance: Provenance) -> Markup:
    """Give what a page was made of as the element at its foot, each scenario folded."""
    rows = "".join(f"<dt>{text(words)}</dt><dd>{text(value)}</dd>" for words, value in provenance.rows().items())
    folded = "".join(
        f"<details><summary>{text(f'scenario {words}')}</summary><pre>{text(as_toml(scenario))}</pre></details>"
        for words, scenario in provenance.scenarios.items()
    )
    return Markup(f"<footer><dl>{rows}</dl>{folded}</footer>")


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
    """A page whose parts stand in the order in which they are added, between its head and its foot.

    Args:
        path: the HTML file that `write` writes; what the page links to is given by paths below its folder.
        title: and heading, plain text.
        verdict: what it says first.
        provenance: what it was made of, for its foot.

    """

    def __init__(self, path: Path, title: str, verdict: Headline, provenance: Provenance) -> None:
        self.path, self.title, self._provenance = path, title, provenance
        kind = {True: " good", False: " bad", None: ""}[verdict.good]
        self._parts = [f'<header><h1>{text(title)}</h1><p class="verdict{kind}">{text(verdict.said)}</p>']
        self._parts.append(f"<p class=theorem>{text(verdict.theorem)}</p></header>" if verdict.theorem else "</header>")
        self._within = ""

    def heading(self, words: str, level: int = 2, *, name: str | None = None) -> None:
        """Add a heading, which `name` can be linked to by; what follows one of level 2 can be folded away."""
        named = "" if name is None else f' id="{html.escape(name)}"'
        if level == 2:
            self._parts.append(
                f"{self._within}<details class=part open{named}><summary><h2>{text(words)}</h2></summary>"
            )
            self._within = "</details>"
        else:
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
        body = "".join(f"<tr>{''.join(map(_cell, row.values()))}</tr>" for row in rows)
        head = f"<thead><tr>{''.join(f'<th>{text(key)}</th>' for key in rows[0])}</tr></thead>" if headings else ""
        self._parts.append(
            f"<div class={'wide' if wide else 'scroll'}><table>{head}<tbody>{body}</tbody></table></div>"
        )

    def picture(self, path: Path, caption: str = "", *, vector: bool = False) -> None:
        """Add a PNG file, held by the page; where there is an SVG beside it (`vector`), with links to both."""
        files = f"({self.link(path, 'PNG')}, {self.link(path.with_suffix('.svg'), 'SVG')})" if vector else ""
        caption = f"<figcaption>{text(caption)} {files}</figcaption>" if caption or files else ""
        self._parts.append(
            f"<figure><div class=scroll>{embedded(path.read_bytes(), path.stem)}</div>{caption}</figure>"
        )

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
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{text(self.title)}</title>'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<style>{_STYLE}</style></head><body>{''.join(self._parts)}{self._within}{foot(self._provenance)}"
            "</body></html>\n",
        )

    def _address(self, path: Path) -> str:
        return html.escape(path.relative_to(self.path.parent).as_posix())


def tell_requirements(page: Page, rows: Sequence[Mapping[str, Any]]) -> None:
    """Add to a page what was required (rows of `judged` or `judged_campaign`), and whether it is met, if anything."""
    if rows:
        page.heading("Requirements")
        page.table([row | {"verdict": bad(row["verdict"])} if row["verdict"] == "FAIL" else row for row in told(rows)])

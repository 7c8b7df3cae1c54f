"""The page of a campaign, its figures, and every number as CSV: `index.html` and the folder `report` beside it."""

import base64
import html
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.campaign.bands import LEAST, QUANTITIES, RELATIVE, SHARES, Bands
from keepout.flights.campaign.dataset import read_campaign
from keepout.flights.campaign.results import QUANTILES, SIGNIFICANT, Results, results
from keepout.flights.campaign.statistics import GROUPS, none_seen_bound
from keepout.flights.report import campaign_figures
from keepout.flights.report.campaign_flights import Shown, write_replays
from keepout.flights.report.page import STYLE
from keepout.flights.report.reproduction import Table, write_table
from keepout.flights.report.terminal import shown

PLACE = "report"
"""Folder of figures and tables within the campaign's."""

_INDEPENDENT = "Intervals hold 95 % of the time or more (Clopper and Pearson): the runs are independent."
_LATIN = (
    "The runs are a Latin hypercube, so they are not independent. The variance of a rate is at most n/(n − 1) times "
    "that of independent runs (Owen 1997) and often smaller: the intervals (Clopper and Pearson) are approximate, and "
    "as a rule too wide. That they hold 95 % of the time is not proved. Nor are the p-values below exact."
)
_SOBOL = (
    "The runs are a scrambled Sobol sequence, so they are not independent. It spreads what is drawn evenly, which as a "
    "rule makes rates vary less than with independent runs: the intervals (Clopper and Pearson) are approximate, and "
    "as a rule too wide. That they hold 95 % of the time is not proved. Nor are the p-values below exact."
)
SAMPLING = {"random": _INDEPENDENT, "latin-hypercube": _LATIN, "sobol": _SOBOL}
"""What the intervals are worth, by how the runs are drawn."""
_DISTRIBUTIONS = (
    "Share of flights at or below each value. The band holds the whole true curve in 95 % of campaigns of independent "
    "runs (Dvoretzky, Kiefer and Wolfowitz)."
)
_BANDS = (
    "Quantiles over the flights under way. They are read off counts in bins: each is within "
    f"{RELATIVE:.0%} of the true one, or within {LEAST:g} where that is more; least and largest are exact."
)
_INFLUENCES = (
    "Spearman's ρ, with its sign, for numbers; η (0 to 1, less what chance gives) for choices and where a figure goes "
    f"up and down again over {GROUPS} groups of a number's draws. Coloured where the corrected p-value (Holm, over all "
    f"pairs) is below {SIGNIFICANT}: orange for ρ above 0, purple below 0, green for η. The others may be chance."
)


def report_campaign(folder: Path, *, progress: Progress = silent) -> dict[str, Any]:
    """Write the page of a campaign's folder, complete or not, with figures and CSV files in `report`.

    Args:
        folder: of the campaign.
        progress: told how far it is.

    Returns:
        The rates and the page's path, as plain values.

    Raises:
        KeepoutError: it is no campaign's folder, nothing of it is done, or a file is damaged.

    """
    reading = read_campaign(folder, progress=part_of(progress, 0.0, 0.1))
    found = results(reading, progress=part_of(progress, 0.1, 0.6))
    bands = reading.bands(part_of(progress, 0.6, 0.8))
    progress(0.8, "figures")
    place = folder / PLACE
    tables = _tables(found, bands)
    for table in tables.values():
        write_table(place, table)
    campaign_figures.draw_distributions(place / "distributions.png", found)
    campaign_figures.draw_bands(place / "bands.png", bands)
    if found.influences:
        campaign_figures.draw_influences(place / "influences.png", found)
    if found.scatters:
        campaign_figures.draw_scatters(place / "scatter.png", found)
    replays = write_replays(place, found, progress=part_of(progress, 0.85, 1.0))
    page = folder / "index.html"
    write_whole(page, _page(folder, found, tables, replays))
    progress(1.0, "")
    return {
        "page": str(page),
        "runs": reading.runs,
        "done": found.runs,
        "complete": reading.complete,
        "sampling": reading.scenario.campaign.sampling,
        "rates": [
            {"name": r.name, "count": r.count, "of": r.total, "rate": r.rate, "low": r.low, "high": r.high}
            for r in found.rates
        ],
        "worst_runs": [row["run"] for row in found.worst],
    }


def replay_command(folder: Path, run: int) -> str:
    """Give the command line that flies a run again, from any folder."""
    return shlex.join(["keepout", "campaign", "replay", str(folder.absolute()), "--run", str(run)])


def _tables(found: Results, bands: Bands) -> dict[str, Table]:
    rates = [
        {
            "what": r.name,
            "count": r.count,
            "of": r.total,
            "among": r.among,
            "rate": r.rate,
            "low": r.low,
            "high": r.high,
        }
        for r in found.rates
    ]
    quantiles = [
        {
            "figure": of.figure.label,
            "flights": of.flights,
            "not finite": of.not_finite,
            "mean": of.mean,
            **{_percent(q): None if of.quantiles is None else of.quantiles[k] for k, q in enumerate(QUANTILES)},
        }
        for of in found.distributions
    ]
    curves = [
        {"figure": of.figure.name, "value": value, "share at or below": share}
        for of in found.distributions
        for value, share in zip(of.curve.tolist(), of.shares.tolist())
    ]
    influences = [
        {
            "dispersed": one.factor,
            "figure": one.figure,
            "flights": one.runs,
            "rho": one.correlation,
            "low": one.low,
            "high": one.high,
            "p of rho": None if one.correlation is None else one.p_value,
            "eta": one.ratio,
            "p of eta": one.p_groups,
            "p corrected": p,
        }
        for one, p in zip(found.influences, found.corrected)
    ]
    points = [
        {"dispersed": of.factor.name, "drawn": _drawn(of.factor, k), "figure": of.figure.name, "value": value}
        for of in found.scatters
        for k, value in enumerate(of.values.tolist())
    ]
    over_time = {name: bands.quantiles(name, SHARES) for name in QUANTITIES}
    rows = [
        {"quantity": name, "time s": time, **{_percent(q): float(of[k, i]) for k, q in enumerate(SHARES)}}
        for name, of in over_time.items()
        for i, time in enumerate(bands.time.tolist())
        if np.isfinite(of[0, i])
    ]
    refused = [{"run": run, "reason": group.reason} for group in found.refusals for run in group.runs]
    made = (
        Table("rates", "How often, with 95 % intervals.", rates),
        Table("quantiles", "Quantiles over the flights that have a finite value.", quantiles),
        Table("distributions", "Shares of flights at or below a value.", curves),
        Table("bands", "Quantiles over the flights, over time: m, m², m, m/s.", rows),
        Table("influences", "How what was drawn and what became of the flights go together.", influences),
        Table("scatter", "The points that are drawn.", points),
        Table("worst", "The flights with the least clearance.", found.worst),
        Table("refused", "Refused runs, # in the place of each number.", refused),
    )
    return {table.name: table for table in made}


def _page(folder: Path, found: Results, tables: Mapping[str, Table], replays: Mapping[int, Shown]) -> str:
    reading = found.reading
    title = f"Campaign {reading.scenario.name}"
    standing = f"{found.runs} of {reading.runs} runs are done." if not reading.complete else f"{found.runs} runs."
    if not reading.complete:
        standing += " The campaign is not finished: all numbers are of the runs that are done"
        standing += "." if reading.scenario.campaign.sampling == "random" else ", which are a part of the design only."
    body = [
        f"<p{'' if reading.complete else ' class=bad'}>{html.escape(standing)}</p>",
        "<h2>How often</h2>",
        _table(_shown_rates(found), tables["rates"], bad={"contact", "undecided", "contact or undecided"}),
        _paragraph(SAMPLING[reading.scenario.campaign.sampling]),
        *_no_contact(found),
        "<h2>Distributions</h2>",
        _drawing(folder, "distributions", _DISTRIBUTIONS),
        _table(tables["quantiles"].rows, tables["quantiles"]),
        _link("distributions.csv"),
        "<h2>Over time</h2>",
        _drawing(folder, "bands", _BANDS),
        _link("bands.csv"),
        "<h2>Which dispersed number matters</h2>",
        *_influence_parts(folder, found),
        "<h2>Worst flights</h2>",
        *_worst_parts(folder, found, replays),
        "<h2>Refused runs</h2>",
        *_refused_parts(found),
        _paragraph("Every run's row is in flights/*.parquet."),
    ]
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1>{''.join(body)}</html>"
    )


def _shown_rates(found: Results) -> list[dict[str, Any]]:
    return [
        {
            "": r.name,
            "runs": f"{r.count} of {r.total} {r.among}",
            "rate": "–" if r.rate is None else percent(r.rate),
            "95 % interval": f"{percent(r.low)} to {percent(r.high)}",
        }
        for r in found.rates
    ]


def _no_contact(found: Results) -> list[str]:
    [contact] = [r for r in found.rates if r.name == "contact or undecided"]
    if contact.count or not contact.total or found.reading.scenario.campaign.sampling != "random":
        return []
    bound = none_seen_bound(contact.total)
    return [
        _paragraph(
            f"No contact in {contact.total} flights: its probability is below {percent(contact.high)} by the interval, "
            f"and below {percent(bound)} (about 3/n) by a bound of 95 % from one side."
        )
    ]


def _influence_parts(folder: Path, found: Results) -> list[str]:
    if not found.influences:
        return [_paragraph("Nothing was dispersed.")]
    parts = [_drawing(folder, "influences", _INFLUENCES), _link("influences.csv")]
    if found.scatters:
        words = "The strongest pairs, some runs of each, in SI units; contacts and undecided flights are crosses."
        parts += [_drawing(folder, "scatter", words), _link("scatter.csv")]
    return parts


def _worst_parts(folder: Path, found: Results, replays: Mapping[int, Shown]) -> list[str]:
    if not found.worst:
        return [_paragraph("No flights.")]
    rows, commands = [], []
    for row in found.worst:
        run = row["run"]
        link = _replay(replays.get(run))
        again = folder / f"run-{run}" / "index.html"
        if again.exists():
            link += f', <a href="run-{run}/index.html">flown again</a>'
        rows.append([_text(run), link, *(_text(_value(value)) for key, value in row.items() if key != "run")])
        commands.append(f'<code class="line">{_text(replay_command(folder, run))}</code>')
    heads = ["run", "flight", *(_text(key) for key in found.worst[0] if key != "run")]
    folded = f"<details open><summary>Commands that fly them again</summary>{''.join(commands)}</details>"
    parts = [_grid(heads, rows, lines=True), _link("worst.csv"), folded]
    if any(shown.address for shown in replays.values()):
        parts.append(
            _drawing(folder, "worst", "Clearance on the exact mesh at the recorded samples of the kept flights.")
        )
    return parts


def _replay(shown: Shown | None) -> str:
    if shown is None:
        return "not kept"
    if shown.address is None:
        return _text(shown.why_not)
    return f'<a href="{html.escape(f"{PLACE}/{shown.address}")}">replay</a>'


def _refused_parts(found: Results) -> list[str]:
    if not found.refusals:
        return [_paragraph("None.")]
    rows = []
    for group in found.refusals:
        some = ", ".join(str(run) for run in group.runs[:20]) + (", …" if len(group.runs) > 20 else "")
        rows.append([_text(group.reason), _text(len(group.runs)), _text(some), _text(group.example)])
    return [_grid(["reason", "runs", "run numbers", "the first, in full"], rows), _link("refused.csv")]


def percent(share: float) -> str:
    """Give a share for people: per cent with four digits."""
    return f"{100.0 * share:.4g} %"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"


def _drawn(factor: Any, place: int) -> Any:
    value = factor.values[place]
    return factor.levels[int(value)] if factor.levels is not None else float(value)


def _value(value: Any) -> str:
    return "–" if value is None else shown(value)


def _text(value: Any) -> str:
    return html.escape(str(value))


def _paragraph(words: str) -> str:
    return f"<p>{html.escape(words)}</p>"


def _link(name: str) -> str:
    return f'<p><a href="{PLACE}/{name}">{name}</a></p>'


def _table(rows: Sequence[Mapping[str, Any]], table: Table, *, bad: set[str] | None = None) -> str:
    marked = [bool(bad) and row.get("") in (bad or ()) and not str(row["runs"]).startswith("0 ") for row in rows]
    return html_table(rows, marked) + _link(f"{table.name}.csv")


def html_table(rows: Sequence[Mapping[str, Any]], marked: Sequence[bool] | None = None) -> str:
    """Give rows with the same keys as an HTML table; marked rows stand out."""
    heads = [_text(key) for key in rows[0]]
    return _grid(heads, [[_text(_value(value)) for value in row.values()] for row in rows], marked)


def _grid(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    marked: Sequence[bool] | None = None,
    *,
    lines: bool = False,
) -> str:
    """Give a table of ready HTML cells; marked rows stand out. With `lines` each row is one, to be scrolled."""
    body = []
    for place, row in enumerate(rows):
        mark = " class=bad" if marked and marked[place] else ""
        body.append(f"<tr{mark}>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>")
    head = "".join(f"<th>{cell}</th>" for cell in heads)
    scroll = "class=wide" if lines else 'style="overflow-x:auto"'
    return f"<div {scroll}><table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"


def _drawing(folder: Path, name: str, caption: str) -> str:
    image = base64.b64encode((folder / PLACE / f"{name}.png").read_bytes()).decode("ascii")
    return (
        f'<figure><img alt="{name}" src="data:image/png;base64,{image}"><figcaption>{html.escape(caption)} '
        f'(<a href="{PLACE}/{name}.png">PNG</a>, <a href="{PLACE}/{name}.svg">SVG</a>)</figcaption></figure>'
    )

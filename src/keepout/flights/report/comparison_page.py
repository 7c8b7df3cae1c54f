"""Two campaigns side by side: tables for the terminal and JSON, a page with figures, and CSV."""

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from keepout.core.errors import ScenarioError
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.campaign.dataset import read_campaign
from keepout.flights.campaign.results import Comparison, compare
from keepout.flights.report.campaign_page import SAMPLING, html_table, percent
from keepout.flights.report.folder import results_in
from keepout.flights.report.page import STYLE
from keepout.flights.report.reproduction import Table, write_table
from keepout.flights.report.style import COLOURS, figure

_UNPAIRED = (
    "The runs are no pairs: seed, dispersions or sampling differ. Differences of rates have Newcombe's hybrid score "
    "interval (1998, method 10) and Fisher's exact test."
)


def compare_campaigns(
    first: Path, second: Path, out: Path | None = None, *, progress: Progress = silent
) -> dict[str, Any]:
    """Compare two finished campaigns; write page, figures and CSV where a folder is given.

    Returns:
        All tables as plain values, by name, with `paired` and the page's path.

    Raises:
        KeepoutError: a folder holds no finished campaign, or is damaged.

    """
    if out is not None and out.absolute() in (first.absolute(), second.absolute()):
        raise ScenarioError(f"{out}: holds a campaign, whose page would be replaced; give another folder")
    with results_in(out):
        readings = [read_campaign(folder) for folder in (first, second)]
        found = compare(*readings, progress=part_of(progress, 0.0, 0.8))
    tables = comparison_tables(found)
    answer: dict[str, Any] = {
        "first": str(first),
        "second": str(second),
        "paired": found.paired,
        "unlike": found.unlike,
        "words": _words(found),
        **{name: list(table.rows) for name, table in tables.items()},
    }
    if out is not None:
        for table in tables.values():
            write_table(out, table)
        _draw_rates(out / "rates.png", found)
        if found.differences:
            _draw_differences(out / "differences.png", found)
        write_whole(out / "index.html", _page(out, found, tables))
        write_whole(out / "summary.json", json.dumps(answer, indent=1, allow_nan=False) + "\n")
        answer["page"] = str(out / "index.html")
    progress(1.0, "")
    return answer


def comparison_tables(found: Comparison) -> dict[str, Table]:
    """Give every number of a comparison as tables; what is infinite is None."""
    rates = [
        {
            "what": one.first.name,
            "A": one.first.rate,
            "A low": one.first.low,
            "A high": one.first.high,
            "B": one.second.rate,
            "B low": one.second.low,
            "B high": one.second.high,
            "A - B": one.difference,
            "low": one.low,
            "high": one.high,
            "p": one.p_value,
            **dict(zip(("both", "A only", "B only", "neither"), one.pairs or ())),
        }
        for one in found.rates
    ]
    quantiles = [
        {
            "figure": one.figure.label,
            "quantile": f"{100.0 * one.share:g} %",
            "A": one.first,
            "B": one.second,
            "A - B": one.first - one.second,
            "low": _finite(one.low),
            "high": _finite(one.high),
        }
        for one in found.quantiles
    ]
    by_run = [
        {
            "figure": one.figure.label,
            "pairs": one.pairs,
            "mean A - B": one.mean,
            "mean low": _finite(one.mean_low),
            "mean high": _finite(one.mean_high),
            "median A - B": one.median,
            "median low": _finite(one.median_low),
            "median high": _finite(one.median_high),
            "A lower": one.lower,
            "A higher": one.higher,
            "p of sign": one.p_value,
        }
        for one in found.differences
    ]
    differing = [{"entry": name, "A": json.dumps(a), "B": json.dumps(b)} for name, a, b in found.differing]
    made = (
        Table("differing", "What differs between the two.", differing),
        Table("rates", "How often, with 95 % intervals.", rates),
        Table("quantiles", "Quantiles of the flights of each; the difference with an interval, about 95 %.", quantiles),
        Table("by_run", "A less B, run by run.", by_run),
    )
    return {table.name: table for table in made}


def _words(found: Comparison) -> list[str]:
    if found.paired is None:
        words = [_UNPAIRED]
    else:
        words = [
            f"Run k drew the same in both, in {found.paired} runs: these are pairs. Differences of rates are of pairs, "
            "with Newcombe's interval for paired data (1998, method 10) and McNemar's exact test."
        ]
        if found.unlike:
            words.append(
                f"{found.unlike} runs drew something else (a start drawn again) and are left out of the pairs."
            )
    sampling = {reading.scenario.campaign.sampling for reading in (found.first, found.second)}
    return [*words, *(SAMPLING[name] for name in sorted(sampling))]


def _page(out: Path, found: Comparison, tables: Mapping[str, Table]) -> str:
    names = [f"{label}: {reading.folder}" for label, reading in zip("AB", (found.first, found.second))]
    body = [f"<p>{html.escape('; '.join(names))}</p>", *(f"<p>{html.escape(words)}</p>" for words in _words(found))]
    for name, table in tables.items():
        if not table.rows:
            continue
        link = f'<a href="{name}.csv">{name}.csv</a>'
        body.append(f"<h2>{html.escape(table.caption)}</h2>{html_table(_for_people(name, table.rows))}<p>{link}</p>")
        image = {"rates": "rates", "by_run": "differences"}.get(name)
        if image is not None:
            content = base64.b64encode((out / f"{image}.png").read_bytes()).decode("ascii")
            links = f'<a href="{image}.png">PNG</a>, <a href="{image}.svg">SVG</a>'
            body.append(
                f'<figure><img alt="{image}" src="data:image/png;base64,{content}">'
                f"<figcaption>{links}</figcaption></figure>"
            )
    title = "Two campaigns compared"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style><h1>{title}</h1>{''.join(body)}</html>"
    )


def _for_people(name: str, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Give rates as per cent."""
    if name != "rates":
        return [dict(row) for row in rows]
    shares = ("A", "A low", "A high", "B", "B low", "B high", "A - B", "low", "high")
    return [{k: percent(v) if k in shares and v is not None else v for k, v in row.items()} for row in rows]


def _draw_rates(path: Path, found: Comparison) -> None:
    with figure(path, width=3.5, height=2.6, vector=True) as drawing:
        axes = drawing.add_subplot()
        for place, one in enumerate(found.rates):
            if one.difference is None:
                continue
            axes.plot([100.0 * one.low, 100.0 * one.high], [place, place], color=COLOURS[0], linewidth=1.4)
            axes.plot(100.0 * one.difference, place, "o", color=COLOURS[0], markersize=4)
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set_yticks(
            range(len(found.rates)), [one.first.name.replace(": ", ":\n") for one in found.rates], fontsize=7
        )
        axes.invert_yaxis()
        axes.tick_params(labelsize=7)
        axes.set_xlabel("rate of A less that of B, percentage points", fontsize=8)


def _draw_differences(path: Path, found: Comparison) -> None:
    with figure(path, width=3.5, height=3.3, vector=True) as drawing:
        panels = drawing.subplots(2, 2, sharey=True)
        for axes in panels.flat[len(found.differences) :]:
            axes.set_axis_off()
        for axes, one in zip(panels.flat, found.differences):
            axes.step(one.curve, 100.0 * one.shares, where="post", color=COLOURS[0], linewidth=1.2)
            axes.axvline(0.0, color="black", linewidth=0.8)
            axes.set_xlabel(f"A − B: {one.figure.label}", fontsize=7)
            axes.tick_params(labelsize=7)
        for axes in panels[:, 0]:
            axes.set_ylabel("pairs at or below, %", fontsize=8)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None

"""Two campaigns side by side: tables for the terminal and JSON, a page with figures, and CSV."""

import json
from pathlib import Path
from typing import Any

from matplotlib.ticker import MaxNLocator

from keepout.core.errors import ScenarioError
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.campaign.dataset import read_campaign
from keepout.flights.campaign.results import Comparison, compare
from keepout.flights.pages.campaign_page import SAMPLING, percent, provenance
from keepout.flights.pages.figures import COLOURS, column
from keepout.flights.pages.folder import results_in
from keepout.flights.pages.head_and_foot import Headline, Provenance
from keepout.flights.pages.page import Page, Table, finite, rows_of

_UNPAIRED = (
    "The runs are no pairs: seed, dispersions or sampling differ. Differences of rates have Newcombe's hybrid score "
    "interval (1998, method 10) and Fisher's exact test."
)
_RATES = {
    **{"what": "first.name", "A": "first.rate", "A low": "first.low", "A high": "first.high"},
    **{"B": "second.rate", "B low": "second.low", "B high": "second.high"},
    **{"A - B": "difference", "low": "low", "high": "high", "p": "p_value"},
}
_BY_RUN = {
    **{"figure": "figure.label", "pairs": "pairs", "mean A - B": "mean", "mean low": "mean_low"},
    **{"mean high": "mean_high", "median A - B": "median", "median low": "median_low"},
    **{"median high": "median_high", "A lower": "lower", "A higher": "higher", "p of sign": "p_value"},
}
_CAPTIONS = {
    "rates": "Rate of A less that of B, with its 95 % interval: where that holds zero, the two may be equal.",
    "by_run": "Share of the pairs of runs whose difference A − B is at or below each value.",
}
_FIGURES = {"rates": "rates.png", "by_run": "differences.png"}


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
        **{table.name: list(table.rows) for table in tables},
    }
    if out is not None:
        for table in tables:
            table.write(out)
        _draw_rates(out / "rates.png", found)
        if found.differences:
            _draw_differences(out / "differences.png", found)
        page = Page(out / "index.html", "Two campaigns compared", _verdict(found), _provenance(found))
        _tell(page, found, tables)
        page.write()
        write_whole(out / "summary.json", json.dumps(answer, indent=1, allow_nan=False) + "\n")
        answer["page"] = str(page.path)
    progress(1.0, "")
    return answer


def comparison_tables(found: Comparison) -> list[Table]:
    """Give every number of a comparison as tables; what is infinite is None."""
    rates = [
        row | dict(zip(("both", "A only", "B only", "neither"), one.pairs or ()))
        for row, one in zip(rows_of(found.rates, _RATES), found.rates)
    ]
    quantiles = [{key: finite(value) for key, value in row.items()} for row in found.quantiles]
    differing = [{"entry": name, "A": json.dumps(a), "B": json.dumps(b)} for name, a, b in found.differing]
    return [
        Table("differing", "What differs between the two.", differing),
        Table("rates", "How often, with 95 % intervals.", rates),
        Table("quantiles", "Quantiles of the flights of each; the difference with an interval, about 95 %.", quantiles),
        Table("by_run", "A less B, run by run.", rows_of(found.differences, _BY_RUN)),
    ]


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


def _verdict(found: Comparison) -> Headline:
    """Say which of the two touched more often, and whether that may be chance."""
    [one] = [one for one in found.rates if one.first.name == "contact or undecided"]
    told = [
        f"{label} {rate.count} of {rate.total}" for label, rate in (("A", one.first), ("B", one.second)) if rate.total
    ]
    said = f"Contact or undecided: {', '.join(told) or 'no flights'}"
    if one.difference is None:
        return Headline(f"{said}.")
    apart = one.low > 0.0 or one.high < 0.0
    points = [f"{100.0 * value:+.3g}" for value in (one.difference, one.low, one.high)]
    said += f"; A − B is {points[0]} percentage points, {points[1]} to {points[2]} with 95 %"
    return Headline(f"{said}{'' if apart else ': no difference is shown'}.")


def _provenance(found: Comparison) -> Provenance:
    both = [(label, provenance(reading)) for label, reading in zip("AB", (found.first, found.second))]
    scenarios = {f"{label}: {name}": of for label, made in both for name, of in made.scenarios.items()}
    digests = {f"{label}: {words}": sha256 for label, made in both for words, sha256 in made.digests.items()}
    return Provenance(scenarios, digests)


def _tell(page: Page, found: Comparison, tables: list[Table]) -> None:
    folder = page.path.parent
    names = [f"{label}: {reading.folder}" for label, reading in zip("AB", (found.first, found.second))]
    page.words("; ".join(names), *_words(found))
    for table in tables:
        if not table.rows:
            continue
        rows = table.rows
        if table.name == "rates":
            rows = [{k: _share(k, v) for k, v in row.items()} for row in rows]
        page.heading(table.caption.rstrip("."))
        page.table(rows)
        page.file(folder / f"{table.name}.csv")
        if table.name in _FIGURES:
            page.picture(folder / _FIGURES[table.name], _CAPTIONS[table.name], vector=True)


def _share(heading: str, value: Any) -> Any:
    """Give a rate in per cent, a difference of rates in percentage points, and all else as it is."""
    if not isinstance(value, float) or heading == "p":
        return value
    return f"{100.0 * value:+.4g}\u00a0points" if heading in ("A - B", "low", "high") else percent(value)


def _draw_rates(path: Path, found: Comparison) -> None:
    with column(path, 2.6) as drawing:
        axes = drawing.add_subplot()
        for place, one in enumerate(found.rates):
            if one.difference is None:
                continue
            axes.plot([100.0 * one.low, 100.0 * one.high], [place, place], color=COLOURS[0], linewidth=1.4)
            axes.plot(100.0 * one.difference, place, "o", color=COLOURS[0], markersize=4)
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set_yticks(range(len(found.rates)), [one.first.name.replace(": ", ":\n") for one in found.rates])
        axes.invert_yaxis()
        axes.set_xlabel("rate of A less that of B, percentage points")


def _draw_differences(path: Path, found: Comparison) -> None:
    with column(path, 3.3) as drawing:
        panels = drawing.subplots(2, 2, sharey=True)
        for axes in panels.flat[len(found.differences) :]:
            axes.set_axis_off()
        for axes, one in zip(panels.flat, found.differences):
            axes.step(one.curve, 100.0 * one.shares, where="post", color=COLOURS[0], linewidth=1.2)
            axes.axvline(0.0, color="black", linewidth=0.8)
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.set_xlabel(f"A − B: {one.figure.label}", fontsize=7)
        for axes in panels[:, 0]:
            axes.set_ylabel("pairs at or below, %")

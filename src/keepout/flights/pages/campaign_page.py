"""The page of a campaign, its figures and replays, and every number as CSV: `index.html` and `report` beside it.

And the page of two campaigns side by side, whose tables a terminal and JSON show too.
"""

import json
import shlex
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import KeepoutError, ScenarioError
from keepout.core.mission.task_entries import RequireEntry
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.campaign.bands import LEAST, QUANTITIES, RELATIVE, SHARES, Bands
from keepout.flights.campaign.dataset import Dataset, read_campaign
from keepout.flights.campaign.plan import Workshop
from keepout.flights.campaign.results import FIGURES, QUANTILES, SIGNIFICANT, Comparison, Results, compare, results
from keepout.flights.campaign.statistics import GROUPS, none_seen_bound
from keepout.flights.pages import campaign_figures
from keepout.flights.pages.figures import COLOURS, column, looks
from keepout.flights.pages.folder import results_in
from keepout.flights.pages.page import Headline, Markup, Page, Provenance, Table, bad, rows_of, tell_requirements, text
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import Replayed, of_record
from keepout.flights.requirements import judged_campaign

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

Clearance = tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]
"""Times, s, and clearances on the exact mesh, m."""


def report_campaign(
    folder: Path,
    *,
    require: RequireEntry | None = None,
    kept: Callable[[], Any] = lambda: None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write the page of a campaign's folder, complete or not, with figures and CSV files in `report`.

    Args:
        folder: of the campaign.
        require: what is required of its runs; else what its `summary.json` says was.
        kept: called when the flight files of what is kept must be there: it may wait for them.
        progress: told how far it is.

    Returns:
        The rates, the requirements and the page's path, as plain values.

    Raises:
        KeepoutError: it is no campaign's folder, nothing of it is done, or a file is damaged.

    """
    keep_programs()  # a surface that the campaign has cut for its own page is not cut again
    reading = read_campaign(folder, progress=part_of(progress, 0.0, 0.1))
    found = results(reading, progress=part_of(progress, 0.1, 0.6))
    bands = reading.bands(part_of(progress, 0.6, 0.8))
    progress(0.8, "figures")
    place = folder / PLACE
    for table in _tables(found, bands):
        table.write(place)
    with ThreadPoolExecutor(1) as aside:  # distances beside the drawing: the one needs kernels, the other Python
        gathering = aside.submit(_worst, found, kept)
        campaign_figures.draw_distributions(place / "distributions.png", found)
        campaign_figures.draw_over_time(place / "bands.png", bands)
        if found.influences:
            campaign_figures.draw_influences(place / "influences.png", found)
        if found.scatters:
            campaign_figures.draw_scatters(place / "scatter.png", found)
        progress(0.85, "the worst flights")
        worst = gathering.result()
    replays = _write_replays(place, found, worst, progress=part_of(progress, 0.9, 1.0))
    requirements = judged_campaign(_recorded(folder) if require is None else require, reading)
    title = f"Campaign {reading.scenario.name}"
    page = Page(folder / "index.html", title, verdict(found), provenance(reading))
    tell_requirements(page, requirements)
    _tell(page, found, replays)
    page.write()
    progress(1.0, "")
    return {
        "page": str(page.path),
        "runs": reading.runs,
        "done": found.runs,
        "complete": reading.complete,
        "sampling": reading.scenario.campaign.sampling,
        "rates": rows_of(found.rates, {"name": "name", "count": "count", "of": "total"} | _INTERVAL),
        "worst_runs": [row["run"] for row in found.worst],
        "requirements": requirements,
    }


def _recorded(folder: Path) -> RequireEntry:
    """Read what was required of a campaign's runs when it was flown last; nothing where it is unfinished."""
    try:
        return RequireEntry(**json.loads((folder / "summary.json").read_text(encoding="utf-8"))["require"])
    except (OSError, ValueError, KeyError, TypeError):
        return RequireEntry()


def replay_command(folder: Path, run: int) -> str:
    """Give the command line that flies a run again, from any folder."""
    return shlex.join(["keepout", "campaign", "replay", str(folder.absolute()), "--run", str(run)])


def percent(share: float) -> str:
    """Give a share for people: per cent with four digits, which no line break parts."""
    return f"{100.0 * share:.4g}\u00a0%"


def verdict(found: Results) -> Headline:
    """Say how many flights touched, how often that is at most, and of how many the guard's theorem covers the start."""
    [contact] = [rate for rate in found.rates if rate.name == "contact or undecided"]
    if not contact.total:
        said, good = f"None of {found.runs} runs was flown.", False
    elif contact.count:
        said, good = f"Contact, or not excluded, in {contact.count} of {contact.total} flights", False
        said += f": {percent(contact.rate or 0.0)}, {percent(contact.low)} to {percent(contact.high)} with 95 %."
    else:
        said, good = f"No contact, proved, in each of {contact.total} flights", True
        said += f": its probability is at most {percent(contact.high)} with 95 %."
    if not found.reading.complete:
        said += f" {found.runs} of {found.reading.runs} runs are done."
    return Headline(said, good, _theorem(found.reading))


def _theorem(reading: Dataset) -> str:
    certified = reading.arrays(["start_certified"])["start_certified"] if "start_certified" in reading.names else []
    known = np.asarray(certified)[np.isfinite(certified)]
    if not known.size:
        return "No guard flew, so no theorem promised anything beforehand."
    return f"The guard's theorem covers the start of {int(known.sum())} of {known.size} flights."


def provenance(reading: Dataset) -> Provenance:
    """Say what a campaign was made of."""
    digests = {words: reading.identity.get(f"{words}_sha256", "") for words in ("target", "field")}
    return Provenance({reading.scenario.name: reading.scenario}, digests, reading.scenario.seed)


LABELS = {figure.column: figure.label for figure in FIGURES} | {"guard_interventions": "guard steps"}
"""Headings with units of a table's columns, for people."""
_INTERVAL = {"rate": "rate", "low": "low", "high": "high"}
_INFLUENCE = {
    **{"dispersed": "factor", "figure": "figure", "flights": "runs", "rho": "correlation", "low": "low"},
    **{"high": "high", "p of rho": "p_value", "eta": "ratio", "p of eta": "p_groups"},
}


def _tables(found: Results, bands: Bands) -> list[Table]:
    counted = {"what": "name", "count": "count", "of": "total", "among": "among"}
    curves = [
        {"figure": of.figure.name, "value": value, "share at or below": share}
        for of in found.distributions
        for value, share in zip(of.curve.tolist(), of.shares.tolist())
    ]
    influences = [
        row | {"p of rho": None if row["rho"] is None else row["p of rho"], "p corrected": p}
        for row, p in zip(rows_of(found.influences, _INFLUENCE), found.corrected)
    ]
    points = [
        {"dispersed": of.factor.name, "drawn": drawn, "figure": of.figure.name, "value": value}
        for of in found.scatters
        for drawn, value in zip(of.drawn, of.values.tolist())
    ]
    over_time = {name: bands.quantiles(name, SHARES) for name in QUANTITIES}
    rows = [
        {"quantity": name, "time s": time, **{f"{100.0 * q:g} %": float(of[k, i]) for k, q in enumerate(SHARES)}}
        for name, of in over_time.items()
        for i, time in enumerate(bands.time.tolist())
        if np.isfinite(of[0, i])
    ]
    refused = [{"run": run, "reason": group.reason} for group in found.refusals for run in group.runs]
    return [
        Table("rates", "How often, with 95 % intervals.", rows_of(found.rates, counted | _INTERVAL)),
        Table("quantiles", "Quantiles over the flights that have a finite value.", _quantiles(found)),
        Table("distributions", "Shares of flights at or below a value.", curves),
        Table("bands", "Quantiles over the flights, over time: m, m², m, m/s.", rows),
        Table("influences", "How what was drawn and what became of the flights go together.", influences),
        Table("scatter", "The points that are drawn.", points),
        Table("worst", "The flights with the least clearance.", found.worst),
        Table("refused", "Refused runs, # in the place of each number.", refused),
    ]


def _quantiles(found: Results) -> list[dict[str, Any]]:
    columns = {"figure": "figure.label", "flights": "flights", "not finite": "not_finite", "mean": "mean"}
    return [
        row | {f"{100.0 * q:g} %": None if of.quantiles is None else of.quantiles[k] for k, q in enumerate(QUANTILES)}
        for row, of in zip(rows_of(found.distributions, columns), found.distributions)
    ]


def _tell(page: Page, found: Results, replays: Mapping[int, Markup]) -> None:
    """Fill the page of a campaign."""
    reading, place = found.reading, page.path.parent / PLACE
    sampling = reading.scenario.campaign.sampling
    if not reading.complete:
        part = "." if sampling == "random" else ", which are a part of the design only."
        said = f"{found.runs} of {reading.runs} runs are done. The campaign is not finished: all numbers are of the"
        page.words(bad(f"{said} runs that are done{part}"))
    page.heading("How often")
    _tell_rates(page, found)
    page.file(place / "rates.csv")
    page.words(SAMPLING[sampling])
    [contact] = [r for r in found.rates if r.name == "contact or undecided"]
    if not contact.count and contact.total and sampling == "random":
        page.words(
            f"No contact in {contact.total} flights: its probability is below {percent(contact.high)} by the interval, "
            f"and below {percent(none_seen_bound(contact.total))} (about 3/n) by a bound of 95 % from one side."
        )
    page.heading("Distributions")
    page.picture(place / "distributions.png", _DISTRIBUTIONS, vector=True)
    page.table(_quantiles(found))
    page.file(place / "quantiles.csv")
    page.file(place / "distributions.csv")
    page.heading("Over time")
    page.picture(place / "bands.png", _BANDS, vector=True)
    page.file(place / "bands.csv")
    page.heading("Which dispersed number matters")
    if not found.influences:
        page.words("Nothing was dispersed.")
    else:
        page.picture(place / "influences.png", _INFLUENCES, vector=True)
        page.file(place / "influences.csv")
    if found.scatters:
        words = "The strongest pairs, some runs of each, in SI units; contacts and undecided flights are crosses."
        page.picture(place / "scatter.png", words, vector=True)
        page.file(place / "scatter.csv")
    page.heading("Worst flights")
    _tell_worst(page, found, replays)
    page.heading("Refused runs")
    _tell_refused(page, found)
    page.words("Every run's row is in flights/*.parquet.")


def rate_rows(found: Results, heading: str = "") -> list[dict[str, str]]:
    """Give how often each thing happened as rows for people; the heading stands over what happened."""
    return [
        {
            heading: rate.name,
            "runs": f"{rate.count} of {rate.total} {rate.among}",
            "rate": "–" if rate.rate is None else percent(rate.rate),
            "95 % interval": f"{percent(rate.low)} to {percent(rate.high)}",
        }
        for rate in found.rates
    ]


def _tell_rates(page: Page, found: Results) -> None:
    rows = []
    for rate, row in zip(found.rates, rate_rows(found)):
        mark = bad if rate.count and rate.name in ("contact", "undecided", "contact or undecided") else text
        rows.append({key: mark(value) for key, value in row.items()})
    page.table(rows)


def _tell_worst(page: Page, found: Results, replays: Mapping[int, Markup]) -> None:
    if not found.worst:
        page.words("No flights.")
        return
    folder, rows, commands = page.path.parent, [], []
    for row in found.worst:
        run = row["run"]
        link, again = replays.get(run, text("not kept")), folder / f"run-{run}" / "index.html"
        if again.exists():
            link = Markup(f"{link}, {page.link(again, 'flown again')}")
        rows.append({"run": run, "flight": link, **{LABELS.get(k, k): value for k, value in row.items() if k != "run"}})
        commands.append(f'<code class="line">{text(replay_command(folder, run))}</code>')
    page.table(rows, wide=True)
    page.file(folder / PLACE / "worst.csv")
    page.markup(f"<details open><summary>Commands that fly them again</summary>{''.join(commands)}</details>")
    if (folder / PLACE / "worst.png").exists():
        words = "Clearance on the exact mesh at the recorded samples of the kept flights."
        page.picture(folder / PLACE / "worst.png", words, vector=True)


def _tell_refused(page: Page, found: Results) -> None:
    if not found.refusals:
        page.words("None.")
        return
    rows = []
    for group in found.refusals:
        some = ", ".join(str(run) for run in group.runs[:20]) + (", …" if len(group.runs) > 20 else "")
        row = {"reason": group.reason, "runs": len(group.runs), "run numbers": some}
        rows.append(row | {"the first, in full": group.example})
    page.table(rows)
    page.file(page.path.parent / PLACE / "refused.csv")


def _worst(found: Results, kept: Callable[[], Any]) -> dict[int, Replayed | KeepoutError]:
    """Gather the worst flights that have a flight file, by run: with what is drawn of them, or why that cannot be."""
    kept()
    workshop = Workshop()
    gathered: dict[int, Replayed | KeepoutError] = {}
    for run in (row["run"] for row in found.worst):
        record = found.reading.kept_record(run)
        if record is None:  # the page says so
            continue
        try:
            gathered[run] = flight = of_record(f"run {run}", record, workshop)
        except KeepoutError as refusal:
            gathered[run] = refusal
        else:
            _ = flight.clearance, flight.proved  # the flight keeps them
    return gathered


def _write_replays(
    place: Path, found: Results, worst: Mapping[int, Replayed | KeepoutError], *, progress: Progress
) -> dict[int, Markup]:
    """Write replays of the worst flights that have a flight file, one page a target, and a figure of their clearances.

    Args:
        place: folder for the pages `worst.html`, `worst-2.html`, … and the figure `worst.png` and `.svg`.
        found: the campaign's results.
        worst: the flights.
        progress: told as pages are written.

    Returns:
        By run number, for the flights that were kept: a link to the replay, or why it has none. Without flight files
        nothing is written.

    """
    groups: dict[str, list[Replayed]] = {}
    links: dict[int, Markup] = {}
    curves: dict[int, Clearance] = {}
    for run, flight in worst.items():
        if isinstance(flight, KeepoutError):
            links[run] = text(str(flight))
            continue
        groups.setdefault(flight.target.sha256, []).append(flight)
        address = f"{PLACE}/{_replay(list(groups).index(flight.target.sha256))}#{quote(flight.name)}"
        links[run] = Markup(f'<a href="{address}">replay</a>')
        curves[run] = flight.shown.time, flight.clearance
    for stale in (*place.glob("worst*.html"), *place.glob("worst.png"), *place.glob("worst.svg")):
        stale.unlink()
    title = f"Campaign {found.reading.scenario.name}: worst flights"
    for number, group in enumerate(groups.values()):
        part = part_of(progress, number / len(groups), (number + 1) / len(groups))
        write_replay(place / _replay(number), group, title=title, progress=part)
    if curves:
        _draw_worst(place / "worst.png", curves)
    return links


def _replay(number: int) -> str:
    return "worst.html" if number == 0 else f"worst-{number + 1}.html"


def _draw_worst(path: Path, curves: Mapping[int, Clearance]) -> None:
    with column(path, 2.8) as drawing:
        axes = drawing.add_subplot()
        for look, (run, (time, clearance)) in zip(looks(len(curves)), curves.items()):
            axes.plot(time, clearance, linewidth=0.9, label=f"run {run}", **look)
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="time, s", ylabel="clearance, m")
        drawing.legend(loc="outside lower center", ncols=3)


_UNPAIRED = (
    "The runs are no pairs: seed, dispersions or sampling differ. Differences of rates have Newcombe's hybrid score "
    "interval (1998, method 10) and Fisher's exact test."
)
_RATES_OF_TWO = {
    **{"what": "first.name", "A": "first.rate", "A low": "first.low", "A high": "first.high"},
    **{"B": "second.rate", "B low": "second.low", "B high": "second.high"},
    **{"A - B": "difference", "low": "low", "high": "high", "p": "p_value"},
}
_CAPTIONS = {
    "rates": "Rate of A less that of B, with its 95 % interval: where that holds zero, the two may be equal.",
    "by_run": "Share of the pairs of runs whose difference A − B is at or below each value.",
}
_PICTURES = {"rates": "rates.png", "by_run": "differences.png"}


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
        "words": _said_of_two(found),
        **{table.name: list(table.rows) for table in tables},
    }
    if out is not None:
        for table in tables:
            table.write(out)
        _draw_rates(out / "rates.png", found)
        if found.differences:
            _draw_differences(out / "differences.png", found)
        page = Page(out / "index.html", "Two campaigns compared", _verdict_of_two(found), _provenance_of_two(found))
        _tell_two(page, found, tables)
        page.write()
        write_whole(out / "summary.json", json.dumps(answer, indent=1, allow_nan=False) + "\n")
        answer["page"] = str(page.path)
    progress(1.0, "")
    return answer


def comparison_tables(found: Comparison) -> list[Table]:
    """Give every number of a comparison as tables; what is infinite is None."""
    rates = [
        row | dict(zip(("both", "A only", "B only", "neither"), one.pairs or ()))
        for row, one in zip(rows_of(found.rates, _RATES_OF_TWO), found.rates)
    ]
    differing = [{"entry": name, "A": json.dumps(a), "B": json.dumps(b)} for name, a, b in found.differing]
    said = "Quantiles of the flights of each; the difference with an interval, about 95 %."
    return [
        Table("differing", "What differs between the two.", differing),
        Table("rates", "How often, with 95 % intervals.", rates),
        Table("quantiles", said, found.quantiles),
        Table("by_run", "A less B, run by run.", [one.row for one in found.differences]),
    ]


def _said_of_two(found: Comparison) -> list[str]:
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


def _verdict_of_two(found: Comparison) -> Headline:
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


def _provenance_of_two(found: Comparison) -> Provenance:
    both = [(label, provenance(reading)) for label, reading in zip("AB", (found.first, found.second))]
    scenarios = {f"{label}: {name}": of for label, made in both for name, of in made.scenarios.items()}
    digests = {f"{label}: {words}": sha256 for label, made in both for words, sha256 in made.digests.items()}
    return Provenance(scenarios, digests)


def _tell_two(page: Page, found: Comparison, tables: list[Table]) -> None:
    folder = page.path.parent
    names = [f"{label}: {reading.folder}" for label, reading in zip("AB", (found.first, found.second))]
    page.words("; ".join(names), *_said_of_two(found))
    for table in tables:
        if not table.rows:
            continue
        rows = table.rows
        if table.name == "rates":
            rows = [{k: _in_percent(k, v) for k, v in row.items()} for row in rows]
        page.heading(table.caption.rstrip("."))
        page.table(rows)
        page.file(folder / f"{table.name}.csv")
        if table.name in _PICTURES:
            page.picture(folder / _PICTURES[table.name], _CAPTIONS[table.name], vector=True)


def _in_percent(heading: str, value: Any) -> Any:
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

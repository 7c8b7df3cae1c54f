"""The verb campaign: many flights of one scenario, flown into a folder, and what they came to."""

import json
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from threading import Event
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from keepout.core.errors import ScenarioError
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario, ScenarioLike
from keepout.core.progress import Progress, never_back, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.flying import replay
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.run import Flyer, Standing, fly_campaign, flyer_on, in_threads, keep_flights, keep_of
from keepout.flights.campaign.table import FLOWN, SUMMARISED, approach_columns, summary
from keepout.flights.pages.folder import results_in, write_summary
from keepout.flights.pages.page import embedded, text

_PAGE = "keepout.flights.pages.campaign_page"
"""What draws: it takes long to import, and is imported while flights are flown."""


@dataclass(frozen=True, eq=False)
class Campaign:
    """A campaign's folder, with all its runs flown and audited.

    Attributes:
        dataset: the folder's tables.
        figures: as `keepout campaign` reports them.
        kept: keeps a folder that goes when the campaign does; None where one was named.

    """

    dataset: Dataset
    figures: Mapping[str, Any]
    kept: Any = field(default=None, repr=False)

    @classmethod
    def open(cls, folder: str | Path) -> "Campaign":
        """Open the folder of a campaign that is complete.

        Args:
            folder: as `keepout campaign` wrote it.

        Raises:
            KeepoutError: it holds no campaign, or one that is not complete.

        """
        dataset = Dataset.open(folder)
        path = dataset.folder / "summary.json"
        if not path.exists() or dataset.missing():
            raise ScenarioError(f"{folder}: the campaign is not complete; fly it again into this folder to go on")
        return cls(dataset, json.loads(path.read_text(encoding="utf-8")))

    @property
    def folder(self) -> Path:
        """Where its tables, kept flights and page (`index.html`) are."""
        return self.dataset.folder

    @property
    def scenario(self) -> Scenario:
        """Of all runs, with its `campaign` table."""
        return self.dataset.scenario

    def summary(self) -> dict[str, Any]:
        """Give the campaign's figures as plain numbers for JSON; a contact is whatever the audit does not exclude."""
        return dict(self.figures)

    def table(self) -> pa.Table:
        """Give one row a run as an Arrow table, which pandas and polars take: what was drawn, and what came of it.

        SI units; a run that was refused has a `reason` and no figures.
        """
        return self.dataset.table()

    def worst(self, count: int = 10) -> pa.Table:
        """Give the rows of the flown runs with the least proved clearance, least first.

        Args:
            count: how many, at most.

        """
        flown = self.table().filter(pc.field("status") == FLOWN)
        return flown.sort_by([("minimum_clearance", "ascending"), ("run", "ascending")]).slice(0, count)

    def replay(self, run: int) -> Flight:
        """Fly one run again, to the same bits, and give its flight in full.

        Args:
            run: its number in the table.

        Raises:
            KeepoutError: there is no such run, it was refused, or mesh, field or version are others now.

        """
        Dataset.begin(self.folder, self._plan)
        [again] = replay(self._plan, [run])
        return again.flight

    def compare(
        self, other: "Campaign | str | Path", out: str | Path | None = None, *, progress: Progress = silent
    ) -> dict[str, Any]:
        """Compare with another campaign: rates, quantiles, and run by run where both drew the same.

        Args:
            other: a campaign, or its folder.
            out: a folder for page, figures and CSV files.
            progress: called as the work goes on.

        Returns:
            All tables as plain values by name, and `words`.

        Raises:
            KeepoutError: a folder holds no finished campaign, or is damaged.

        """
        from keepout.flights.pages.campaign_page import compare_campaigns

        second = other.folder if isinstance(other, Campaign) else Path(other)
        return compare_campaigns(self.folder, second, None if out is None else Path(out), progress=progress)

    @cached_property
    def _plan(self) -> Plan:
        return Plan.of(self.scenario, batch=self.dataset.identity["batch"])

    def _repr_html_(self) -> str:
        from keepout.flights.pages.flight_page import watched_html

        rates = self.figures["rates"]
        cells = (
            f"<tr><th>{text(rate['name'])}</th><td>{rate['count']} of {rate['of']}</td>"
            f"<td>{text(rate['rate'])}</td><td>{text(rate['low'])} to {text(rate['high'])}</td></tr>"
            for rate in rates
        )
        head = "<tr><th></th><th>runs</th><th>rate</th><th>95 %</th></tr>"
        drawn = embedded((self.folder / "campaign.png").read_bytes(), "the runs' clearances, times and Δv")
        least = self.figures["minimum_clearance_m"]
        said = f"Campaign {self.scenario.name}: of {self.figures['flown']} flights {self.figures['contacts']} are not "
        said += f"proved free of a contact; the least proved clearance is {text(least)} m"
        worst = self.folder / "report" / "worst.html"  # there where the worst flights were kept
        shown = drawn + (watched_html(worst) if worst.exists() else "")
        return f"<p><b>{text(said)}</b></p><table>{head}{''.join(cells)}</table>{shown}"


def campaign(
    scenario: ScenarioLike,
    *,
    runs: int | None = None,
    vary: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    target: Target | None = None,
    model: FieldModel | None = None,
    progress: Progress = silent,
    **how: Any,
) -> Campaign:
    """Fly a scenario many times, with whatever varies drawn anew for each flight, and audit every flight.

    It is what `keepout campaign` flies, to the same bits. With `out` it goes on where it was stopped.

    Args:
        scenario: a `Scenario`, the path of its TOML file, or its tables as a dict.
        runs: how many; the scenario's own number if absent.
        vary: beside what `campaign.dispersions` vary, by entry: ("uniform", least, largest), ("normal", mean, standard
            deviation), ("choice", value, value, …), ("sphere", length) or a table of the scenario as a dict.
        out: folder for tables, kept flights and page; if absent one that goes when the campaign is let go.
        target: already loaded; else the scenario's.
        model: its field, already loaded; else the scenario's.
        progress: called as flights land.
        **how: `keep` ("worst:20", "all" or "none": flights to keep in full), `batch` (flights at once), `scheduler`
            (tcp://HOST:PORT, local or local:N) and `mixed_processors`.

    Returns:
        The campaign, whose table, worst runs and replays can be asked for.

    Raises:
        KeepoutError: something in the scenario cannot be flown or varied; the message names the entry.

    """
    unknown = [name for name in how if name not in ("keep", "batch", "scheduler", "mixed_processors")]
    if unknown:
        raise ScenarioError(f"campaign: {unknown[0]}: no such option; valid: keep, batch, scheduler, mixed_processors")
    varied = _varied(Scenario.of(scenario), runs, vary or {})
    keep = keep_of(how.get("keep", "worst:20"))
    flyer = flyer_on(how.get("scheduler"), mixed_processors=bool(how.get("mixed_processors", False)))
    temporary = tempfile.TemporaryDirectory(prefix="keepout-campaign-") if out is None else None
    folder = Path(temporary.name if temporary is not None else str(out))
    progress(0.0, "preparing")
    with results_in(folder):
        plan = Plan.of(varied, target=target, model=model, batch=how.get("batch"))
        dataset = Dataset.begin(folder, plan)
    made = Campaign(dataset, complete(plan, dataset, keep=keep, flyer=flyer, progress=progress), temporary)
    made.__dict__["_plan"] = plan  # which knows a mesh and a field that were given
    return made


def _varied(scenario: Scenario, runs: int | None, vary: Mapping[str, Any]) -> Scenario:
    """Give the scenario with another number of runs, and with more that varies."""
    drawn = {name: entry.model_dump(exclude_defaults=True) for name, entry in scenario.campaign.dispersions.items()}
    for name, value in vary.items():
        if isinstance(value, Mapping):
            drawn[name] = dict(value)
            continue
        kind, *of = value if isinstance(value, tuple | list) and value else (None,)
        if kind not in ("uniform", "normal", "choice", "sphere") or not of:
            valid = '("uniform", least, largest), ("normal", mean, deviation), ("choice", …) or ("sphere", length)'
            raise ScenarioError(f"vary: {name}: {value!r}; it must be {valid}")
        drawn[name] = {kind: of[0] if kind == "sphere" and len(of) == 1 else of}
    changes: dict[str, Any] = {} if runs is None else {"runs": runs}
    return scenario.replace(campaign=changes | ({"dispersions": drawn} if vary else {}))


def complete(
    plan: Plan,
    dataset: Dataset,
    *,
    keep: int | None = 20,
    flyer: Flyer = in_threads,
    told: Callable[[Standing], None] = lambda standing: None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Fly what is missing in a campaign's folder; then keep flights, and write bands, page and `summary.json`.

    Args:
        plan: of the campaign.
        dataset: its folder (`Dataset.begin`).
        keep: how many flights to keep in full, those of least clearance first; None: all.
        flyer: who flies.
        told: hears how far it is as flights land.
        progress: likewise, in words.

    Returns:
        The figures of `summary.json`.

    Raises:
        KeepoutError: another process flies it, or a file cannot be written.

    """
    began, out, plan = time.perf_counter(), dataset.folder, replace(plan, keep=keep)
    shared, ended = never_back(progress), Event()

    def tell(standing: Standing) -> None:
        told(standing)
        shared(0.05 + 0.9 * standing.done / standing.runs, standing.line())

    def tell_kept(done: int, of: int) -> None:
        if ended.is_set():  # what waits for it has failed or was interrupted
            raise CancelledError
        shared(0.95, f"{done} of {of} flights kept")

    with dataset.lock(), ThreadPoolExecutor(1) as aside, ExitStack() as at_its_end:
        at_its_end.callback(ended.set)
        imported = aside.submit(import_module, _PAGE)
        standing = fly_campaign(plan, dataset, flyer=flyer, told=tell)
        imported.result()
        from keepout.flights.pages.campaign_figures import DRAWN, draw_campaign
        from keepout.flights.pages.campaign_page import report_campaign

        # What is not kept yet is flown again beside the drawing: the one takes XLA's threads, the other Python's.
        keeping = aside.submit(keep_flights, plan, dataset, keep, told=tell_kept)
        bands = out / "bands.json"
        write_whole(bands, json.dumps(dataset.bands().figures(), allow_nan=False) + "\n")
        draw_campaign(out / "campaign.png", dataset.table(list(DRAWN)))
        page = report_campaign(
            out, require=plan.scenario.require, kept=keeping.result, progress=part_of(shared, 0.95, 1.0)
        )
        figures = {
            **summary(dataset.table([*SUMMARISED, *approach_columns(plan.scenario)]), plan.scenario),
            "guard": plan.guard_numbers(),
            "batch": plan.batch,
            "seconds": time.perf_counter() - began,
            "flown_now": standing.flown,
            "processors": dataset.processors(),
            "flights": str(out / "flights"),
            "bands": str(bands),
            "kept": [str(dataset.kept(run)) for run in keeping.result()],
            "require": plan.scenario.require.model_dump(exclude_defaults=True),
            **{name: page[name] for name in ("page", "rates", "requirements")},
        }
        write_summary(out, figures)
    return figures

"""Commands on many flights as functions: what `campaign fly` and `campaign replay` do."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.cli.commands import usage
from keepout.core.progress import Progress, part_of, silent

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario
    from keepout.flights.campaign.run import Standing


def campaign_to_folder(
    scenario: "Scenario",
    out: Path,
    *,
    batch: int | None = None,
    keep: str = "worst:20",
    scheduler: str | None = None,
    mixed_processors: bool = False,
    told: "Callable[[Standing], None]" = lambda standing: None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Fly a scenario's campaign into `out`, or what is missing of it there; then its bands, page and `summary.json`.

    `scheduler` names who flies, if not this process (`flyer_on`). `told` hears how far it is as flights land;
    `progress` too, in words.
    """
    from keepout.core.whole_file import write_whole
    from keepout.flights.campaign.dataset import Dataset
    from keepout.flights.campaign.plan import Plan
    from keepout.flights.campaign.run import Keep, Scheduler, fly_campaign, flyer_on, in_threads, keep_flights
    from keepout.flights.campaign.table import SUMMARISED, summary
    from keepout.flights.pages.campaign_figures import DRAWN, draw_campaign
    from keepout.flights.pages.campaign_page import report_campaign
    from keepout.flights.pages.folder import results_in, write_summary

    with usage():
        chosen = Keep.parse(keep)
        if scheduler is not None:
            Scheduler.parse(scheduler)
    flyer = in_threads if scheduler is None else flyer_on(scheduler, mixed_processors=mixed_processors)
    began = time.perf_counter()
    progress(0.0, "preparing")
    with results_in(out):
        plan = Plan.of(scenario, batch=batch)
        dataset = Dataset.begin(out, plan)

    def tell(standing: "Standing") -> None:
        told(standing)
        progress(0.05 + 0.9 * standing.done / standing.runs, standing.line())

    with dataset.lock():
        standing = fly_campaign(plan, dataset, flyer=flyer, told=tell)
        kept = keep_flights(plan, dataset, chosen, told=lambda done, of: progress(0.95, f"{done} of {of} flights kept"))
        bands = out / "bands.json"
        write_whole(bands, json.dumps(dataset.bands().figures(), allow_nan=False) + "\n")
        figures = {
            **summary(dataset.table(list(SUMMARISED)), scenario),
            "guard": plan.guard_numbers(),
            "batch": plan.batch,
            "seconds": time.perf_counter() - began,
            "flown_now": standing.flown,
            "processors": dataset.processors(),
            "flights": str(out / "flights"),
            "bands": str(bands),
            "kept": [str(dataset.kept(run)) for run in kept],
        }
        draw_campaign(out / "campaign.png", dataset.table(list(DRAWN)))
        page = report_campaign(out, progress=part_of(progress, 0.97, 1.0))
        figures |= {"page": page["page"], "rates": page["rates"]}
        write_summary(out, figures)
    return figures


def replay_to_folder(
    campaign: Path, run: int, out: Path | None = None, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Fly one run of a campaign's folder again; write what `fly_to_folder` writes, and say whether it is the same."""
    from keepout.core.mission.scenario import Scenario
    from keepout.flights.campaign.dataset import Dataset
    from keepout.flights.campaign.flying import differences, replay
    from keepout.flights.campaign.plan import Plan
    from keepout.flights.pages.folder import results_in, write_flight, write_summary

    dataset = Dataset.open(campaign)
    identity = dataset.identity
    scenario = Scenario.parse(identity["scenario"], where=str(campaign / "campaign.json"))
    out = campaign / f"run-{run}" if out is None else out
    with results_in(out):
        progress(0.0, "preparing")
        plan = Plan.of(scenario, batch=identity["batch"])
        dataset = Dataset.begin(campaign, plan)  # refused where mesh, field or version are others now
        progress(0.4, "flying")
        [again] = replay(plan, [run])
        kept = dataset.part(run // plan.chunk).slice(run % plan.chunk, 1)
        differing = differences(kept, again.row)
        progress(0.8, "writing")
        introduction = f"Run {run} of the campaign {scenario.name}, flown again."
        title = f"Run {run} of {scenario.name}"
        summary = write_flight(out, f"run {run}", again.flight, title=title, introduction=introduction, figures=figures)
        summary |= {
            "run": run,
            "equal": not differing,
            "differences": {name: {"campaign": a, "replay": b} for name, (a, b) in differing.items()},
            "record_apart": again.apart,
            "drawn": dict(again.run.values),
            "seed": scenario.seed,
        }
        write_summary(out, summary)
    return summary

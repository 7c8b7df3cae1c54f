"""Commands on many flights: campaign fly, report, compare, replay."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from keepout.cli import options
from keepout.cli.options import AsJson, Commands, Force, ScenarioSeed, Settings, app, at_least, example, grouped, into
from keepout.core.errors import ScenarioError
from keepout.core.progress import silent
from keepout.flights.pages import terminal

if TYPE_CHECKING:
    from keepout.flights.campaign.dataset import Dataset
    from keepout.flights.campaign.plan import Plan


class _FlyUnlessNamed(TyperGroup):
    """A group whose first command is meant where none is named: `keepout campaign mission.toml` flies."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = args[0] if args else None
        return super().parse_args(ctx, args if first in (*self.commands, "--help") else ["fly", *args])


campaigns = Commands(
    cls=_FlyUnlessNamed,
    help="Fly a scenario many times, with whatever varies drawn anew for each flight, and audit every flight.\n\n"
    "`keepout campaign MISSION.toml` is short for `keepout campaign fly MISSION.toml`; its options are "
    "--runs, --keep, --batch, --scheduler, --mixed-processors, --seed, --set, --force and --json.",
    epilog=example(
        "keepout campaign examples/case1.toml --runs 1000 -o out/campaign",
        "keepout campaign replay out/campaign --run 47",
    ),
)


app.add_typer(campaigns, name="campaign")


@dataclass(frozen=True)
class _Flying:
    """Options on how a campaign is flown."""

    keep: Annotated[str, typer.Option(help="Flights that become files: worst:N (by clearance), all or none.")] = (
        "worst:20"
    )
    batch: Annotated[
        int | None, typer.Option(callback=at_least(1), help="Flights at once; another number makes another campaign.")
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(help="Who flies: local or local:N (processes), tcp://HOST:PORT (a dask cluster)."),
    ] = None
    mixed_processors: Annotated[
        bool, typer.Option("--mixed-processors", help="Let several kinds of processor fly, with other last bits.")
    ] = False


@campaigns.command("fly", epilog=example("keepout campaign examples/case1.toml --runs 1000 -o out/campaign"))
@grouped
def campaign(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML).")],
    *,
    out: Annotated[Path | None, into("Folder of results, instead of out/NAME/campaign.")] = None,
    runs: Annotated[
        int | None, typer.Option(callback=at_least(1, 10**9), help="Instead of the scenario's number.")
    ] = None,
    how: _Flying,
    seed: ScenarioSeed = None,
    settings: Settings = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario's campaign into a folder.

    `keepout campaign SCENARIO` is the same. With --json, lines of JSON on standard error tell its progress.

    A killed run goes on when started again.

    Exit code 3: too few runs meet a requirement of the scenario's [require].
    """
    mission = options.mission_of(scenario, seed, settings)
    if runs is not None:
        mission = mission.replace(campaign={"runs": runs})
    folder = options.folder_of(out, mission, "campaign")
    own = options.results_of("campaign", scenario, mission, folder, force=force)
    told = terminal.standing_lines() if as_json else (lambda standing: None)
    shown = contextlib.nullcontext(silent) if as_json else terminal.progress(f"campaign {mission.name}")
    with shown as progress, own:
        from keepout.flights.campaign.plan import Plan
        from keepout.flights.campaign.run import flyer_on, keep_of, scheduler_of
        from keepout.verbs.campaigns import complete

        with options.usage():
            keep = keep_of(how.keep)
            if how.scheduler is not None:
                scheduler_of(how.scheduler)
        flyer = flyer_on(how.scheduler, mixed_processors=how.mixed_processors)
        progress(0.0, "preparing")
        plan = Plan.of(mission, batch=how.batch)
        dataset = _begun(folder, plan, force=force)
        summary = complete(plan, dataset, keep=keep, flyer=flyer, told=told, progress=progress)
    # What the guard assumes is for the file: two dozen numbers.
    left_out = ("guard", "kept", "refusals", "rates", "page", "require", "requirements")
    facts = terminal.facts_table("Campaign", {k: v for k, v in summary.items() if k not in left_out})
    options.conclude(summary, as_json, facts, terminal.rates_table(summary["rates"]), out=folder)


def _begun(out: Path, plan: "Plan", *, force: bool) -> "Dataset":
    """Open the folder of a campaign, or make one; that of another campaign is refused, or replaced with `force`."""
    from keepout.flights.campaign.dataset import Dataset

    try:
        return Dataset.begin(out, plan)
    except ScenarioError:
        if not (force and (out / "campaign.json").exists()):
            raise
        options.forget_campaign(out)
        return Dataset.begin(out, plan)


@campaigns.command("report", epilog=example("keepout campaign report out/campaign"))
def report(
    folder: Annotated[Path, typer.Argument(help="Of a campaign.")],
    as_json: AsJson = False,
) -> None:
    """Write a campaign's page, figures and CSV files anew."""
    from keepout.flights.pages.campaign_page import report_campaign

    with terminal.progress(f"report {folder.name}") as progress:
        summary = report_campaign(folder, progress=progress)
    options.conclude(summary, as_json, terminal.rates_table(summary["rates"]), out=folder)


@campaigns.command("compare", epilog=example("keepout campaign compare out/guarded out/unguarded -o out/compared"))
def compare(
    first: Annotated[Path, typer.Argument(help="Its folder.")],
    second: Annotated[Path, typer.Argument(help="Its folder.")],
    out: Annotated[Path | None, into("Folder for page, figures and CSV.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare two finished campaigns: rates, quantiles, and run by run where both drew the same."""
    from keepout.flights.pages.campaign_page import compare_campaigns

    with terminal.progress("compare") as progress:
        summary = compare_campaigns(first, second, out, progress=progress)
    page = [terminal.Line(f"open {summary['page']}")] if "page" in summary else []
    options.answer(summary, as_json, *terminal.comparison_tables(summary), *summary["words"], *page)


@campaigns.command("replay", epilog=example("keepout campaign replay out/campaign --run 47"))
def replay_run(
    folder: Annotated[Path, typer.Argument(help="Of a campaign.")],
    run: Annotated[int, typer.Option(callback=at_least(0), help="Its number in the table.")],
    out: Annotated[Path | None, into("Folder, instead of run-N in the campaign's.")] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures and the page.")] = True,
    as_json: AsJson = False,
) -> None:
    """Fly one run of a campaign again, to the same bits, into a folder."""
    from keepout.core.mission.scenario import Scenario
    from keepout.flights.campaign.dataset import Dataset, differences
    from keepout.flights.campaign.flying import replay
    from keepout.flights.campaign.plan import Plan
    from keepout.flights.pages.folder import results_in, write_flight, write_summary

    dataset = Dataset.open(folder)
    identity = dataset.identity
    scenario = Scenario.parse(identity["scenario"], where=str(folder / "campaign.json"))
    out = folder / f"run-{run}" if out is None else out
    with terminal.progress(f"replay {run}") as progress, results_in(out):
        progress(0.0, "preparing")
        plan = Plan.of(scenario, batch=identity["batch"])
        dataset = Dataset.begin(folder, plan)  # refused where mesh, field or version are others now
        progress(0.4, "flying")
        [again] = replay(plan, [run])
        [kept] = dataset.part(run // plan.chunk).slice(run % plan.chunk, 1).to_pylist()
        differing = differences(kept, again.row)
        progress(0.8, "writing")
        introduction = f"Run {run} of the campaign {scenario.name}, flown again."
        title = f"Run {run} of {scenario.name}"
        summary = write_flight(out, f"run {run}", again.flight, title=title, introduction=introduction, figures=figures)
        summary |= {
            "run": run,
            "equal": not differing,
            "differences": {name: {"campaign": a, "replay": b} for name, a, b in differing},
            "record_apart": again.apart,
            "drawn": dict(again.run.values),
            "seed": scenario.seed,
        }
        write_summary(out, summary)
    same = "equal to its row in the campaign" if summary["equal"] else f"differs: {summary['differences']}"
    options.conclude(summary, as_json, terminal.flight_table(summary), f"Run {run}: {same}.", out=out, page=figures)

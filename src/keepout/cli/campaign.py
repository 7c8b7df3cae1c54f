"""Commands on many flights: campaign fly, report, compare, replay."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from keepout.cli.options import AsJson, ScenarioSeed, answer, app, at_least, example
from keepout.flights.pages import terminal


class _FlyUnlessNamed(TyperGroup):
    """A group whose first command is meant where none is named: `keepout campaign mission.toml` flies."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = args[0] if args else None
        return super().parse_args(ctx, args if first in (*self.commands, "--help") else ["fly", *args])


campaigns = typer.Typer(
    cls=_FlyUnlessNamed,
    help="Fly a scenario many times, with whatever varies drawn anew for each flight, and audit every flight.\n\n"
    "`keepout campaign MISSION.toml -o OUT` is short for `keepout campaign fly MISSION.toml -o OUT`; its options are "
    "--runs, --keep, --batch, --scheduler, --mixed-processors, --seed and --json.",
    epilog=example(
        "keepout campaign examples/case1.toml --runs 1000 -o out/campaign",
        "keepout campaign replay out/campaign --run 47",
    ),
)


app.add_typer(campaigns, name="campaign")


@campaigns.command("fly", epilog=example("keepout campaign examples/case1.toml --runs 1000 -o out/campaign"))
def campaign(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML) with its [campaign] table.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results and figure.")] = Path("out"),
    runs: Annotated[
        int | None, typer.Option(callback=at_least(1, 10**9), help="Replaces the scenario's own number of flights.")
    ] = None,
    keep: Annotated[
        str, typer.Option(help="Flights that become flight files: worst:N, by least clearance, all or none.")
    ] = "worst:20",
    batch: Annotated[
        int | None, typer.Option(callback=at_least(1), help="Flights at once; part of what the campaign is.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Who flies: tcp://HOST:PORT, a dask.distributed cluster; local or local:N, processes here."),
    ] = None,
    mixed_processors: Annotated[
        bool, typer.Option("--mixed-processors", help="Let processors of several kinds fly, with other last bits.")
    ] = False,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """Fly a scenario's campaign into a folder; stopped and started again, it goes on.

    With --json, a line of JSON a second says on standard error how far it is.
    """
    from keepout.cli.commands.campaign import campaign_to_folder
    from keepout.core.mission.scenario import Scenario

    mission = Scenario.load(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    if runs is not None:
        mission = mission.replace(campaign={"runs": runs})
    chosen = {"batch": batch, "keep": keep, "scheduler": scheduler, "mixed_processors": mixed_processors}
    if as_json:
        summary = campaign_to_folder(mission, out, **chosen, told=terminal.standing_lines())
    else:
        with terminal.progress(f"campaign {mission.name}") as progress:
            summary = campaign_to_folder(mission, out, **chosen, progress=progress)
    answer(summary, as_json)
    if not as_json:
        # What the guard assumes is for the file: two dozen numbers.
        left_out = ("guard", "kept", "refusals", "rates", "page")
        Console().print(terminal.facts_table("Campaign", {k: v for k, v in summary.items() if k not in left_out}))
        _print_rates(summary)


def _print_rates(report: dict[str, Any]) -> None:
    Console().print(terminal.rates_table(report["rates"]))
    Console().print(f"open {report['page']}", highlight=False, markup=False, soft_wrap=True)


@campaigns.command("report", epilog=example("keepout campaign report out/campaign"))
def report(
    folder: Annotated[Path, typer.Argument(help="The folder of a campaign, finished or not.")],
    as_json: AsJson = False,
) -> None:
    """Write a campaign's page, figures and CSV files anew: rates, distributions, what matters, the worst flights."""
    from keepout.flights.pages.campaign_page import report_campaign

    with terminal.progress(f"report {folder.name}") as progress:
        summary = report_campaign(folder, progress=progress)
    answer(summary, as_json)
    if not as_json:
        _print_rates(summary)


@campaigns.command("compare", epilog=example("keepout campaign compare out/guarded out/unguarded -o out/compared"))
def compare(
    first: Annotated[Path, typer.Argument(help="The folder of a finished campaign.")],
    second: Annotated[Path, typer.Argument(help="Another one.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Also write page, figures and CSV files into this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare two finished campaigns: rates, quantiles, and run by run where both drew the same."""
    from keepout.flights.pages.comparison_page import compare_campaigns

    with terminal.progress("compare") as progress:
        summary = compare_campaigns(first, second, out, progress=progress)
    answer(summary, as_json)
    if not as_json:
        for table in terminal.comparison_tables(summary):
            Console().print(table)
        for words in summary["words"]:
            Console().print(words, highlight=False, markup=False)
        if "page" in summary:
            Console().print(f"open {summary['page']}", highlight=False, markup=False, soft_wrap=True)


@campaigns.command("replay", epilog=example("keepout campaign replay out/campaign --run 47"))
def replay_run(
    folder: Annotated[Path, typer.Argument(help="The folder of a campaign.")],
    run: Annotated[int, typer.Option(callback=at_least(0), help="Number of the run, as in the table.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write; by default run-N in that of the campaign.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw figures and the page.")] = True,
    as_json: AsJson = False,
) -> None:
    """Fly one run of a campaign again, to the same bits; write its flight file, figures and page."""
    from keepout.cli.commands.campaign import replay_to_folder

    with terminal.progress(f"replay {run}") as progress:
        summary = replay_to_folder(folder, run, out, figures=figures, progress=progress)
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.flights_table([summary]))
        same = "equal to its row in the campaign" if summary["equal"] else f"differs: {summary['differences']}"
        Console().print(f"run {run}: {same}", highlight=False, markup=False)

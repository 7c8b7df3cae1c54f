"""Commands on flights: fly, replay, report; and rare and reproduce, which answer a question by many of them.

What applications add, as explore and inspect, is like `fly`.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.cli import options
from keepout.cli.options import AsJson, Force, ScenarioSeed, Seed, Settings, app, at_least, example, into
from keepout.core.errors import UsageError
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages import terminal

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario


def fly_to_folder(
    scenario: "Scenario", out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Fly a scenario; write flight file, figures, page and `summary.json` into `out`."""
    from keepout.core.mission.first_look import look

    target = look(scenario)
    from keepout.core.mission.build import fly
    from keepout.flights.pages.folder import write_flight, write_summary

    flight = fly(scenario, target=target, progress=part_of(progress, 0.0, 0.9))
    places = f"start {list(scenario.start.position)} m, goal {list(scenario.goal.position)} m"
    introduction, title = f"Target {flight.target.name}, {places}.", f"Flight {scenario.name}"
    summary = write_flight(out, scenario.name, flight, title=title, introduction=introduction, figures=figures)
    write_summary(out, summary)
    return summary


options.add_mission_command(
    app,
    "fly",
    terminal.MissionCommand(
        help="Fly one scenario, audit the clearance on the exact mesh, and draw it.",
        example="keepout fly examples/case1.toml -o out/case1",
        scenario="A scenario file (TOML).",
        fly=fly_to_folder,
        table=terminal.flight_table,
    ),
)


@app.command(
    epilog=example(
        "keepout replay out/case1/case1.parquet -o out/replay.html",
        "keepout replay out/a/case1.parquet out/b/case1.parquet -o out/both.html",
    )
)
def replay(
    flights: Annotated[list[Path], typer.Argument(help="Flight files (.parquet, .npz) around one target.")],
    out: Annotated[Path, into("The page to write (.html).")] = Path("replay.html"),
    title: Annotated[str | None, typer.Option(help="Instead of the first flight's name.")] = None,
    video: Annotated[
        Path | None,
        typer.Option(help="Also film it, with Chromium: .mp4, .gif, .webp, or .png (pictures in a row)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write flights as one page for any browser, offline: target, envelope, paths, plots."""
    with terminal.progress("replay") as progress:
        from keepout.verbs import files

        summary = files.replay(flights, out, title=title, video=video, progress=progress)
    options.answer(summary, as_json, terminal.Line(f"open {summary['replay']}"))


@app.command(epilog=example("keepout report out/case1 --pdf", "keepout report out/campaign --pdf -o campaign.pdf"))
def report(
    folder: Annotated[Path, typer.Argument(help="Of fly, explore, inspect or campaign.")],
    pdf: Annotated[bool, typer.Option("--pdf", help="Write a PDF; else write a campaign's page anew.")] = False,
    out: Annotated[Path | None, into("The PDF, instead of report.pdf in that folder.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print four pages: mission and assumptions, what is proved, what was flown, requirements."""
    if not pdf and (out is not None or not (folder / "campaign.json").exists()):
        raise UsageError(f"{folder}: give --pdf; only a campaign's page, index.html, can be written anew without it")
    with terminal.progress(f"report {folder.name}") as progress:
        if pdf:
            from keepout.verbs import files

            summary = {"report": str(files.report(folder, out, progress=progress))}
        else:
            from keepout.flights.pages.campaign_page import report_campaign

            summary = report_campaign(folder, progress=progress)
    options.answer(summary, as_json, terminal.Line(f"open {summary['report' if pdf else 'page']}"))


@app.command(epilog=example("keepout rare examples/case1.toml --below 0 -o out/rare"))
def rare(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML).")],
    out: Annotated[Path | None, into("Folder of results, instead of out/NAME/rare.")] = None,
    below: Annotated[float, typer.Option(callback=at_least(-math.inf), help="The clearance, m; 0 is contact.")] = 0.0,
    runs: Annotated[int, typer.Option(callback=at_least(2), help="Repetitions; their spread gives the interval.")] = 8,
    flights: Annotated[
        int, typer.Option(callback=at_least(64, multiple_of=8), help="Flights a level and run; a multiple of 8.")
    ] = 1024,
    quick: Annotated[bool, typer.Option("--quick", help="256 such flights: a rough answer.")] = False,
    seed: ScenarioSeed = None,
    settings: Settings = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Measure how probable a contact is where nothing is proved, by subset simulation.

    A killed run goes on from its last level when started again.
    """
    mission = options.mission_of(scenario, seed, settings)
    folder = options.folder_of(out, mission, "rare")
    with terminal.progress(f"rare {mission.name}") as progress:
        from keepout.flights.pages.folder import write_summary
        from keepout.flights.pages.rare_page import write_rare
        from keepout.flights.rare_events.event import rare

        flights = 256 if quick else flights
        with options.results_of("rare", scenario, mission, folder, force=force):
            event = rare(
                mission, below=below, runs=runs, flights=flights, state=folder, progress=part_of(progress, 0.0, 0.97)
            )
            summary = write_rare(folder, event)
            write_summary(folder, summary)
    options.conclude(summary, as_json, out=folder)


@app.command(epilog=example("keepout reproduce all --quick -o out/paper"))
def reproduce(
    experiments: Annotated[
        list[str], typer.Argument(help="all, or any of table1, surfaces, volumes, case1, case2, runtime, case3.")
    ],
    out: Annotated[Path, into("Folder of results.")] = Path("out/reproduce"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer flights, shipped fields: minutes.")] = False,
    fields: Annotated[
        Path | None,
        typer.Option(help="Folder of these networks, as benchmarks/results/fields."),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Repeat the source paper's tables, figures and flights, beside Keepout's own.

    The full run takes hours; --fields saves the fits of the paper's network, about an hour a target.

    A killed run goes on where it was.
    """
    from keepout.apps.reproduction import reproduce as repeat

    with terminal.progress(f"reproduce {' '.join(experiments)}") as progress:
        parts = repeat(experiments, out, quick=quick, seed=seed, fields=fields, progress=progress)
    tables = [
        terminal.entries_table(f"{part.title}: {table.caption}", table.rows) for part in parts for table in part.tables
    ]
    last = terminal.Line(f"open {out / 'index.html'}")
    options.answer([row for part in parts for row in part.named_rows], as_json, *tables, last)

"""Commands that answer a question by many flights: rare, reproduce."""

import math
from pathlib import Path
from typing import Annotated

import typer

from keepout.cli.application import app
from keepout.cli.missions import Force, Settings, conclude, folder_of, mission_of, results_of
from keepout.cli.options import AsJson, ScenarioSeed, Seed, answer, at_least, example, into
from keepout.core.progress import part_of
from keepout.flights.pages import terminal


@app.command(epilog=example("keepout rare examples/case1.toml --below 0 -o out/rare"))
def rare(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML) in which something is random.")],
    out: Annotated[Path | None, into("Folder of the results, instead of out/NAME/rare.")] = None,
    below: Annotated[float, typer.Option(callback=at_least(-math.inf), help="The clearance, m; 0 is contact.")] = 0.0,
    runs: Annotated[int, typer.Option(callback=at_least(2), help="Repetitions whose spread gives the interval.")] = 8,
    flights: Annotated[
        int, typer.Option(callback=at_least(64, multiple_of=8), help="Flights of each level and run; a multiple of 8.")
    ] = 1024,
    quick: Annotated[bool, typer.Option("--quick", help="256 flights of each level and run: a rough answer.")] = False,
    seed: ScenarioSeed = None,
    settings: Settings = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Measure how probable a contact is where nothing is proved, by subset simulation.

    A killed run goes on from its last level when started again.
    """
    mission = mission_of(scenario, seed, settings)
    folder = folder_of(out, mission, "rare")
    with terminal.progress(f"rare {mission.name}") as progress:
        from keepout.flights.pages.folder import write_summary
        from keepout.flights.pages.rare_page import write_rare
        from keepout.flights.rare_events.event import rare

        flights = 256 if quick else flights
        with results_of("rare", scenario, mission, folder, force=force):
            event = rare(
                mission, below=below, runs=runs, flights=flights, state=folder, progress=part_of(progress, 0.0, 0.97)
            )
            summary = write_rare(folder, event)
            write_summary(folder, summary)
    conclude(summary, as_json, out=folder)


@app.command(epilog=example("keepout reproduce all --quick -o out/paper"))
def reproduce(
    experiments: Annotated[
        list[str], typer.Argument(help="all, or any of table1, surfaces, volumes, case1, case2, runtime, case3.")
    ],
    out: Annotated[Path, into("Folder of the results.")] = Path("out/reproduce"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer flights, shipped fields: minutes.")] = False,
    fields: Annotated[
        Path | None,
        typer.Option(help="Folder of fields of the paper's network: benchmarks/results/fields."),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Repeat the source paper's tables, figures and flights, with Keepout's own answers beside them.

    The full run takes hours: it fits the paper's network, about an hour for each of three targets, unless --fields
    names its fields.

    A killed run goes on where it was.
    """
    from keepout.apps.reproduction import reproduce as repeat

    with terminal.progress(f"reproduce {' '.join(experiments)}") as progress:
        parts = repeat(experiments, out, quick=quick, seed=seed, fields=fields, progress=progress)
    tables = [
        terminal.entries_table(f"{part.title}: {table.caption}", table.rows) for part in parts for table in part.tables
    ]
    last = terminal.Line(f"open {out / 'index.html'}")
    answer([row for part in parts for row in part.named_rows], as_json, *tables, last)

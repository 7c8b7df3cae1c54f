"""Commands on single flights: fly, explore, inspect, replay."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from keepout.cli.options import AsJson, ScenarioSeed, answer, app, example
from keepout.flights.pages import terminal


@app.command(epilog=example("keepout fly examples/case1.toml -o out/case1"))
def fly(
    scenario: Annotated[Path, typer.Argument(help="A scenario file (TOML).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for flight file, figures and page.")] = Path("out"),
    figures: Annotated[bool, typer.Option(help="Draw figures and the page.")] = True,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """Fly one scenario, audit the clearance on the exact mesh, and draw it."""
    from keepout.cli.commands.flight import fly_to_folder
    from keepout.core.mission.scenario import Scenario

    mission = Scenario.load(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    with terminal.progress(f"fly {mission.name}") as progress:
        summary = fly_to_folder(mission, out, figures=figures, progress=progress)
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.flights_table([summary]))
        Console().print(f"written to [bold]{out}[/bold]")


@app.command(epilog=example("keepout explore examples/explore.toml -o out/explore"))
def explore(
    scenario: Annotated[
        Path, typer.Argument(help="A scenario file (TOML) with [map], and [depth_sensor] and [explore] as needed.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for map, flight file, pictures and page.")] = Path(
        "out"
    ),
    figures: Annotated[bool, typer.Option(help="Draw pictures and the page.")] = True,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """Fly round a target that nobody has a model of: map what is seen free, approach in it, audit on the true mesh."""
    from keepout.apps.unknown.exploration_page import ROWS
    from keepout.cli.commands.explore import explore_to_folder
    from keepout.core.mission.scenario import Scenario

    mission = Scenario.load(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    with terminal.progress(f"explore {mission.name}") as progress:
        summary = explore_to_folder(mission, out, figures=figures, progress=progress)
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.result_table(f"Exploration {summary['name']}", summary, ROWS))
        Console().print(f"written to [bold]{out}[/bold]")


@app.command(epilog=example("keepout inspect examples/inspect.toml -o out/inspect"))
def inspect(
    scenario: Annotated[
        Path, typer.Argument(help="A scenario file (TOML), with [camera], [light] and [inspect] as needed.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for flight file, frames, pictures and page.")] = Path(
        "out"
    ),
    figures: Annotated[bool, typer.Option(help="Draw pictures and the page.")] = True,
    seed: ScenarioSeed = None,
    as_json: AsJson = False,
) -> None:
    """See all of a target that can be seen, in light, without touching it; audit the flight on the exact mesh."""
    from keepout.apps.inspection.inspection_page import ROWS
    from keepout.cli.commands.inspect import inspect_to_folder, mission_of

    mission = mission_of(scenario)
    if seed is not None:
        mission = mission.replace(seed=seed)
    with terminal.progress(f"inspect {mission.name}") as progress:
        summary = inspect_to_folder(mission, out, figures=figures, progress=progress)
    answer(summary, as_json)
    if not as_json:
        Console().print(terminal.result_table(f"Inspection {summary['name']}", summary, ROWS))
        Console().print(f"written to [bold]{out}[/bold]")


@app.command(
    epilog=example(
        "keepout replay out/case1/case1.parquet -o out/replay.html",
        "keepout replay out/a/case1.parquet out/b/case1.parquet -o out/both.html",
    )
)
def replay(
    flights: Annotated[list[Path], typer.Argument(help="Flight files (.parquet, .npz), all around one target.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The page to write (.html).")] = Path("replay.html"),
    title: Annotated[str | None, typer.Option(help="Of the page; by default the first flight's name.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write flights as one page to watch them in any browser, offline: the target, its envelope, paths and plots."""
    from keepout.cli.commands.flight import replay_to_page

    with terminal.progress("replay") as progress:
        summary = replay_to_page(flights, out, title=title, progress=progress)
    answer(summary, as_json)
    if not as_json:
        Console().print(f"open {summary['replay']}", highlight=False, markup=False, soft_wrap=True)

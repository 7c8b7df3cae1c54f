"""Commands on single flights: fly and replay; what applications add, as explore and inspect, is like `fly`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.cli.application import app
from keepout.cli.missions import add_mission_command
from keepout.cli.options import AsJson, answer, example, into
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
    from keepout.flights.pages.folder import results_in, write_flight, write_summary

    with results_in(out):
        flight = fly(scenario, target=target, progress=part_of(progress, 0.0, 0.9))
        places = f"start {list(scenario.start.position)} m, goal {list(scenario.goal.position)} m"
        introduction, title = f"Target {flight.target.name}, {places}.", f"Flight {scenario.name}"
        summary = write_flight(out, scenario.name, flight, title=title, introduction=introduction, figures=figures)
        write_summary(out, summary)
        return summary


add_mission_command(
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
    flights: Annotated[list[Path], typer.Argument(help="Flight files (.parquet, .npz), all around one target.")],
    out: Annotated[Path, into("The page to write (.html).")] = Path("replay.html"),
    title: Annotated[str | None, typer.Option(help="The page's title, instead of the first flight's name.")] = None,
    video: Annotated[
        Path | None,
        typer.Option(help="Also film it: .mp4, .gif, .webp, or .png (pictures in a row); needs Chromium."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write flights as one page to watch them in any browser, offline: the target, its envelope, paths and plots."""
    with terminal.progress("replay") as progress:
        from keepout.verbs import files

        summary = files.replay(flights, out, title=title, video=video, progress=progress)
    answer(summary, as_json, terminal.Line(f"open {summary['replay']}"))


@app.command(epilog=example("keepout report out/case1 --pdf", "keepout report out/campaign --pdf -o campaign.pdf"))
def report(
    folder: Annotated[Path, typer.Argument(help="The folder of fly, explore, inspect or campaign.")],
    pdf: Annotated[bool, typer.Option("--pdf", help="Write a PDF; else a campaign's page is written anew.")] = False,
    out: Annotated[Path | None, into("The PDF to write, instead of report.pdf in that folder.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print what was flown as four pages: mission and assumptions, what is proved, what was flown, requirements."""
    if not pdf:
        if out is not None or not (folder / "campaign.json").exists():
            raise UsageError(
                f"{folder}: give --pdf; only a campaign's page, index.html, can be written anew without it"
            )
        from keepout.flights.pages.campaign_page import report_campaign

        with terminal.progress(f"report {folder.name}") as progress:
            summary = report_campaign(folder, progress=progress)
        answer(summary, as_json, terminal.Line(f"open {summary['page']}"))
        return
    with terminal.progress(f"report {folder.name}") as progress:
        from keepout.verbs import files

        written = files.report(folder, out, progress=progress)
    answer({"report": str(written)}, as_json, terminal.Line(f"open {written}"))

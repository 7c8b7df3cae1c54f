"""Commands on single flights: fly and replay; what applications add, as explore and inspect, is like `fly`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from keepout.cli.application import app
from keepout.cli.missions import add_mission_command
from keepout.cli.options import AsJson, answer, example, into
from keepout.core.errors import FlightError, UsageError
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place
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
        out="Folder for flight file, figures and page.",
        figures="figures",
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
    title: Annotated[str | None, typer.Option(help="Of the page; by default the first flight's name.")] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            help="Also film it: .mp4, .gif, .webp, or .png for pictures in a row. Needs an installed Chromium."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write flights as one page to watch them in any browser, offline: the target, its envelope, paths and plots."""
    with terminal.progress("replay") as progress:
        if video is not None:
            from keepout.flights.pages.filmed import film, require_film

            require_film(video)
        told = part_of(progress, 0.0, 1.0 if video is None else 0.3)
        summary = replay_to_page(flights, out, title=title, progress=told)
        if video is not None:
            summary["video"] = str(film(out, video, progress=part_of(progress, 0.3, 1.0)))
    answer(summary, as_json, terminal.Line(f"open {summary['replay']}"))


def replay_to_page(
    flights: Sequence[Path], out: Path, *, title: str | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Write a replay of flight files, all around one target, as one self-contained page."""
    from keepout.flights.pages.replay_page import write_replay
    from keepout.flights.pages.replayed import of_files

    if out.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{out}: a replay is a page; its name ends in .html")
    require_place(out, refusal=FlightError)
    gathered = of_files(flights, progress=part_of(progress, 0.0, 0.4))
    first = gathered[0]
    title = title or f"{first.scenario.name} · {first.target.name}"
    return write_replay(out, gathered, title=title, progress=part_of(progress, 0.4, 1.0))


@app.command(epilog=example("keepout report out/case1 --pdf", "keepout report out/campaign --pdf -o campaign.pdf"))
def report(
    folder: Annotated[Path, typer.Argument(help="The folder of fly, explore, inspect or campaign.")],
    pdf: Annotated[bool, typer.Option("--pdf", help="As a PDF; without it a campaign's page is written anew.")] = False,
    out: Annotated[Path | None, into("The PDF to write; by default report.pdf in that folder.")] = None,
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
    if out is not None and out.suffix.lower() != ".pdf":
        raise UsageError(f"{out}: a report ends in .pdf")
    with terminal.progress(f"report {folder.name}") as progress:
        from keepout.flights.pages.printed import print_report

        written = print_report(folder, out, progress=progress)
    answer({"report": str(written)}, as_json, terminal.Line(f"open {written}"))

"""Commands on single flights as functions: what `fly` and `replay` do."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.errors import FlightError, UsageError
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario


def fly_to_folder(
    scenario: "Scenario", out: Path, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Fly a scenario; write flight file, figures, page and `summary.json` into `out`."""
    from keepout.core.mission.first_look import look

    target = look(scenario)
    from keepout.core.mission.flight import fly
    from keepout.flights.pages.folder import results_in, write_flight, write_summary

    with results_in(out):
        flight = fly(scenario, target=target, progress=part_of(progress, 0.0, 0.9))
        places = f"start {list(scenario.start.position)} m, goal {list(scenario.goal.position)} m"
        introduction = f"Target {flight.target.name}, {places}."
        title = f"Flight {scenario.name}"
        summary = write_flight(out, scenario.name, flight, title=title, introduction=introduction, figures=figures)
        write_summary(out, summary)
        return summary


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

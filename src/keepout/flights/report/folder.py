"""A folder of results: flight files, figures and one page to open."""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.errors import ScenarioError
from keepout.core.whole_file import removed_again, require_place, write_whole

if TYPE_CHECKING:
    from keepout.core.mission.flight import Flight


def write_summary(out: Path, summary: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> None:
    """Write figures as plain numbers into the folder's `summary.json`."""
    write_whole(out / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")


def make_folder(out: Path) -> None:
    """Make the folder that results go into, with those above it; before anything is flown, so that no flight is lost.

    Raises:
        ScenarioError: it cannot be made, as where a file has its name, or nothing can be written into it.

    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ScenarioError(f"{out}: cannot be made a folder ({error.strerror}); give another folder") from None
    require_place(out / "results", refusal=ScenarioError)


@contextlib.contextmanager
def results_in(out: Path | None) -> Iterator[None]:
    """Make the folder as `make_folder` does; where what follows fails, those made that are still empty go again.

    Without a folder there is nothing to do.
    """
    if out is None:
        yield
        return
    with removed_again(out, only_on_failure=True):
        make_folder(out)
        yield


def write_flights(
    out: Path, flights: Mapping[str, "Flight"], *, title: str, introduction: str, figures: bool = True
) -> list[dict[str, Any]]:
    """Write the flights of one mission, flown in several ways, and what there is to see of them.

    Args:
        out: folder to write into; made if it is not there.
        flights: by name; all around the same target and to the same goal.
        title: of the page.
        introduction: of the page, plain text.
        figures: also draw the PNG files, and write `index.html` and `replay.html`.

    Returns:
        One summary a flight, with its `name` and the path of its flight file under `flight`.

    """
    make_folder(out)
    summaries = []
    for name, flight in flights.items():
        path = out / f"{flight.scenario.name}.parquet"
        flight.record.save(path)
        summaries.append({"name": name, **flight.summary(), "flight": str(path)})
    if figures:
        from keepout.flights.replay.flights import of_flights
        from keepout.flights.report.page import write_page
        from keepout.flights.report.replay_view import write_replay

        images = _draw(out, flights)
        write_replay(out / "replay.html", of_flights(flights), title=title)
        write_page(
            out / "index.html",
            title=title,
            introduction=introduction,
            summaries=summaries,
            replay=out / "replay.html",
            figures=images,
        )
    return summaries


def _draw(out: Path, flights: Mapping[str, "Flight"]) -> list[Path]:
    from keepout.flights.report import (  # drawing libraries, for which nobody waits who draws nothing
        flight_view,
        target_view,
    )

    first = next(iter(flights.values()))
    goal = first.scenario.goal.position
    paths = out / "paths.png"
    target_view.draw_paths(
        paths,
        first.target.vertices,
        first.target.faces,
        {name: flight.record.position for name, flight in flights.items()},
        goal,
    )
    clearance, error = out / "clearance.png", out / "error.png"
    flight_view.draw_clearance(clearance, flights)
    flight_view.draw_error(error, flights)
    images = [paths, clearance, error]
    for name, flight in flights.items():
        image = out / f"{flight.scenario.name}.png"
        flight_view.draw_motion(image, flight, name=name)
        images.append(image)
    return images

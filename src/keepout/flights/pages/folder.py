"""A folder of results: made before the work, gone again where nothing came of it; flight files and a summary."""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.errors import ScenarioError
from keepout.core.whole_file import removed_again, require_place, write_whole
from keepout.flights.requirements import judged

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


def write_flight(
    out: Path, name: str, flight: "Flight", *, title: str, introduction: str, figures: bool = True
) -> dict[str, Any]:
    """Write a flight, and what there is to see of it, into a folder that there is.

    Args:
        out: the folder.
        name: of the flight in tables and pictures.
        flight: to write.
        title: of the page.
        introduction: of the page, plain text.
        figures: also draw the PNG files, and write `index.html` and `replay.html`.

    Returns:
        Its summary, with `name` and the path of its flight file under `flight`.

    """
    path = out / f"{flight.scenario.name}.parquet"
    flight.record.save(path)
    summary = {"name": name, **flight.summary(), "flight": str(path)}
    summary["requirements"] = judged(flight.scenario, summary)
    if figures:
        from keepout.flights.pages import flight_page  # what draws, for which nobody waits who wants no figures

        flight_page.write_page(out, name, flight, summary, title=title, introduction=introduction)
    return summary

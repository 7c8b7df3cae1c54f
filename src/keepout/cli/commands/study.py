"""Commands that answer a question by many flights, as functions: what `rare` does."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from keepout.core.progress import Progress, part_of, silent

if TYPE_CHECKING:
    from keepout.core.mission.scenario import Scenario


def rare_to_folder(
    scenario: "Scenario",
    out: Path,
    *,
    below: float = 0.0,
    runs: int | None = None,
    flights: int | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure a rare event; write levels, curve, the worst flight, a page and `summary.json` into `out`.

    Stopped, it goes on from its last level when it is started again. No folder is left where the scenario is refused.
    """
    from keepout.flights.pages.folder import results_in, write_summary
    from keepout.flights.pages.rare_page import write_rare
    from keepout.flights.rare_events.event import FLIGHTS, RUNS, rare

    runs, flights = RUNS if runs is None else runs, FLIGHTS if flights is None else flights
    with results_in(out):
        event = rare(
            scenario, below=below, runs=runs, flights=flights, state=out, progress=part_of(progress, 0.0, 0.97)
        )
        summary = write_rare(out, event)
        write_summary(out, summary)
    return summary

"""The folder of an exploration: map, flight file, summary, pictures, replay and a page that shows them."""

from pathlib import Path
from typing import Any

from keepout.apps.unknown import exploration_pictures as pictures
from keepout.apps.unknown import map_file
from keepout.apps.unknown.exploration import Exploration
from keepout.apps.unknown.growth import Growth
from keepout.core.progress import Progress, silent
from keepout.flights.pages.flight_page import Told, draw_result
from keepout.flights.pages.folder import make_folder, write_summary

MAP = "map.keepmap"
ROWS = {
    "outcome": "outcome",
    "why": "because",
    "contact_verdict": "contact, on the true mesh",
    "minimum_clearance_m": "min clearance m",
    "seen_share": "share of the outer surface seen",
    "views": "views",
    "refused_views": "of them refused",
    "contradicting_returns": "returns in room known free",
    "opened_m3": "opened m³",
    "departures_largest_m": "largest departure from the expected mesh m",
    "duration_s": "flown s",
    "delta_v_mps": "Δv m/s",
    "guard_interventions": "guard steps",
    "start_certified": "start certified",
    "seconds": "computed in s",
}
"""Words for the entries of an exploration's summary that a person is shown first."""


def write_exploration(
    out: Path, exploration: Exploration, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Write all that an exploration has to show into a folder; give its summary with the names of the files.

    Args:
        out: made if it is not there.
        exploration: at its end.
        figures: also draw the PNG files, and write `index.html` and `replay.html`.
        progress: told how far it is.

    """
    make_folder(out)
    name = exploration.scenario.name
    flight, kept = out / f"{name}.parquet", out / MAP
    map_file.save(exploration.map, kept)
    exploration.record.save(flight)
    summary = {"name": name, **exploration.summary(), "map": str(kept), "flight": str(flight)}
    if figures:
        told, layer, drawn = Told(said(exploration), ROWS), Growth(exploration), _drawn(exploration)
        summary["pictures"] = draw_result(out, exploration, summary, told, drawn, layer=layer, progress=progress)
    write_summary(out, summary)
    return summary


def _drawn(exploration: Exploration) -> dict[str, Any]:
    """Give what draws the pictures that there are, with captions."""
    drawn = {
        "seen": (pictures.draw_seen, "What was seen when, on the true surface, which nothing on board knew."),
        "map": (
            pictures.draw_slices,
            "The map at the end. What is not known free is an obstacle, whether something is there or not.",
        ),
        "progress": (pictures.draw_progress, "How the map grew, and where the chaser was."),
    }
    if len(exploration.unknown):
        drawn["unknown"] = (pictures.draw_unknown, f"What is unknown, and why it stays so: {exploration.why}.")
    if exploration.departures is not None:
        drawn["departures"] = (
            pictures.draw_departures,
            "Where the seen surface is not where the expected mesh says, beyond what the sensor's errors explain.",
        )
    return drawn


def said(exploration: Exploration) -> str:
    """Say in a sentence or two how an exploration ended."""
    taken = sum(view.status == "seen" for view in exploration.views)
    return (
        f"{exploration.outcome[0].upper()}{exploration.outcome[1:]}: {exploration.why}. {taken} views of "
        f"{len(exploration.views)} were taken in, and {exploration.seen_share:.0%} of the outer surface was seen. "
        f"{exploration.contact_said(' on the true mesh')}."
    )

"""Replays of a campaign's worst flights, of those that were kept."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
from jaxtyping import Float

from keepout.core.errors import FlightError, KeepoutError
from keepout.core.flight.record import FlightRecord
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.campaign.results import Results
from keepout.flights.replay.flights import Replayed, Surroundings
from keepout.flights.report.replay_view import write_replay
from keepout.flights.report.style import COLOURS, figure

Clearance = tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]
"""Times, s, and clearances on the exact mesh, m."""


@dataclass(frozen=True)
class Shown:
    """What became of a kept flight: the address of its replay within the folder of the page, or why it has none."""

    address: str | None
    why_not: str = ""


def write_replays(folder: Path, found: Results, *, progress: Progress = silent) -> dict[int, Shown]:
    """Write replays of the worst flights that have a flight file, one page a target, and a figure of their clearances.

    Args:
        folder: for the pages `worst.html`, `worst-2.html`, … and the figure `worst.png` and `.svg`.
        found: the campaign's results.
        progress: told after each flight.

    Returns:
        By run number, for the flights that were kept; without flight files nothing is written.

    """
    dataset = found.reading
    surroundings = Surroundings()
    groups: dict[str, list[Replayed]] = {}
    shown: dict[int, Shown] = {}
    curves: dict[int, Clearance] = {}
    for place, row in enumerate(found.worst):
        run = row["run"]
        try:
            record = FlightRecord.load(dataset.kept(run))
        except FlightError:  # not kept, or being written: the page says so
            continue
        if record.header.get("campaign") != dataset.plan_sha256 or record.header.get("run") != run:
            continue
        try:
            flight = surroundings.of(f"run {run}", record)
        except KeepoutError as refusal:
            shown[run] = Shown(None, str(refusal))
            continue
        group = groups.setdefault(flight.target.sha256, [])
        group.append(flight)
        shown[run] = Shown(f"{_page(list(groups).index(flight.target.sha256))}#{quote(flight.name)}")
        clearance = flight.target.distance.distance(flight.shown.position) - flight.scenario.chaser.radius
        curves[run] = flight.shown.time, clearance
        progress(0.3 * (place + 1) / len(found.worst), f"flight of run {run}")
    for stale in (*folder.glob("worst*.html"), *folder.glob("worst.png"), *folder.glob("worst.svg")):
        stale.unlink()
    title = f"Campaign {found.reading.scenario.name}: worst flights"
    for place, group in enumerate(groups.values()):
        part = part_of(progress, 0.3 + 0.7 * place / len(groups), 0.3 + 0.7 * (place + 1) / len(groups))
        write_replay(folder / _page(place), group, title=title, progress=part)
    if curves:
        _draw(folder / "worst.png", curves)
    return shown


def _page(place: int) -> str:
    return "worst.html" if place == 0 else f"worst-{place + 1}.html"


def _draw(path: Path, curves: Mapping[int, Clearance]) -> None:
    styles = [(colour, line) for line in ("-", "--") for colour in COLOURS]
    with figure(path, width=3.5, height=2.8, vector=True) as drawing:
        axes = drawing.add_subplot()
        for (colour, line), (run, (time, clearance)) in zip(styles, curves.items()):
            axes.plot(time, clearance, color=colour, linestyle=line, linewidth=0.9, label=f"run {run}")
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set_xlabel("time, s", fontsize=8)
        axes.set_ylabel("clearance, m", fontsize=8)
        axes.tick_params(labelsize=7)
        drawing.legend(loc="outside lower center", ncols=3, fontsize=7)

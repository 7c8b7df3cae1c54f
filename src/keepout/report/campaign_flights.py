"""Replays of a campaign's worst flights, of those that were kept."""

import base64
import html
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from keepout.campaign.dataset import Dataset
from keepout.campaign.results import Results
from keepout.errors import FlightError
from keepout.flight.record import FlightRecord
from keepout.geometry.target import Target
from keepout.mission.build import load_target
from keepout.mission.scenario import Scenario
from keepout.progress import Progress, silent
from keepout.report.page import STYLE, replay_records
from keepout.report.style import COLOURS, figure
from keepout.whole_file import write_whole

Clearance = tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples"]]
"""Times, s, and clearances on the exact mesh, m."""


def write_replays(path: Path, found: Results, *, progress: Progress = silent) -> dict[int, str]:
    """Write one page with a replay of each of the worst flights that has a flight file, and a figure of clearances.

    Args:
        path: of the page; the figure `<stem>.png` and `.svg` stands beside it.
        found: the campaign's results.
        progress: told after each flight.

    Returns:
        Run numbers and titles of the flights on it; without flight files there is no page.

    """
    dataset = Dataset.open(found.reading.folder)
    targets: dict[str, Target] = {}
    parts: list[str] = []
    titles: dict[int, str] = {}
    curves: dict[int, Clearance] = {}
    for place, row in enumerate(found.worst):
        run = row["run"]
        try:
            record = FlightRecord.load(dataset.kept(run))
        except FlightError:  # not kept, or being written: the page says so
            continue
        if record.header.get("campaign") != dataset.plan_sha256 or record.header.get("run") != run:
            continue
        scenario = Scenario.model_validate_json(record.header["scenario"])
        entry = scenario.target.model_dump_json()
        if entry not in targets:
            targets[entry] = load_target(scenario.target)
        target, radius = targets[entry], scenario.chaser.radius
        curves[run] = record.time, target.distance.distance(record.position) - radius
        titles[run] = f"Run {run}: least clearance {row['minimum_clearance']:.4g} m"
        drawing = replay_records({f"run {run}": record}, target, radius, with_library=not parts)
        parts.append(f'<h2 id="run-{run}">{html.escape(titles[run])}</h2>{drawing}')
        progress((place + 1) / len(found.worst), f"replay of run {run}")
    if not parts:
        path.unlink(missing_ok=True)
        return {}
    image = path.with_suffix(".png")
    _draw(image, curves)
    title = f"Campaign {found.reading.scenario.name}: worst flights"
    picture = base64.b64encode(image.read_bytes()).decode("ascii")
    write_whole(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1>"
        f'<figure><img alt="clearance" src="data:image/png;base64,{picture}"><figcaption>Clearance on the exact mesh '
        f'at the recorded samples (<a href="{image.stem}.svg">SVG</a>)</figcaption></figure>{"".join(parts)}</html>',
    )
    return titles


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

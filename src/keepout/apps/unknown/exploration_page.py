"""The folder of an exploration: map, flight file, summary, pictures, replay and a page that shows them."""

import base64
import html
from pathlib import Path
from typing import Any

from keepout.apps.unknown import exploration_view, map_file
from keepout.apps.unknown.exploration import Exploration
from keepout.apps.unknown.growth import Growth
from keepout.core.mission.flight import Flight
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.replay.flights import Replayed
from keepout.flights.report import flight_view
from keepout.flights.report.folder import make_folder, write_summary
from keepout.flights.report.page import STYLE, embedded
from keepout.flights.report.replay_view import write_replay
from keepout.flights.report.terminal import EXPLORATION_ROWS, broken_assumptions, shown

MAP = "map.keepmap"


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
        images = _draw(out, exploration, part_of(progress, 0.0, 0.5))
        replayed = Replayed(
            name,
            exploration.record,
            exploration.scenario,
            exploration.target,
            exploration.audit,
            growth=Growth.of(exploration),
        )
        write_replay(
            out / "replay.html",
            [replayed],
            title=f"{name}: {exploration.outcome}",
            progress=part_of(progress, 0.5, 1.0),
        )
        summary["pictures"] = [str(image) for image in images]
        write_page(out / "index.html", exploration, summary, images)
    write_summary(out, summary)
    return summary


def _draw(out: Path, exploration: Exploration, progress: Progress) -> dict[Path, str]:
    """Draw the pictures; give each with its caption."""
    drawn = {
        "seen": (
            exploration_view.draw_seen,
            "What was seen when, on the true surface, which nothing on board knew.",
        ),
        "map": (
            exploration_view.draw_slices,
            "The map at the end. What is not known free is an obstacle, whether something is there or not.",
        ),
        "progress": (exploration_view.draw_progress, "How the map grew, and where the chaser was."),
    }
    if len(exploration.unknown):
        drawn["unknown"] = (exploration_view.draw_unknown, f"What is unknown, and why it stays so: {exploration.why}.")
    if exploration.departures is not None:
        drawn["departures"] = (
            exploration_view.draw_departures,
            "Where the seen surface is not where the expected mesh says, beyond what the sensor's errors explain.",
        )
    images = {}
    for place, (stem, (draw, caption)) in enumerate(drawn.items()):
        progress(place / (len(drawn) + 1), f"picture {stem}")
        draw(out / f"{stem}.png", exploration)
        images[out / f"{stem}.png"] = caption
    motion = out / "motion.png"
    scenario = exploration.scenario
    flight_view.draw_motion(motion, _flight(exploration), name=scenario.name)
    images[motion] = "Velocity, force and disturbance over time."
    progress(1.0, "")
    return images


def _flight(exploration: Exploration) -> Flight:
    """Give the exploration's flight as any other is told of."""
    record, scenario = exploration.record, exploration.scenario
    return Flight(
        scenario,
        exploration.target,
        record,
        exploration.flown,
        exploration.audit,
        exploration.target.distance.distance(record.position) - scenario.chaser.radius,
        start_certified=exploration.start_certified,
        assumptions_broken=exploration.assumptions_broken,
        guard=exploration.guard,
    )


def write_page(path: Path, exploration: Exploration, summary: dict[str, Any], images: dict[Path, str]) -> None:
    """Write the page of an exploration: how it ended, its figures, the replay, and the pictures with captions."""
    scenario = exploration.scenario
    title = f"Exploration {scenario.name}"
    bad = {"contact_verdict"} if summary["contact"] else set()
    rows = "".join(
        f"<tr><td>{html.escape(words)}</td><td{' class=bad' if key in bad else ''}>"
        f"{html.escape(shown(summary[key]))}</td></tr>"
        for key, words in EXPLORATION_ROWS.items()
        if summary[key] is not None
    )
    pictures = "".join(
        f'<h3>{html.escape(caption)}</h3><p><img alt="{html.escape(image.stem)}" '
        f'src="data:image/png;base64,{base64.b64encode(image.read_bytes()).decode("ascii")}"></p>'
        for image, caption in images.items()
    )
    broken = "".join(f"<p class=bad>{html.escape(line)}</p>" for line in broken_assumptions([summary]))
    write_whole(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><p><b>{html.escape(said(exploration))}</b></p>{broken}"
        f"<table>{rows}</table><h2>Replay</h2>{embedded('replay.html')}<h2>Pictures</h2>{pictures}</html>",
    )


def said(exploration: Exploration) -> str:
    """Say in a sentence or two how an exploration ended."""
    taken = sum(view.status == "seen" for view in exploration.views)
    contact = {"no": "No contact, proved", "yes": "Contact", "undecided": "Contact not excluded"}
    words = (
        f"{exploration.outcome[0].upper()}{exploration.outcome[1:]}: {exploration.why}. {taken} views of "
        f"{len(exploration.views)} were taken in, and {exploration.seen_share:.0%} of the outer surface was seen. "
        f"{contact[str(exploration.audit.contact)]}"
    )
    if exploration.audit.contact == "no":
        words += f": the clearance on the true mesh is at least {exploration.audit.minimum_clearance:.3f} m"
    return words + "."

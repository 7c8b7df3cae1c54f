"""What a flight, a target and a certificate show of themselves: a page, a figure, and a cell of a notebook.

`plug_in.toml` beside it gives these to the classes in the core.
"""

import html
import io
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from keepout.core.errors import FlightError, UsageError
from keepout.core.fields.model import Certificate
from keepout.core.geometry.target import Target
from keepout.core.mission.flight import Flight
from keepout.core.whole_file import require_place, write_whole
from keepout.flights.pages.approach_drawn import paint_bodies
from keepout.flights.pages.figures import drawn
from keepout.flights.pages.mesh_pictures import PATHS_FROM, eye_axes, paint_paths, paint_target
from keepout.flights.pages.page import Markup, embedded, text
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_flights

_FORMS = (".png", ".pdf", ".svg")


def replay(flight: Flight, path: Path, title: str | None = None) -> Path:
    """Write the replay of a flight that is in memory, and return its path.

    Args:
        flight: to watch.
        path: the page (.html).
        title: of the page; the scenario's and the target's name if absent.

    Raises:
        KeepoutError: another ending, or a place that cannot be written.

    """
    require_page(path)
    name = flight.scenario.name
    write_replay(path, of_flights({name: flight}), title=title or f"{name} · {flight.target.name}")
    return path


def require_page(path: Path) -> None:
    """Refuse the path of a page that does not end so, or cannot be written.

    Raises:
        KeepoutError: it is refused.

    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{path}: a replay is a page; its name ends in .html")
    require_place(path, refusal=FlightError)


def plot(flight: Flight, path: str | Path | None = None) -> Figure:
    """Draw a flight: its path from two sides, then clearance, speed, force and distance to the goal over time.

    Args:
        flight: to draw.
        path: also write it there (.png, .pdf or .svg).

    Raises:
        UsageError: another ending.

    """
    if path is not None and Path(path).suffix.lower() not in _FORMS:
        raise UsageError(f"{path}: a figure ends in {', '.join(_FORMS)}")
    record, name, chaser, goal = flight.record, flight.scenario.name, flight.scenario.chaser, flight.scenario.goal
    away = np.linalg.norm(record.position - np.asarray(goal.position), axis=1)
    series = {
        "clearance, m": (flight.clearance, 0.0),
        "speed, m/s": (np.linalg.norm(record.velocity, axis=1), chaser.speed_limit),
        "force, N": (np.linalg.norm(record.force, axis=1), None),
        "to the goal, m": (away, goal.tolerance),
    }
    with drawn(width=11.0, height=9.0) as drawing:
        rows = drawing.add_gridspec(3, 2, height_ratios=(2.0, 1.0, 1.0))
        for place, side in enumerate(PATHS_FROM):
            panel = drawing.add_subplot(rows[0, place])
            paint_paths(panel, flight.target, {name: record.position}, [goal.position], eye_axes(*side))
            paint_bodies(panel, flight.scenario, eye_axes(*side))
        for place, (words, (values, limit)) in enumerate(series.items()):
            panel = drawing.add_subplot(rows[1 + place // 2, place % 2])
            panel.plot(record.time, values, linewidth=0.9)
            if limit is not None:
                panel.axhline(limit, color="grey", linewidth=0.8)
            panel.set(xlabel="time, s", ylabel=words)
        drawing.suptitle(f"{name}: {flight.verdict.contact}")
        if path is not None:
            image = io.BytesIO()
            drawing.savefig(image, format=Path(path).suffix[1:].lower())
            write_whole(Path(path), image.getvalue(), refusal=UsageError)
    return drawing


def flight_html(flight: Flight) -> str:
    """Show a flight in a notebook: the verdict, its path around the target, and the replay."""

    def paint(drawing: Figure) -> None:
        goal, path = flight.scenario.goal.position, {flight.scenario.name: flight.record.position}
        panel, eye = drawing.add_subplot(), eye_axes(*PATHS_FROM[0])
        paint_paths(panel, flight.target, path, [goal], eye)
        paint_bodies(panel, flight.scenario, eye)

    with tempfile.TemporaryDirectory() as folder:
        watched = watched_html(replay(flight, Path(folder) / "replay.html"))
    return f"<p><b>{text(flight.verdict)}</b></p>{picture(paint, 'the path around the target')}{watched}"


def watched_html(page: Path) -> Markup:
    """Give a replay as an element that holds its whole page."""
    held = html.escape(page.read_text(encoding="utf-8"))
    return Markup(f'<iframe srcdoc="{held}" width="100%" height="600" title="Replay"></iframe>')


def target_html(target: Target) -> str:
    """Show a target in a notebook: what it is, and a shaded picture."""
    report = target.report
    sizes = " x ".join(f"{extent:.4g}" for extent in np.ptp(target.vertices, axis=0))
    facts = {"size, m": sizes, "triangles": len(target.faces), "watertight": report.watertight}
    facts |= {"warning": "; ".join(report.warnings)} if report.warnings else {}
    seen = picture(lambda drawing: paint_target(drawing.add_subplot(), target, eye_axes(*PATHS_FROM[0])), target.name)
    return f"<p><b>{text(target.name)}</b></p>{facts_html(facts)}{seen}"


def certificate_html(certificate: Certificate) -> str:
    """Show a certificate in a notebook: its verdict in words, and its numbers."""
    bound, radius = certificate.error_bound, certificate.chaser_radius
    said = (
        f"Proved: where a chaser of {radius:g} m touches, the field says at most {bound:.4g} m too much"
        if certificate.kind == "certified"
        else f"Sampled, not proved: where a chaser of {radius:g} m touches, {bound:.4g} m too much was allowed for"
    )
    return f"<p><b>{text(said)}</b></p>{facts_html(asdict(certificate))}"


def facts_html(facts: Mapping[str, Any]) -> Markup:
    """Lay figures out as a table, a row each."""
    rows = "".join(f"<tr><th>{text(name)}</th><td>{text(value)}</td></tr>" for name, value in facts.items())
    return Markup(f"<table>{rows}</table>")


def picture(paint: Callable[[Figure], Any], words: str) -> Markup:
    """Give what `paint` draws as an element that holds it, with words for who cannot see it."""
    with drawn(width=8.0, height=5.0) as drawing:
        paint(drawing)
        image = io.BytesIO()
        drawing.savefig(image, format="png", dpi=100)
    return embedded(image.getvalue(), words)

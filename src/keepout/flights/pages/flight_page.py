"""One flight shown: its page with the replay beside it, figures over time, and a cell of a notebook.

`plug_in.toml` beside it gives what a flight shows of itself to the classes in the core, and the cells of a target and a
certificate with it.
"""

import html
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keepout.core.errors import FlightError, UsageError
from keepout.core.fields.model import Certificate
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.target import Target
from keepout.core.mission.approach import has_rules
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import require_place, write_whole
from keepout.flights.pages.approach_drawn import STILL, distance_left, paint_legs, paint_rules, places
from keepout.flights.pages.figures import COLOURS, draw_signal, drawn, figure, image, logarithmic, picture
from keepout.flights.pages.mesh_pictures import PATHS_FROM, draw_paths, eye_axes, paint_paths, paint_target
from keepout.flights.pages.page import Headline, Markup, Page, Provenance, bad, tell_requirements, text, verdict_of
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import Layer, Replayed, of_flights
from keepout.flights.pages.terminal import FLIGHT_COLUMNS

_FORMS = (".png", ".pdf", ".svg")

Pictures = Mapping[str, tuple[Callable[[Path], None], str]]
"""By the name of the PNG file, without ending: what draws it, and its caption, plain text."""


def write_page(
    out: Path, name: str, flight: Flight, summary: Mapping[str, Any], *, title: str, introduction: str
) -> None:
    """Draw a flight's figures, and write `replay.html` and the page `index.html` that shows them.

    Args:
        out: folder.
        name: of the flight.
        flight: to draw.
        summary: as `fly` reports it.
        title: heading.
        introduction: what was flown, plain text.

    """

    def tell(page: Page) -> None:
        page.words(introduction)
        wrong = {"contact": summary["contact"], "reached": not summary["reached"]}
        cells = {words: bad(summary[key]) if wrong.get(key) else summary[key] for key, words in FLIGHT_COLUMNS.items()}
        page.table([{"flight": name, **cells}])
        tell_requirements(page, summary["requirements"])

    pictures: Pictures = {
        "paths": (
            lambda path: draw_paths(path, flight.target, {name: flight.record.position}, flight.scenario),
            "The path around the target, from two sides; dotted where the target hides it."
            + (f" {STILL}" if has_rules(flight.scenario) else ""),
        ),
        "clearance": (
            lambda path: draw_clearance(path, flight),
            "Clearance on the exact mesh, and the barrier h that the law flies by.",
        ),
        "error": (
            lambda path: draw_error(path, flight),
            "Distance to the goal, and the goal's tolerance (grey)."
            if flight.record.leg is None
            else "Distance to the place of the leg under way, and its tolerance (grey).",
        ),
        flight.scenario.name: (
            lambda path: draw_motion(path, flight),
            "Velocity and safe velocity (dashed), applied force, disturbance and its estimate (dashed), by axis of the "
            "target's body frame; limits in grey. Of a long flight a band from least to largest, and the mean."
            + (" Dotted: the largest speed by distance." if flight.scenario.approach.speed_by_distance else "")
            + (" Vertical: a leg begins." if flight.record.leg is not None else ""),
        ),
    }
    [replayed] = of_flights({name: flight})
    head = verdict_of(summary), Provenance.of([replayed])
    draw_page(out, replayed, pictures, tell, title=title, replay=title, head=head)


def draw_page(
    out: Path,
    flight: Replayed,
    pictures: Pictures,
    tell: Callable[[Page], None],
    *,
    title: str,
    replay: str,
    head: tuple[Headline, Provenance],
    progress: Progress = silent,
) -> list[str]:
    """Draw pictures of a flight, and write `replay.html` and `index.html`.

    Args:
        out: folder.
        flight: to replay.
        pictures: to draw.
        tell: adds what stands before replay and pictures to the page.
        title: of the page.
        replay: title of the replay.
        head: and foot of the page.
        progress: told how far it is.

    Returns:
        The paths of the pictures.

    """
    page = Page(out / "index.html", title, *head)
    for place, (stem, (draw, _)) in enumerate(pictures.items()):
        progress(0.5 * place / len(pictures), f"picture {stem}")
        draw(out / f"{stem}.png")
    write_replay(out / "replay.html", [flight], title=replay, progress=part_of(progress, 0.5, 1.0))
    tell(page)
    page.heading("Replay")
    page.replay(out / "replay.html")
    page.heading("Pictures")
    for stem, (_, caption) in pictures.items():
        page.picture(out / f"{stem}.png", caption)
    page.write()
    return [str(out / f"{stem}.png") for stem in pictures]


class Told(NamedTuple):
    """What a page tells of a flight of several legs.

    Attributes:
        said: how it ended, in a sentence, plain text.
        digests: of what it flew by, for the foot.
        rows: words for the entries of the summary that are told, in order; one that is None is left out.
        tell: adds what stands between that table and the replay to the page.

    """

    said: str
    digests: Mapping[str, str]
    rows: Mapping[str, str]
    tell: Callable[[Page], None] = lambda page: None


def draw_result(
    out: Path,
    result: Any,
    summary: Mapping[str, Any],
    told: Told,
    pictures: Mapping[str, tuple[Callable[[Path, Any], None], str]],
    *,
    layer: Layer,
    progress: Progress = silent,
) -> list[str]:
    """Draw what an application's flight of several legs has come to: pictures, `replay.html` and `index.html`.

    Args:
        out: folder.
        result: of the flight, an `Exploration` or an `Inspection`.
        summary: of it.
        told: what the page says.
        pictures: as `Pictures`, but what draws is given the result too; how the chaser moved is added.
        layer: of the replay.
        progress: told how far it is.

    Returns:
        The paths of the pictures.

    """
    flight, name = result.flight, result.scenario.name
    every: dict[str, tuple[Callable[[Path], None], str]] = {
        stem: (lambda path, draw=draw: draw(path, result), words) for stem, (draw, words) in pictures.items()
    }
    every["motion"] = (lambda path: draw_motion(path, flight), "Velocity, force and disturbance over time.")

    def tell(page: Page) -> None:
        page.words(told.said)
        rows = {words: _cell(key, summary) for key, words in told.rows.items() if summary[key] is not None}
        page.table([{"": words, "value": value} for words, value in rows.items()], headings=False)
        tell_requirements(page, summary["requirements"])
        told.tell(page)

    title, replay = f"{type(result).__name__} {name}", f"{name}: {result.outcome}"
    [replayed] = of_flights({name: flight}, layer)
    made = Provenance.of([replayed])
    head = verdict_of(summary), replace(made, digests={**made.digests, **told.digests})
    return draw_page(out, replayed, every, tell, title=title, replay=replay, head=head, progress=progress)


def _cell(key: str, summary: Mapping[str, Any]) -> Any:
    """Give an entry of a summary for a page: a share of the surface in per cent; a contact stands out."""
    value = summary[key]
    if key == "contact_verdict" and summary["contact"]:
        return bad(value)
    return f"{100.0 * value:.3f} %" if key.startswith(("coverage", "seen_share")) else value


def draw_clearance(path: Path, flight: Flight) -> None:
    """Draw the exact clearance of the chaser's ball and the law's own barrier value over time into one PNG."""
    with figure(path, height=3.6) as drawing:
        axes, time = drawing.add_subplot(), flight.record.time
        axes.plot(time, flight.clearance, color=COLOURS[0], label="exact clearance")
        axes.plot(time, flight.record.barrier, color=COLOURS[1], linewidth=0.9, linestyle="--", label="barrier h")
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="time, s", ylabel="clearance, h, m")
        axes.legend(fontsize=8)


def draw_error(path: Path, flight: Flight) -> None:
    """Draw the distance to the goal, or to the place of the leg under way, over time into one PNG."""
    scenario, record = flight.scenario, flight.record
    with figure(path, height=3.6) as drawing:
        axes = drawing.add_subplot()
        axes.plot(record.time, distance_left(scenario, record))
        if record.leg is None:
            axes.axhline(scenario.goal.tolerance, color="grey", linewidth=0.8)
        else:
            axes.step(record.time, places(scenario, record)[1], where="post", color="grey", linewidth=0.8)
            paint_legs(axes, record.time, scenario, record)
        logarithmic(axes)
        axes.set(xlabel="time, s", ylabel="‖r − goal‖, m" if record.leg is None else "‖r − leg‖, m")


def draw_motion(path: Path, flight: Flight) -> None:
    """Draw one flight's velocity, applied force and disturbance estimate, each by axis, into one PNG."""
    with figure(path, width=8.0, height=7.2) as drawing:
        paint_motion([*drawing.subplots(3, 1, sharex=True)], flight.record, flight.scenario, flight.clearance)


def paint_motion(
    panels: Sequence[Axes], record: FlightRecord, scenario: Scenario, clearance: Float[np.ndarray, "rows"]
) -> None:
    """Show velocity with its rules, applied force and disturbance over time, each by axis, in three panels."""
    chaser = scenario.chaser
    thin = {"linewidth": 0.7, "linestyle": "--"}
    columns = (("v", record.velocity, record.safe_velocity), ("F", record.force, None))
    for axes, (letter, given, beside) in zip(
        panels, (*columns, ("d", record.disturbance, record.disturbance_estimate)), strict=True
    ):
        for axis, (label, colour) in enumerate(zip("xyz", COLOURS)):
            draw_signal(axes, record.time, given[:, axis], color=colour, label=f"{letter} {label}")
            if beside is not None:
                draw_signal(axes, record.time, beside[:, axis], color=colour, **thin)
    velocity, force, disturbance = panels
    draw_signal(velocity, record.time, np.linalg.norm(record.velocity, axis=1), color="black", label="‖v‖")
    for axes, limit in ((velocity, chaser.speed_limit), (force, chaser.force_limit)):
        axes.axhline(limit, color="grey", linewidth=0.8)
        axes.axhline(-limit, color="grey", linewidth=0.8)
    paint_rules(velocity, record.time, scenario, record, clearance)
    velocity.set_ylabel("velocity, m/s")
    force.set_ylabel("applied force, N")
    disturbance.set(ylabel="disturbance, N", xlabel="time, s")
    for axes in panels:
        axes.legend(fontsize=8, ncols=5, loc="lower right", bbox_to_anchor=(1.0, 0.99), borderaxespad=0.0)


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
    paths = {name: record.position}
    with drawn(width=11.0, height=9.0) as drawing:
        rows = drawing.add_gridspec(3, 2, height_ratios=(2.0, 1.0, 1.0))
        for place, side in enumerate(PATHS_FROM):
            panel = drawing.add_subplot(rows[0, place])
            paint_paths(panel, flight.target, paths, [goal.position], eye_axes(*side), scenario=flight.scenario)
        for place, (words, (values, limit)) in enumerate(series.items()):
            panel = drawing.add_subplot(rows[1 + place // 2, place % 2])
            panel.plot(record.time, values, linewidth=0.9)
            if limit is not None:
                panel.axhline(limit, color="grey", linewidth=0.8)
            panel.set(xlabel="time, s", ylabel=words)
        drawing.suptitle(f"{name}: {flight.verdict.contact}")
        if path is not None:
            write_whole(Path(path), image(drawing, Path(path).suffix[1:].lower()), refusal=UsageError)
    return drawing


def flight_html(flight: Flight) -> str:
    """Show a flight in a notebook: the verdict, its path around the target, and the replay."""

    def paint(drawing: Figure) -> None:
        scenario, eye = flight.scenario, eye_axes(*PATHS_FROM[0])
        paths, goals = {scenario.name: flight.record.position}, [scenario.goal.position]
        paint_paths(drawing.add_subplot(), flight.target, paths, goals, eye, scenario=scenario)

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

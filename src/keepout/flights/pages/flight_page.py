"""One flight drawn: its page, with the replay beside it, and figures over time."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.ticker import NullLocator

from keepout.core.mission.flight import Flight
from keepout.core.progress import Progress, part_of, silent
from keepout.flights.pages.figures import COLOURS, figure
from keepout.flights.pages.mesh_pictures import draw_paths
from keepout.flights.pages.page import Markup, Page, bad, text
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import Layer, Replayed, of_flights
from keepout.flights.pages.terminal import FLIGHT_COLUMNS, broken_assumptions

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
        page.words(*map(bad, broken_assumptions([summary])))

    goal = flight.scenario.goal.position
    pictures: Pictures = {
        "paths": (lambda path: draw_paths(path, flight.target, {name: flight.record.position}, goal), ""),
        "clearance": (lambda path: draw_clearance(path, flight, name), ""),
        "error": (lambda path: draw_error(path, flight, name), ""),
        flight.scenario.name: (lambda path: draw_motion(path, flight, name), ""),
    }
    [replayed] = of_flights({name: flight})
    draw_page(out, replayed, pictures, tell, title=title, replay=title, heading="Figures")


def draw_page(
    out: Path,
    flight: Replayed,
    pictures: Pictures,
    tell: Callable[[Page], None],
    *,
    title: str,
    replay: str,
    heading: str = "Pictures",
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
        heading: over the pictures.
        progress: told how far it is.

    Returns:
        The paths of the pictures.

    """
    page = Page(out / "index.html", title)
    for place, (stem, (draw, _)) in enumerate(pictures.items()):
        progress(0.5 * place / len(pictures), f"picture {stem}")
        draw(out / f"{stem}.png")
    write_replay(out / "replay.html", [flight], title=replay, progress=part_of(progress, 0.5, 1.0))
    tell(page)
    page.heading("Replay")
    page.replay(out / "replay.html")
    page.heading(heading)
    for stem, (_, caption) in pictures.items():
        if caption:
            page.heading(caption, 3)
        page.picture(out / f"{stem}.png")
    page.write()
    return [str(out / f"{stem}.png") for stem in pictures]


class Told(NamedTuple):
    """What a page tells of a flight of several legs.

    Attributes:
        said: how it ended, in a sentence, plain text.
        rows: words for the entries of the summary that are told, in order; one that is None is left out.
        tell: adds what stands between that table and the replay to the page.

    """

    said: str
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
    drawn: dict[str, tuple[Callable[[Path], None], str]] = {
        stem: (lambda path, draw=draw: draw(path, result), words) for stem, (draw, words) in pictures.items()
    }
    drawn["motion"] = (lambda path: draw_motion(path, flight, name), "Velocity, force and disturbance over time.")

    def tell(page: Page) -> None:
        page.words(Markup(f"<b>{text(told.said)}</b>"), *map(bad, broken_assumptions([summary])))
        rows = {words: _cell(key, summary) for key, words in told.rows.items() if summary[key] is not None}
        page.table([{"": words, "value": value} for words, value in rows.items()], headings=False)
        told.tell(page)

    title, replay = f"{type(result).__name__} {name}", f"{name}: {result.outcome}"
    [replayed] = of_flights({name: flight}, layer)
    return draw_page(out, replayed, drawn, tell, title=title, replay=replay, progress=progress)


def _cell(key: str, summary: Mapping[str, Any]) -> Any:
    """Give an entry of a summary for a page: a coverage in per cent; a contact stands out."""
    value = summary[key]
    if key == "contact_verdict" and summary["contact"]:
        return bad(value)
    return f"{100.0 * value:.3f} %" if key.startswith("coverage") else value


def draw_clearance(path: Path, flight: Flight, name: str) -> None:
    """Draw the exact clearance of the chaser's ball and the law's own barrier value over time into one PNG."""
    with figure(path) as drawing:
        axes, time = drawing.add_subplot(), flight.record.time
        axes.plot(time, flight.clearance, label=f"{name}: exact clearance")
        axes.plot(time, flight.record.barrier, color=COLOURS[0], linewidth=0.8, linestyle="--", label=f"{name}: h")
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="time s", ylabel="m", title="Clearance on the exact mesh, and the barrier the law flies by")
        axes.legend(fontsize=8)


def draw_error(path: Path, flight: Flight, name: str) -> None:
    """Draw the distance to the goal over time into one PNG."""
    goal, record = flight.scenario.goal, flight.record
    with figure(path) as drawing:
        axes = drawing.add_subplot()
        axes.semilogy(record.time, np.linalg.norm(record.position - np.asarray(goal.position), axis=1), label=name)
        axes.axhline(goal.tolerance, color="grey", linewidth=0.8)
        # Formulas for powers of ten, and ticks between them, would take as long as all the rest of the figure.
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set(xlabel="time s", ylabel="‖r − goal‖ m", title="Distance to the goal, and the tolerance (grey)")
        axes.legend(fontsize=8)


def draw_motion(path: Path, flight: Flight, name: str) -> None:
    """Draw one flight's velocity, applied force and disturbance estimate, each by axis, into one PNG."""
    record, chaser = flight.record, flight.scenario.chaser
    with figure(path, width=8.0, height=8.0) as drawing:
        velocity, force, disturbance = drawing.subplots(3, 1, sharex=True)
        thin = {"linewidth": 0.7, "linestyle": "--"}
        for axis, (label, colour) in enumerate(zip("xyz", COLOURS)):
            velocity.plot(record.time, record.velocity[:, axis], color=colour, label=f"v {label}")
            velocity.plot(record.time, record.safe_velocity[:, axis], color=colour, **thin)
            force.plot(record.time, record.force[:, axis], color=colour, linewidth=0.8, label=f"F {label}")
            disturbance.plot(record.time, record.disturbance[:, axis], color=colour, linewidth=0.8, label=f"d {label}")
            disturbance.plot(record.time, record.disturbance_estimate[:, axis], color=colour, **thin)
        velocity.plot(record.time, np.linalg.norm(record.velocity, axis=1), color="black", linewidth=0.8, label="‖v‖")
        for axes, limit in ((velocity, chaser.speed_limit), (force, chaser.force_limit)):
            axes.axhline(limit, color="grey", linewidth=0.8)
            axes.axhline(-limit, color="grey", linewidth=0.8)
        velocity.set(ylabel="m/s", title=f"{name}: velocity, and safe velocity (dashed)")
        force.set(ylabel="N", title="applied force")
        disturbance.set(ylabel="N", xlabel="time s", title="disturbance, and its estimate (dashed)")
        for axes in (velocity, force, disturbance):
            axes.legend(fontsize=8, ncols=4, loc="upper right")

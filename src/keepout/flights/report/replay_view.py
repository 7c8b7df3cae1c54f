"""The replay of flights as a page, with figures for where no script runs: who prints it, or reads it without."""

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from keepout.core.progress import Progress, part_of, silent
from keepout.flights.replay.flights import Replayed
from keepout.flights.replay.page import write_page
from keepout.flights.replay.scene import rows_shown, scene
from keepout.flights.report.raster import View, eye_axes, rasterise
from keepout.flights.report.style import COLOURS, TARGET_COLOUR, style

_ELEVATION, _AZIMUTH = 22.0, -60.0
"""Of the eye, degrees."""
_COLUMNS = 800
_GREY = np.array([0.80, 0.83, 0.87])
_LAST = {False: "distance to the goal", True: "share of the surface that was seen"}
"""What the last curve is of: a flight that inspects has no goal."""


def write_replay(
    path: Path, flights: Sequence[Replayed], *, title: str, progress: Progress = silent
) -> dict[str, str | int | list[str]]:
    """Write a replay of flights around one target as one self-contained page.

    Args:
        path: the HTML file.
        flights: at least one.
        title: of the page.
        progress: told how far it is.

    Returns:
        The page's path, its bytes, and the flights' names.

    Raises:
        KeepoutError: flights around different targets, a field without the level to be drawn, or a place that cannot
            be written to.

    """
    shown = scene(flights, progress=part_of(progress, 0.0, 0.85))
    progress(0.85, "figures")
    figures = {
        "The target and the flights, seen from one side; a path behind the target is dotted.": _picture(flights),
        "Clearance on the exact mesh and, dashed, its proved lower bound over each step.": _curves(
            flights, "clearance"
        ),
        f"Speed, applied force and {_LAST[_inspects(flights)]}.": _curves(flights, "motion"),
    }
    told = [shown.told["target"]["remark"], *(_said(*pair) for pair in zip(flights, shown.told["flights"]))]
    words = [words for words in told if words]
    write_page(path, shown, title=title, words=words, figures=figures)
    progress(1.0, "")
    return {"replay": str(path), "bytes": path.stat().st_size, "flights": [flight.name for flight in flights]}


def _inspects(flights: Sequence[Replayed]) -> bool:
    return all(flight.coverage is not None for flight in flights)


def _said(flight: Replayed, told: Mapping[str, Any]) -> str:
    verdict, scenario = flight.verdict, flight.scenario
    start, goal = (", ".join(f"{x:g}" for x in at) for at in (flight.shown.position[0], scenario.goal.position))
    way = f"from [{start}] m to [{goal}] m" if flight.coverage is None else f"from [{start}] m, to look at all of it,"
    words = f"{flight.name}: {way} around {flight.target.name}. Contact: {verdict.contact}"
    if np.isfinite(verdict.minimum_clearance):
        words += f"; the clearance is at least {verdict.minimum_clearance:.4g} m at every instant"
    return " ".join([". ".join([words, *verdict.remarks]) + ".", told["remark"]]).strip()


def _picture(flights: Sequence[Replayed]) -> str:
    """Draw the mesh with the paths around it; what lies behind the mesh is dotted."""
    target = flights[0].target
    # Nadir is down where the target is fixed to VVLH, as in the replay.
    upright = np.diag([1.0, -1.0, -1.0]) if flights[0].scenario.attitude.kind == "vvlh" else np.eye(3)
    vertices = target.vertices @ upright
    axes = eye_axes(_ELEVATION, _AZIMUTH)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))  # where `rasterise` looks
    with style():
        drawing = plt.figure(figsize=(8.0, 5.0), layout="constrained")
        panel = drawing.add_subplot()
        view, depth = None, None
        if target.ball_radius > 0.0:
            seen = (vertices - middle) @ axes.T
            panel.scatter(seen[:, 0], seen[:, 1], s=1.0, color=TARGET_COLOUR)
        else:
            view = rasterise(vertices, target.faces, elevation=_ELEVATION, azimuth=_AZIMUTH, columns=_COLUMNS)
            picture = np.concatenate([_GREY * view.light[..., None], view.hit[..., None].astype(float)], axis=2)
            panel.imshow(picture, origin="lower", extent=view.extent)
            depth = ((vertices[target.faces].mean(axis=1) - middle) @ axes.T)[:, 2]
        for colour, flight in zip(_palette(len(flights)), flights):
            path = (flight.shown.position[rows_shown(len(flight.shown.time))] @ upright - middle) @ axes.T
            hidden = np.zeros(len(path), bool) if view is None or depth is None else _behind(path, view, depth)
            panel.plot(path[:, 0], path[:, 1], color=colour, linewidth=0.8, linestyle=":")
            open_path = np.where(hidden[:, None], np.nan, path)
            panel.plot(open_path[:, 0], open_path[:, 1], color=colour, linewidth=1.6, label=flight.name)
            panel.plot(*path[:1, :2].T, color=colour, marker="o", markersize=4)
            if flight.coverage is None:
                goal = (np.asarray(flight.scenario.goal.position) @ upright - middle) @ axes.T
                panel.plot(*goal[:2], color="black", marker="*", markersize=9)
        panel.set(xlabel="m", ylabel="m", aspect="equal")
        panel.autoscale()
        panel.margins(0.03)
        if len(flights) <= 12:
            panel.legend(fontsize=8)
        return _png(drawing, "target and paths")


def _behind(path: np.ndarray, view: View, depth: np.ndarray) -> np.ndarray:
    """Say of points in the eye's axes whether the mesh hides them."""
    left, right, bottom, top = view.extent
    rows, columns = view.hit.shape
    column = np.floor((path[:, 0] - left) / (right - left) * columns).astype(int)
    row = np.floor((path[:, 1] - bottom) / (top - bottom) * rows).astype(int)
    within = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    column, row = np.where(within, column, 0), np.where(within, row, 0)
    return within & view.hit[row, column] & (depth[view.face[row, column]] > path[:, 2])


def _curves(flights: Sequence[Replayed], kind: str) -> str:
    with style():
        count = 1 if kind == "clearance" else 3
        drawing = plt.figure(figsize=(8.0, 2.6 if count == 1 else 4.6), layout="constrained")
        panels = drawing.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
        for colour, flight in zip(_palette(len(flights)), flights):
            record = flight.shown
            time = record.time - record.time[0]
            thin = {"color": colour, "linewidth": 0.9, "label": flight.name}
            if kind == "clearance":
                distance = flight.target.distance.distance(record.position)
                panels[0].plot(time, distance - flight.scenario.chaser.radius, **thin)
                panels[0].step(
                    time[:-1], flight.proved, where="post", color=colour, linewidth=0.7, linestyle="--", alpha=0.7
                )
                continue
            error = np.linalg.norm(record.position - np.asarray(flight.scenario.goal.position), axis=1)
            panels[0].plot(time, np.linalg.norm(record.velocity, axis=1), **thin)
            panels[1].plot(time, np.linalg.norm(record.force, axis=1), **thin)
            if flight.coverage is None:
                panels[2].semilogy(time, error, **thin)
            else:
                panels[2].step(time, 100.0 * flight.coverage.share_at(record.time), where="post", **thin)
        last = "seen, %" if _inspects(flights) else "to the goal, m"
        labels = ["clearance, m"] if kind == "clearance" else ["speed, m/s", "force, N", last]
        for panel, label in zip(panels, labels):
            panel.set_ylabel(label)
        if kind == "clearance":
            panels[0].axhline(0.0, color="black", linewidth=0.8)
        panels[-1].set_xlabel("time, s")
        if 1 < len(flights) <= 12:
            panels[0].legend(fontsize=8)
        return _png(drawing, kind)


def _palette(count: int) -> list[str]:
    return [COLOURS[place % len(COLOURS)] for place in range(count)]


def _png(drawing: Figure, words: str) -> str:
    image = io.BytesIO()
    drawing.savefig(image, format="png", dpi=100)
    plt.close(drawing)
    return f'<img alt="{words}" src="data:image/png;base64,{base64.b64encode(image.getvalue()).decode("ascii")}">'

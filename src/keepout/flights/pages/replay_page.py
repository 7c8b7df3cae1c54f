"""The replay of flights as a page: the scene, the viewer that comes with the package, and figures for print."""

import html
import json
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.pages.approach_drawn import paint_legs, paint_rules
from keepout.flights.pages.figures import draw_signal, logarithmic, looks, picture
from keepout.flights.pages.mesh_pictures import PATHS_FROM, eye_axes, paint_paths
from keepout.flights.pages.page import Provenance, at_least, bracketed, foot
from keepout.flights.pages.replayed import Replayed
from keepout.flights.pages.scene import rows_shown, scene

_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the page may fetch: nothing."""


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
    last = f"distance to the {_aim(flights)}" if _have_goals(flights) else "share of the surface that was seen"
    seen = "The target and the flights, seen from one side; a path behind the target is dotted."
    clear = "Clearance on the exact mesh, shaded down to its proved lower bound over each step."
    # Where no script runs, and in print.
    pictures = _shown(seen, "target and paths", flights, _picture, 5.0)
    pictures += _shown(clear, "clearance", flights, paint_clearance, 2.6)
    pictures += _shown(f"Speed, applied force and {last}.", "motion", flights, _motion, 4.6, rows=3)
    said = [shown.told["target"]["remark"], *(_said(*pair) for pair in zip(flights, shown.told["flights"]))]
    paragraphs = "".join(f"<p>{html.escape(words)}</p>" for words in said if words)
    told = json.dumps(shown.told | {"title": title}, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    libraries = json.loads(viewer("manifest.json"))["libraries"]
    licences = ", ".join(f"{entry['name']} {entry['version']} ({entry['licence']})" for entry in libraries)
    write_whole(
        path,
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{viewer('replay.css')}</style>"
        "<noscript><style>#replay{display:none}#figures{display:block!important}</style></noscript></head><body>"
        '<main id="replay"></main>'
        f'<section id="figures"><h1>{html.escape(title)}</h1>{paragraphs}{pictures}'
        f"<p>Made by Keepout; the viewer holds {html.escape(licences)}.</p>{foot(Provenance.of(flights))}</section>"
        f'<script type="application/json" id="scene">{told}</script>'
        f'<script type="text/plain" id="content">{shown.content}</script>'
        f"<script>{viewer('replay.js')}</script></body></html>\n",
    )
    progress(1.0, "")
    return {"replay": str(path), "bytes": path.stat().st_size, "flights": [flight.name for flight in flights]}


def _said(flight: Replayed, told: Mapping[str, Any]) -> str:
    verdict, scenario = flight.verdict, flight.scenario
    goal = ", to look at all of it," if flight.share is not None else f" to {bracketed(scenario.goal.position)} m"
    way = f"from {bracketed(flight.shown.position[0])} m{goal}"
    words = f"{flight.name}: {way} around {flight.target.name}. Contact: {verdict.contact}"
    if np.isfinite(verdict.minimum_clearance):
        words += f"; {at_least(verdict.minimum_clearance)} at every instant"
    return " ".join([". ".join([words, *verdict.remarks]) + ".", told["remark"]]).strip()


def _picture(panel: Axes, flights: Sequence[Replayed]) -> None:
    """Draw the mesh with the paths around it; what lies behind the mesh is dotted."""
    # Nadir is down where the target is fixed to VVLH, as in the replay.
    upright = np.diag([1.0, -1.0, -1.0]) if flights[0].scenario.attitude.kind == "vvlh" else np.eye(3)
    paths = {flight.name: flight.shown.position[rows_shown(len(flight.shown.time))] for flight in flights}
    goals = {flight.scenario.goal.position for flight in flights if flight.share is None}
    first, eye = flights[0], eye_axes(*PATHS_FROM[0]) @ upright
    paint_paths(panel, first.target, paths, goals, eye, scenario=first.scenario)


def paint_clearance(panel: Axes, flights: Sequence[Replayed]) -> None:
    """Show the clearance on the exact mesh in a panel, shaded down to its proved lower bound over each step."""
    for look, flight in zip(looks(len(flights)), flights):
        time = flight.shown.time - flight.shown.time[0]
        panel.plot(time, flight.clearance, linewidth=0.9, label=flight.name, **look)
        bound = np.append(flight.proved, np.nan)
        band = {"color": look["color"], "alpha": 0.3, "linewidth": 0.0, "step": "post"}
        panel.fill_between(time, bound, flight.clearance, where=np.isfinite(bound), **band)
    panel.axhline(0.0, color="black", linewidth=0.8)
    panel.set(xlabel="time, s", ylabel="clearance, m")


def _motion(panels: np.ndarray, flights: Sequence[Replayed]) -> None:
    speed, force, last = panels
    for look, flight in zip(looks(len(flights)), flights):
        record, drawn = flight.shown, {"label": flight.name, **look}
        time = record.time - record.time[0]
        draw_signal(speed, time, np.linalg.norm(record.velocity, axis=1), **drawn)
        draw_signal(force, time, np.linalg.norm(record.force, axis=1), **drawn)
        if flight.share is None:
            last.plot(time, flight.error, linewidth=0.9, **drawn)
        else:
            last.step(time, 100.0 * flight.share, where="post", linewidth=0.9, **drawn)
    if len(flights) == 1:
        [flight] = flights
        time = flight.shown.time - flight.shown.time[0]
        paint_rules(speed, time, flight.scenario, flight.shown, flight.clearance)
        paint_legs(last, time, flight.scenario, flight.shown)
    speed.set_ylabel("speed, m/s")
    force.set_ylabel("force, N")
    if _have_goals(flights):
        logarithmic(last)
    last.set(xlabel="time, s", ylabel=f"to the {_aim(flights)}, m" if _have_goals(flights) else "seen, %")


def _aim(flights: Sequence[Replayed]) -> str:
    """Say what the distance is to."""
    return "leg's place" if any(flight.shown.leg is not None for flight in flights) else "goal"


def _have_goals(flights: Sequence[Replayed]) -> bool:
    return any(flight.share is None for flight in flights)


def _shown(
    caption: str, words: str, flights: Sequence[Replayed], draw: Callable[..., None], height: float, rows: int = 1
) -> str:
    """Draw flights into panels below each other, with their names, and give picture and caption as an element."""

    def paint(drawing: Figure) -> None:
        panels = drawing.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
        draw(panels if rows > 1 else panels[0], flights)
        drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)

    element = picture(paint, words, height=height)
    return f"<figure>{element}<figcaption>{html.escape(caption)}</figcaption></figure>"


def viewer(name: str) -> str:
    """Give a file of the bundled viewer: `replay.js`, `replay.css`, `manifest.json` or `LICENCES.txt`."""
    return (resources.files("keepout") / "data" / "replay" / name).read_text(encoding="utf-8")

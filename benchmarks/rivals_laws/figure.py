"""The paths of all rivals between one start and one goal, over the mesh: `benchmarks/rivals.py --figure`."""

import io
import sys
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from keepout.core.errors import KeepoutError
from keepout.core.kept import digest
from keepout.core.whole_file import write_whole
from keepout.flights.pages.figures import COLOURS, TARGET_COLOUR, figure
from rivals_laws.flying import path
from rivals_laws.rival import Rival
from rivals_laws.rival_case import RivalCase
from rivals_laws.rows import planned

FLIGHTS = {
    # Target: start and goal, m, and the view: elevation and azimuth, degrees.
    "pocket": ((-6.0, 0.5, -1.0), (0.5, 0.0, 0.5), (28.0, 55.0)),
    "intelsat30": ((7.0, 0.0, 6.0), (7.0, 0.0, -6.0), (18.0, -62.0)),
}
"""Into the pocket, where envelopes refuse the goal; and across a wing, which the straight way meets."""
STYLES = [("#000000", "-", "o", 3.0)]
"""Colour, line, mark at the end and width: the first rival's, drawn broad beneath the others."""
STYLES += [(colour, line, mark, 1.3) for line, mark in (("-", "o"), ("--", "^"), (":", "D")) for colour in COLOURS[:-1]]


def draw(rivals: list[Rival], fields: Path, seed: int) -> None:
    """Fly every rival alone and write `docs/figures/rivals-paths.png`."""
    folder = Path(__file__).resolve().parents[2] / "docs" / "figures"
    absent = {rival.name: [] for rival in rivals}
    with figure(folder / "rivals-paths.png", width=7.2, height=4.8) as drawing:
        for place, (target, (start, goal, view)) in enumerate(FLIGHTS.items()):
            axes = drawing.add_subplot(1, 2, place + 1, projection="3d")
            case = RivalCase(target, fields, 128, seed)
            _frame(axes, case, np.array(start), np.array(goal))
            axes.view_init(*view)
            for rival, look in zip(rivals, STYLES):
                said = _draw_path(axes, case, rival, look, np.array(start), np.array(goal))
                sys.stderr.write(f"{target}, {rival.name}: {said}\n")
                if said.startswith(("refused", "missing")):
                    absent[rival.name].append(f"{target}: {said.split(maxsplit=1)[0].rstrip(':')}")
        drawing.legend(handles=_legend(absent), loc="outside lower center", ncols=2, fontsize=7.5)


def _legend(absent: dict[str, list[str]]) -> list[Line2D]:
    """Give a line for each rival, with the targets where it has no path, and what the marks mean."""
    handles = []
    for (name, where), (colour, line, mark, width) in zip(absent.items(), STYLES):
        label = f"{name} ({', '.join(where)})" if where else name
        look = {"color": colour, "linestyle": line, "linewidth": width, "marker": mark, "markersize": 4}
        handles.append(Line2D([], [], label=label, **look))
    for label, mark in (("start", "s"), ("goal", "*"), ("contact", "x")):
        handles.append(Line2D([], [], color="black", marker=mark, linestyle="", markersize=6, label=label))
    return handles


def _frame(axes, case: RivalCase, start: np.ndarray, goal: np.ndarray) -> None:
    """Draw mesh, start and goal, with equal scales on all axes."""
    axes.computed_zorder = False  # paths over the mesh, whichever is nearer
    triangles = case.target.vertices[case.target.faces]
    axes.add_collection3d(Poly3DCollection(triangles, facecolor=TARGET_COLOUR, alpha=0.22, linewidth=0, zorder=0))
    axes.plot(*start, marker="s", color="black", markersize=4, zorder=5)
    axes.plot(*goal, marker="*", color="black", markersize=10, zorder=1)
    lower = np.minimum(case.target.vertices.min(axis=0), np.minimum(start, goal)) - 1.5
    upper = np.maximum(case.target.vertices.max(axis=0), np.maximum(start, goal)) + 1.5
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]), title=case.name)
    for letter, axis in zip("xyz", (axes.xaxis, axes.yaxis, axes.zaxis)):
        axis.set_major_locator(MaxNLocator(4))
        axis.set_label_text(f"{letter} (m)")
        axis.labelpad = -4
    axes.set_box_aspect(upper - lower, zoom=0.86)
    axes.tick_params(labelsize=7, pad=-1)


def _draw_path(axes, case: RivalCase, rival: Rival, look, start: np.ndarray, goal: np.ndarray) -> str:
    """Draw one path, its end, and where it touches; say what became of it."""
    colour, line, mark, width = look
    try:
        flown = _kept_path(case, rival, start, goal)
    except KeepoutError as refusal:
        return f"refused: {refusal}"
    if flown is None:
        return f"missing: {rival.missing}"
    clearance = case.target.distance.distance(flown) - case.scenario.chaser.radius
    worst, error = int(clearance.argmin()), np.linalg.norm(flown[-1] - goal)
    axes.plot(*flown.T, color=colour, linestyle=line, linewidth=width, zorder=2)
    axes.plot(*flown[-1], color=colour, marker=mark, markersize=4, zorder=4)
    if clearance[worst] <= 0.0:
        axes.plot(*flown[worst], marker="x", color=colour, markersize=7, markeredgewidth=1.6, zorder=5)
    return f"least clearance {clearance[worst]:.2f} m, {error:.2f} m from the goal at the end"


def _kept_path(case: RivalCase, rival: Rival, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    """Fly one pair, or give the path flown before with the same settings; None where a package is missing."""
    mark = planned(case, rival, False, 1)["digest"]
    file = case.folder / f"path-{case.name}-{mark}-{digest(start, goal)[:8]}.npy"
    if file.exists():
        return np.load(file)
    if rival.missing:
        return None
    made, flown = io.BytesIO(), path(case, rival, start, goal, guarded=False)
    np.save(made, flown)
    write_whole(file, made.getvalue())
    return flown

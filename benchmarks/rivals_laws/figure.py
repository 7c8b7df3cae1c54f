"""The paths of all rivals between one start and one goal, over the mesh: `benchmarks/rivals.py --figure`."""

import io
import sys
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from keepout.digest import digest
from keepout.errors import KeepoutError
from keepout.report.style import COLOURS, TARGET_COLOUR, figure
from keepout.whole_file import write_whole
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
    """Fly every rival alone and write `docs/figures/rivals-paths.png` and `.svg`."""
    folder = Path(__file__).resolve().parents[2] / "docs" / "figures"
    with figure(folder / "rivals-paths.png", width=7.2, height=4.8) as drawing:
        handles = []
        for place, (target, (start, goal, view)) in enumerate(FLIGHTS.items()):
            axes = drawing.add_subplot(1, 2, place + 1, projection="3d")
            case = RivalCase(target, fields, 128, seed)
            handles = _panel(axes, case, rivals, np.array(start), np.array(goal))
            axes.view_init(*view)
            axes.set_title(target)
        drawing.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=7.5)
        image = io.BytesIO()
        drawing.savefig(image, format="svg")
        write_whole(folder / "rivals-paths.svg", image.getvalue())


def _kept_path(case: RivalCase, rival: Rival, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Fly one pair, or give the path flown before with the same settings: kept beside the fields."""
    mark = planned(case, rival, False, 1)["digest"]
    file = case.folder / f"path-{case.name}-{mark}-{digest(start, goal)[:8]}.npy"
    if not file.exists():
        made = io.BytesIO()
        np.save(made, path(case, rival, start, goal, guarded=False))
        write_whole(file, made.getvalue())
    return np.load(file)


def _panel(axes, case: RivalCase, rivals: list[Rival], start: np.ndarray, goal: np.ndarray) -> list[Line2D]:
    """Draw one target with every path, and give the legend's lines."""
    triangles = case.target.vertices[case.target.faces]
    solid = Poly3DCollection(triangles, facecolor=TARGET_COLOUR, alpha=0.22, linewidth=0, zorder=0)
    axes.add_collection3d(solid)
    handles = []
    axes.computed_zorder = False  # paths over the mesh, whichever is nearer
    for (colour, line, mark, width), rival in zip(STYLES, rivals):
        look = {"color": colour, "linestyle": line, "linewidth": width}
        handles.append(Line2D([], [], marker=mark, markersize=4, label=rival.name, **look))
        said = rival.missing
        if said is None:
            try:
                flown = _kept_path(case, rival, start, goal)
                clearance = case.target.distance.distance(flown) - case.scenario.chaser.radius
                axes.plot(*flown.T, zorder=2, **look)
                axes.plot(*flown[-1], color=colour, marker=mark, markersize=4, zorder=4)
                worst = int(clearance.argmin())
                if clearance[worst] <= 0.0:
                    axes.plot(*flown[worst], marker="x", color=colour, markersize=7, markeredgewidth=1.6, zorder=5)
                error = np.linalg.norm(flown[-1] - goal)
                said = f"least clearance {clearance[worst]:.2f} m, {error:.2f} m from the goal at the end"
            except KeepoutError as refusal:
                said = f"refused: {refusal}"
        sys.stderr.write(f"{case.name}, {rival.name}: {said}\n")
    axes.plot(*start, marker="s", color="black", markersize=4, zorder=5)
    axes.plot(*goal, marker="*", color="black", markersize=10, zorder=1)
    handles.append(Line2D([], [], color="black", marker="s", linestyle="", markersize=4, label="start"))
    handles.append(Line2D([], [], color="black", marker="*", linestyle="", markersize=8, label="goal"))
    handles.append(Line2D([], [], color="black", marker="x", linestyle="", markersize=6, label="contact"))
    lower = np.minimum(case.target.vertices.min(axis=0), np.minimum(start, goal)) - 1.5
    upper = np.maximum(case.target.vertices.max(axis=0), np.maximum(start, goal)) + 1.5
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.set_box_aspect(upper - lower, zoom=1.12)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    axes.tick_params(labelsize=7, pad=0)
    return handles

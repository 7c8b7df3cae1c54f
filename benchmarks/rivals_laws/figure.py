"""The paths of all rivals between one start and one goal, over the mesh: `benchmarks/rivals.py --figure`."""

import io
import itertools
import sys
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from keepout.errors import KeepoutError
from keepout.report.style import COLOURS, TARGET_COLOUR, figure
from keepout.whole_file import write_whole
from rivals_laws.flying import path
from rivals_laws.rival import Rival
from rivals_laws.rival_case import RivalCase

FLIGHTS = {
    # Target: start and goal, m, and the view: elevation and azimuth, degrees.
    "pocket": ((-6.0, 0.5, -1.0), (0.5, 0.0, 0.5), (24.0, -62.0)),
    "intelsat30": ((7.0, 0.0, 6.0), (7.0, 0.0, -6.0), (22.0, -58.0)),
}
"""Into the pocket, where envelopes refuse the goal; and across a wing, which the straight way meets."""
STYLES = [(colour, line) for line, colour in itertools.product(("-", "--", ":"), COLOURS)]


def draw(rivals: list[Rival], fields: Path, seed: int) -> None:
    """Fly every rival alone and write `docs/figures/rivals-paths.png` and `.svg`."""
    folder = Path(__file__).resolve().parents[2] / "docs" / "figures"
    with figure(folder / "rivals-paths.png", width=7.2, height=5.2) as drawing:
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


def _panel(axes, case: RivalCase, rivals: list[Rival], start: np.ndarray, goal: np.ndarray) -> list[Line2D]:
    """Draw one target with every path, and give the legend's lines."""
    solid = Poly3DCollection(case.target.vertices[case.target.faces], facecolor=TARGET_COLOUR, alpha=0.35, linewidth=0)
    axes.add_collection3d(solid)
    handles = []
    for (colour, line), rival in zip(STYLES, rivals):
        handles.append(Line2D([], [], color=colour, linestyle=line, linewidth=1.4, label=rival.name))
        said = rival.missing
        if said is None:
            try:
                flown = path(case, rival, start, goal, guarded=False)
                clearance = case.target.distance.distance(flown) - case.scenario.chaser.radius
                axes.plot(*flown.T, color=colour, linestyle=line, linewidth=1.4)
                worst = int(clearance.argmin())
                if clearance[worst] <= 0.0:
                    axes.plot(*flown[worst], marker="x", color=colour, markersize=7, markeredgewidth=1.6)
                error = np.linalg.norm(flown[-1] - goal)
                said = f"least clearance {clearance[worst]:.2f} m, {error:.2f} m from the goal at the end"
            except KeepoutError as refusal:
                said = f"refused: {refusal}"
        sys.stderr.write(f"{case.name}, {rival.name}: {said}\n")
    axes.plot(*start, marker="s", color="black", markersize=4)
    axes.plot(*goal, marker="*", color="black", markersize=8)
    handles.append(Line2D([], [], color="black", marker="s", linestyle="", markersize=4, label="start"))
    handles.append(Line2D([], [], color="black", marker="*", linestyle="", markersize=8, label="goal"))
    handles.append(Line2D([], [], color="black", marker="x", linestyle="", markersize=6, label="contact"))
    lower = np.minimum(case.target.vertices.min(axis=0), np.minimum(start, goal)) - 1.5
    upper = np.maximum(case.target.vertices.max(axis=0), np.maximum(start, goal)) + 1.5
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    axes.set_box_aspect(upper - lower)
    return handles

"""Pictures of a target's mesh: shaded views, alone or with paths around it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from keepout.flights.report.style import COLOURS, TARGET_COLOUR, figure

FOUR_VIEWS = {
    "front": (0.0, 0.0, "x"),
    "side": (0.0, -90.0, "y"),
    "top": (90.0, -90.0, "z"),
    "oblique": (25.0, -55.0, None),
}
"""Elevation and azimuth in degrees, and the axis that is looked along, if it is one."""

_LIGHT = np.array([0.35, -0.6, 0.72])


def draw_target(
    path: Path, name: str, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> None:
    """Draw four shaded views of a mesh (body frame, m) into one PNG."""
    with figure(path, width=11.0, height=8.0) as drawing:
        for place, (view, (elevation, azimuth, depth)) in enumerate(FOUR_VIEWS.items(), start=1):
            axes = drawing.add_subplot(2, 2, place, projection="3d")
            assert isinstance(axes, Axes3D)
            _shade(axes, vertices, faces)
            _frame(axes, [vertices], zoom=1.0 if depth is None else 1.2)
            axes.set_proj_type("persp" if depth is None else "ortho")
            if depth is not None:
                axes.set(**{f"{depth}ticks": [], f"{depth}label": ""})
            axes.view_init(elevation, azimuth)
            axes.set_title(f"{name}, {view}")


def draw_paths(
    path: Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    paths: Mapping[str, Float[np.ndarray, "samples 3"]],
    goal: Sequence[float],
) -> None:
    """Draw flown paths (body frame, m) around the target from two sides into one PNG."""
    with figure(path, width=11.0, height=5.2) as drawing:
        for place, (elevation, azimuth) in enumerate(((22.0, -60.0), (12.0, 8.0)), start=1):
            axes = drawing.add_subplot(1, 2, place, projection="3d")
            assert isinstance(axes, Axes3D)
            _shade(axes, vertices, faces, alpha=0.9)
            for colour, (label, positions) in zip(COLOURS, paths.items()):
                axes.plot(*positions.T, color=colour, linewidth=1.6, label=label, zorder=10)
                axes.plot(*positions[-1:].T, color=colour, marker="o", markersize=4, zorder=11)
            axes.plot(
                *np.reshape(goal, (3, 1)),
                color="black",
                marker="*",
                markersize=9,
                linestyle="",
                label="goal",
                zorder=12,
            )
            _frame(axes, [vertices, *paths.values(), np.asarray([goal])], zoom=0.85)
            axes.view_init(elevation, azimuth)
            if place == 1:
                axes.legend(loc="upper left")


def draw_path_panels(
    path: Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    panels: Mapping[str, Mapping[str, Float[np.ndarray, "samples 3"]]],
    goal: Sequence[float],
    *,
    view: tuple[float, float] = (22.0, -60.0),
) -> None:
    """Draw flown paths (body frame, m) around the target side by side, a panel each set, into a PNG and an SVG.

    Args:
        path: the PNG file.
        vertices: of the target.
        faces: of the target.
        panels: by title, the paths by name.
        goal: m.
        view: elevation and azimuth, degrees.

    """
    everything = {name: positions for paths in panels.values() for name, positions in paths.items()}
    style = {name: (COLOURS[k], ("-", "--", "-.")[k % 3]) for k, name in enumerate(everything)}
    with figure(path, width=7.0, height=2.9, vector=True) as drawing:
        drawing.set_layout_engine("none")  # one would make room for lines where they leave the box they are drawn in
        for place, (title, paths) in enumerate(panels.items()):
            axes = drawing.add_axes((place / len(panels), 0.0, 0.93 / len(panels), 0.93), projection="3d")
            assert isinstance(axes, Axes3D)
            _shade(axes, vertices, faces, alpha=0.85)
            for name, positions in paths.items():
                colour, line = style[name]
                axes.plot(
                    *positions.T, color=colour, linestyle=line, linewidth=1.4, label=name, zorder=10, clip_on=False
                )
                for end, mark in ((positions[:1], "s"), (positions[-1:], "o")):
                    axes.plot(*end.T, color=colour, marker=mark, markersize=4.5, zorder=11, clip_on=False)
            mark = {"color": "black", "marker": "*", "markersize": 8, "linestyle": "", "zorder": 12, "clip_on": False}
            axes.plot(*np.reshape(goal, (3, 1)), label="goal", **mark)
            _frame(axes, [vertices, *everything.values(), np.asarray([goal])], zoom=1.08)
            axes.view_init(*view)
            axes.tick_params(labelsize=7, pad=-3)
            for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
                axis.labelpad = -6 if axis is not axes.zaxis else -10
                axis.label.set_fontsize(8)
            axes.set_title(title, fontsize=9)
            if len(paths) > 1:
                axes.legend(loc="upper left", fontsize=7.5)


def _shade(axes: Axes3D, vertices: np.ndarray, faces: np.ndarray, alpha: float = 1.0) -> None:
    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)
    # Real meshes have flipped faces, so both sides of a triangle catch the light.
    light = 0.35 + 0.65 * np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT)))
    base = np.array([int(TARGET_COLOUR[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    colours = np.column_stack([light[:, None] * base, np.full(len(faces), alpha)])
    shaded = Poly3DCollection(list(triangles), facecolors=colours, edgecolors="none")
    shaded.set_rasterized(True)  # thousands of triangles would make a vector file unreadable
    shaded.set_clip_on(False)  # a zoomed target may reach beyond its subplot's rectangle
    axes.add_collection3d(shaded)


def _frame(axes: Axes3D, clouds: Sequence[np.ndarray], zoom: float = 1.0) -> None:
    points = np.concatenate(clouds)
    lower, upper = points.min(axis=0), points.max(axis=0)
    axes.set(xlabel="x m", ylabel="y m", zlabel="z m")
    axes.set_xlim(lower[0], upper[0])
    axes.set_ylim(lower[1], upper[1])
    axes.set_zlim(lower[2], upper[2])
    # A short axis has room for few numbers.
    share = (upper - lower) / max(float((upper - lower).max()), 1e-9)
    for axis, part in zip((axes.xaxis, axes.yaxis, axes.zaxis), share, strict=True):
        axis.set_major_locator(MaxNLocator(max(2, round(7 * part))))
    # Matplotlib infers an int from its default of 1, but any positive zoom is meant.
    axes.set_box_aspect(tuple(np.maximum(upper - lower, 1e-3)), zoom=zoom)  # pyright: ignore[reportArgumentType]

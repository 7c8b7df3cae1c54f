"""Shaded pictures of triangle meshes with a depth buffer: targets, paths around them, and fields beside them.

Matplotlib sorts triangles by their middles, which fails on large ones.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from keepout.core.cores import kernel
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.flights.pages.approach_drawn import paint_bodies
from keepout.flights.pages.figures import COLOURS, TARGET_COLOUR, figure, looks

if TYPE_CHECKING:  # which takes long to import
    from keepout.flights.surface import Surface

GREY = np.array([0.82, 0.85, 0.9])
"""Of a mesh without colours of its own."""
READABLE = 0.6
"""Share of the light that every place gets where colours are read: they must not turn dark."""
_LIGHT = np.array([-0.35, 0.45, 0.82])
"""Direction to the light in the eye's axes: right, up, towards the eye."""
_FOUR_SIDES = {"front": (0.0, 0.0), "side": (0.0, -90.0), "top": (90.0, -90.0), "oblique": (25.0, -55.0)}
"""Elevation and azimuth of the eye, degrees."""
PATHS_FROM = ((22.0, -60.0), (12.0, 8.0))
"""From where paths around a target are looked at, elevation and azimuth, degrees."""
_SURFACE_FROM = {"above": (28.0, -55.0), "below": (-28.0, 125.0)}
_NODES = 400
"""Along a slice's longer side."""
_AXES_COLOUR = COLOURS[1]
_PLANES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
"""Horizontal axis, vertical axis, and the axis that the slice is across."""


class View(NamedTuple):
    """What an eye at infinity sees of a mesh, row 0 at the bottom.

    Attributes:
        axes: of the eye as rows: right, up, towards the eye.
        face: the triangle that is seen; 0 where none is.
        depth: how near to the eye it is, m in the eye's axes; -inf: nothing is there.
        light: 0 to 1.
        extent: left, right, bottom, top of the picture in the eye's axes, m from the body's origin.

    """

    axes: Float[np.ndarray, "3 3"]
    face: Int[np.ndarray, "rows columns"]
    depth: Float[np.ndarray, "rows columns"]
    light: Float[np.ndarray, "rows columns"]
    extent: tuple[float, float, float, float]

    @property
    def hit(self) -> Bool[np.ndarray, "rows columns"]:
        """Whether a triangle is seen there."""
        return np.isfinite(self.depth)

    @property
    def shape(self) -> float:
        """Height over width."""
        return self.depth.shape[0] / self.depth.shape[1]

    def places(self) -> Float[np.ndarray, "hits 3"]:
        """Give the places on the mesh that the pixels with something in them show, body frame, m."""
        rows, columns = np.nonzero(self.hit)
        left, right, bottom, top = self.extent
        x = left + (columns + 0.5) * (right - left) / self.depth.shape[1]
        y = bottom + (rows + 0.5) * (top - bottom) / self.depth.shape[0]
        return np.column_stack([x, y, self.depth[rows, columns]]) @ self.axes

    def hides(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Say of points in the body frame (m) whether the mesh is between them and the eye."""
        left, right, bottom, top = self.extent
        x, y, depth = self.axes @ points.T
        rows, columns = self.depth.shape
        column = np.floor((x - left) / (right - left) * columns)
        row = np.floor((y - bottom) / (top - bottom) * rows)
        within = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        row, column = (np.where(within, place, 0).astype(int) for place in (row, column))
        return within & (self.depth[row, column] > depth)

    def paint(self, axes: Axes, colours: Any = GREY, *, least: float = 0.0, **look: Any) -> None:
        """Show it in a panel, with what is not hit left clear.

        Args:
            axes: the panel.
            colours: 0 to 1, one for all or one a pixel.
            least: share of the light that every place gets.
            **look: passed on to Matplotlib.

        """
        shaded = colours * (least + (1.0 - least) * self.light[..., None])
        axes.imshow(np.dstack([shaded, self.hit]), origin="lower", extent=self.extent, **look)
        axes.set(xlabel="m", ylabel="m", aspect="equal")
        axes.grid(visible=False)


def eye_axes(elevation: float, azimuth: float) -> Float[np.ndarray, "3 3"]:
    """Rows to the right, up, and towards an eye that looks from this elevation and azimuth, degrees."""
    e, a = np.radians([elevation, azimuth])
    eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(eye, right), eye])


def rasterise(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    axes: Float[np.ndarray, "3 3"],
    *,
    columns: int = 1200,
) -> View:
    """Draw a mesh (body frame, m) orthographically; the eye's axes are rows, as `eye_axes` gives them."""
    seen = vertices @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = 0.03 * float((high - low)[:2].max())
    step = (float(high[0] - low[0]) + 2.0 * room) / columns
    rows = int(np.ceil((float(high[1] - low[1]) + 2.0 * room) / step))
    corners = seen[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)  # real meshes have flipped faces; both sides catch the light
    light = np.clip(0.4 + 0.6 * normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.3, 1.0)
    pixels = corners.copy()
    pixels[..., :2] = (corners[..., :2] - low[:2] + room) / step - 0.5
    face, depth = np.zeros((rows, columns), np.int64), np.full((rows, columns), -np.inf)
    _paint_all(pixels, face, depth)
    extent = (float(low[0] - room), float(high[0] + room), float(low[1] - room), float(low[1] - room + rows * step))
    return View(axes, face, depth, np.where(np.isfinite(depth), light[face], 1.0), extent)


@kernel(error_model="numpy")
def fill_triangle(a, b, c, f, face, nearness):
    """Write `f` into `face` where a triangle is the nearest at a pixel's middle, and how near into `nearness`.

    Corners are column, row, and a number that is linear in the picture and larger where it is nearer.
    """
    rows, columns = face.shape
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area == 0.0:
        return
    first_row = max(0, int(np.ceil(max(min(a[1], b[1], c[1]), -1.0))))
    last_row = min(rows - 1, int(np.floor(min(max(a[1], b[1], c[1]), rows + 1.0))))
    first_column = max(0, int(np.ceil(max(min(a[0], b[0], c[0]), -1.0))))
    last_column = min(columns - 1, int(np.floor(min(max(a[0], b[0], c[0]), columns + 1.0))))
    along_u, down_u = (c[1] - a[1]) / area, -(c[0] - a[0]) / area
    along_v, down_v = -(b[1] - a[1]) / area, (b[0] - a[0]) / area
    slack = -1e-9
    for y in range(first_row, last_row + 1):
        start_u = (y - a[1]) * down_u - a[0] * along_u
        start_v = (y - a[1]) * down_v - a[0] * along_v
        for x in range(first_column, last_column + 1):
            u, v = start_u + x * along_u, start_v + x * along_v
            if u < slack or v < slack or u + v > 1.0 - slack:
                continue
            near = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
            if near > nearness[y, x]:
                nearness[y, x] = near
                face[y, x] = f


@kernel(error_model="numpy")
def _paint_all(pixels, face, depth):
    for f in range(len(pixels)):
        fill_triangle(pixels[f, 0], pixels[f, 1], pixels[f, 2], f, face, depth)


def paint_target(axes: Axes, target: Target, eye: Float[np.ndarray, "3 3"]) -> View | None:
    """Show a target in a panel, by the eye's axes; a cloud of points is drawn as such, and hides nothing."""
    if target.ball_radius == 0.0:
        view = rasterise(target.vertices, target.faces, eye, columns=800)
        view.paint(axes)
        return view
    axes.scatter(*(target.vertices @ eye.T)[:, :2].T, s=1.0, color=TARGET_COLOUR)
    axes.set(xlabel="m", ylabel="m", aspect="equal")
    return None


def paint_paths(
    axes: Axes,
    target: Target,
    paths: Mapping[str, Float[np.ndarray, "samples 3"]],
    goals: Iterable[Sequence[float]],
    eye: Float[np.ndarray, "3 3"],
    looked: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    scenario: Scenario | None = None,
) -> None:
    """Show flown paths (body frame, m) around a target in a panel; what it hides of them is dotted.

    Args:
        axes: the panel.
        target: to draw.
        paths: by name; a square at their start, a disc at their end, hollow where the target hides them.
        goals: stars, m.
        eye: its axes as rows.
        looked: how each path looks, by name; if not given, as `looks` says.
        scenario: whose zones, corridors and hold points are shown too.

    """
    view, looked = paint_target(axes, target, eye), looked or dict(zip(paths, looks(len(paths))))
    step = 0.005 * float(np.ptp(target.vertices, axis=0).max())
    for place, (name, path) in enumerate(paths.items()):
        path = _finely(path, step)
        flat, colour = (path @ eye.T)[:, :2], looked[name]["color"]
        hidden = np.zeros(len(path), bool) if view is None else view.hides(path)
        axes.plot(*np.where(hidden[:, None], flat, np.nan).T, color=colour, linewidth=0.8, linestyle=":")
        axes.plot(*np.where(hidden[:, None], np.nan, flat).T, **{"linewidth": 1.5, "label": name, **looked[name]})
        for end, mark, words in ((0, "s", "start"), (-1, "o", "end")):
            look = {"color": colour, "marker": mark, "markersize": 4.5, "linestyle": ""}
            look["markerfacecolor"] = "white" if hidden[end] else colour
            axes.plot(*flat[end], label=words if place == 0 else None, **look)
    stars = np.array([eye @ np.asarray(goal) for goal in goals]).reshape(-1, 3)
    if len(stars):
        axes.plot(*stars[:, :2].T, color="black", marker="*", markersize=9, linestyle="", label="goal")
    axes.autoscale()
    axes.margins(0.03)
    if scenario is not None:
        paint_bodies(axes, scenario, eye)


def _finely(path: Float[np.ndarray, "samples 3"], step: float) -> Float[np.ndarray, "places 3"]:
    """Give a path with further places between its samples, so that it goes behind the mesh where it does."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if len(path) < 2 or not np.isfinite(along[-1]) or along[-1] == 0.0:
        return path
    # Samples stay, as those of a chaser that turns sharply matter; 20 000 places are finer than any picture.
    between = np.linspace(0.0, along[-1], int(min(along[-1] / step, 20_000)) + 2)
    every = np.union1d(along, between)
    return np.stack([np.interp(every, along, column) for column in path.T], axis=1)


def draw_target(path: Path, target: Target) -> None:
    """Draw four shaded views of a target into one PNG, each with the body frame's axes from its origin."""
    length = 0.3 * float(np.ptp(target.vertices, axis=0).max())
    with figure(path, width=11.0, height=8.0) as drawing:
        for axes, (name, side) in zip(drawing.subplots(2, 2).flat, _FOUR_SIDES.items()):
            eye = eye_axes(*side)
            paint_target(axes, target, eye)
            limits = np.array([axes.get_xlim(), axes.get_ylim()])
            for letter, along in zip("xyz", eye[:2].T):
                with np.errstate(divide="ignore", invalid="ignore"):
                    to_the_edge = float(np.nanmin(np.max(limits / along[:, None], axis=1)))
                if np.hypot(*along) < 0.01 or to_the_edge < 0.0:
                    continue  # it points at the eye or away from it, or its origin is not in the picture
                flat = min(length, 0.8 * to_the_edge) * along
                axes.annotate("", flat, (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": _AXES_COLOUR})
                axes.annotate(letter, 1.12 * flat, color=_AXES_COLOUR, ha="center", va="center", weight="bold")
            axes.set_title(f"{target.name}, {name}")


def draw_paths(
    path: Path, target: Target, paths: Mapping[str, Float[np.ndarray, "samples 3"]], scenario: Scenario
) -> None:
    """Draw flown paths (body frame, m) around the target from two sides into one PNG, with what else they keep off."""
    goal = scenario.goal.position
    every = np.concatenate([target.vertices, *paths.values(), [goal]])
    flat = [(every[np.isfinite(every).all(axis=1)] @ eye_axes(*side).T)[:, :2] for side in PATHS_FROM]
    shapes = [float(np.divide(*np.ptp(of, axis=0)[::-1])) for of in flat]
    with figure(path, width=11.0, height=float(np.clip(5.0 * max(shapes) + 0.9, 3.0, 9.0))) as drawing:
        panels = drawing.subplots(1, 2)
        for axes, side in zip(panels, PATHS_FROM):
            paint_paths(axes, target, paths, [goal], eye_axes(*side), scenario=scenario)
        drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=min(len(paths) + 3, 6))


def draw_slices(path: Path, model: FieldModel, target: Target) -> None:
    """Draw three slices through the target's middle into one PNG.

    Colours are f̃ (m); black is where the exact distance to the mesh equals the offset δ, orange the field's zero level,
    and green each certified level R + e_h.
    """
    lower, upper = target.vertices.min(axis=0), target.vertices.max(axis=0)
    middle = 0.5 * (lower + upper)
    room = 1.5
    with figure(path, width=9.0, height=13.0) as drawing:
        for axes, (across, up, through) in zip(drawing.subplots(3, 1), _PLANES):
            extent = upper[[across, up]] - lower[[across, up]] + 2.0 * room
            step = float(extent.max()) / _NODES
            u = np.arange(lower[across] - room, upper[across] + room, step)
            v = np.arange(lower[up] - room, upper[up] + room, step)
            grid = np.empty((len(v), len(u), 3))
            grid[..., across], grid[..., up], grid[..., through] = u, v[:, None], middle[through]
            points = grid.reshape(-1, 3)
            field = values(model.field, points).reshape(len(v), len(u))
            exact = target.distance.distance(points).reshape(len(v), len(u))
            shade = axes.pcolormesh(u, v, field, cmap="RdBu", vmin=-2.0, vmax=2.0, shading="auto")
            levels = [(exact, model.offset, "black"), (field, 0.0, COLOURS[1])]
            levels += [(field, proof.chaser_radius + proof.error_bound, COLOURS[2]) for proof in model.certificates]
            for number, level, colour in levels:
                axes.contour(u, v, number, levels=[level], colors=colour, linewidths=0.8)
            axes.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m", aspect="equal")
            axes.set_title(f"{'xyz'[through]} = {middle[through]:.2f} m")
            drawing.colorbar(shade, ax=axes, label="f̃, m", shrink=0.8)
        lines = {f"d = {model.offset:g} m": "black", "f̃ = 0": COLOURS[1]}
        if model.certificates:
            lines["f̃ = R + e_h"] = COLOURS[2]
        handles = [Line2D([], [], color=colour, label=label) for label, colour in lines.items()]
        drawing.legend(handles=handles, loc="upper left")


def draw_surface(path: Path, target: Target, surface: "Surface", *, level: float) -> None:
    """Draw the mesh and, beside it, the surface {f̃ = level}, coloured by its distance from the mesh, from two sides."""
    distance = target.distance.distance(surface.vertices)[surface.faces].mean(axis=1)
    ceiling = max(float(np.quantile(distance, 0.99)), 1e-3)
    shade = ScalarMappable(Normalize(0.0, ceiling, clip=True), plt.get_cmap("YlOrRd"))
    rows = {
        name: [rasterise(of.vertices, of.faces, eye_axes(*side)) for of in (target, surface)]
        for name, side in _SURFACE_FROM.items()
    }
    height = sum(6.0 * max(view.shape for view in pair) + 0.5 for pair in rows.values())
    with figure(path, width=13.0, height=height) as drawing:
        panels = drawing.subplots(len(rows), 2)
        for (left, right), (name, (mesh, learned)) in zip(panels, rows.items()):
            mesh.paint(left)
            left.set_title(f"{target.name}, mesh, from {name}")
            learned.paint(right, shade.to_rgba(distance[learned.face])[..., :3])
            right.set_title(f"learned, f̃ = {level:+.3f} m, from {name}")
        drawing.colorbar(shade, ax=panels, label="distance from the mesh, m", shrink=0.8)

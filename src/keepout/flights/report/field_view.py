"""Pictures of a field: slices with its level sets against the exact distance, and its surface."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.target import Target
from keepout.core.measures.surface import Surface
from keepout.flights.report.raster import rasterise
from keepout.flights.report.style import COLOURS, figure

_PLANES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
"""Horizontal axis, vertical axis, and the axis that the slice is across."""


_VIEWS = {"above": (28.0, -55.0), "below": (-28.0, 125.0)}
"""Elevation and azimuth of the eye, degrees."""


def draw_slices(path: Path, model: FieldModel, target: Target, *, nodes: int = 400) -> None:
    """Draw three slices through the target's middle into one PNG.

    Colours are f̃ (m); black is where the exact distance to the mesh equals the offset δ, orange the field's zero level,
    and green each certified level R + e_h.
    """
    lower, upper = target.vertices.min(axis=0), target.vertices.max(axis=0)
    middle = 0.5 * (lower + upper)
    room = 1.5
    with figure(path, width=9.0, height=13.0) as drawing:
        for place, (across, up, through) in enumerate(_PLANES, start=1):
            axes = drawing.add_subplot(3, 1, place)
            extent = upper[[across, up]] - lower[[across, up]] + 2.0 * room
            step = float(extent.max()) / nodes
            u = np.arange(lower[across] - room, upper[across] + room, step)
            v = np.arange(lower[up] - room, upper[up] + room, step)
            grid = np.empty((len(v), len(u), 3))
            grid[..., across], grid[..., up], grid[..., through] = u, v[:, None], middle[through]
            points = grid.reshape(-1, 3)
            field = values(model.field, points).reshape(len(v), len(u))
            exact = target.distance.distance(points).reshape(len(v), len(u))
            shade = axes.pcolormesh(u, v, field, cmap="RdBu", vmin=-2.0, vmax=2.0, shading="auto")
            axes.contour(u, v, exact, levels=[model.offset], colors="black", linewidths=0.8)
            axes.contour(u, v, field, levels=[0.0], colors=COLOURS[1], linewidths=0.8)
            for certificate in model.certificates:
                level = certificate.chaser_radius + certificate.error_bound
                axes.contour(u, v, field, levels=[level], colors=COLOURS[2], linewidths=0.8)
            axes.set(
                xlabel=f"{'xyz'[across]} m",
                ylabel=f"{'xyz'[up]} m",
                title=f"{'xyz'[through]} = {middle[through]:.2f} m",
                aspect="equal",
            )
            drawing.colorbar(shade, ax=axes, label="f̃ m", shrink=0.8)
        lines = {f"d = {model.offset:g} m": "black", "f̃ = 0": COLOURS[1]}
        if model.certificates:
            lines["f̃ = R + e_h"] = COLOURS[2]
        handles = [Line2D([], [], color=colour, label=label) for label, colour in lines.items()]
        drawing.legend(handles=handles, loc="upper left")


def draw_surface(path: Path, target: Target, surface: Surface, *, level: float) -> None:
    """Draw the mesh and, beside it, the surface {f̃ = level}, coloured by its distance from the mesh, from two sides."""
    distance = target.distance.distance(surface.vertices)[surface.faces].mean(axis=1)
    ceiling = max(float(np.quantile(distance, 0.99)), 1e-3)
    colour_map = plt.get_cmap("YlOrRd")
    rows = {
        name: [
            rasterise(vertices, faces, elevation=elevation, azimuth=azimuth)
            for vertices, faces in ((target.vertices, target.faces), (surface.vertices, surface.faces))
        ]
        for name, (elevation, azimuth) in _VIEWS.items()
    }
    height = sum(6.0 * max(view.hit.shape[0] / view.hit.shape[1] for view in pair) + 0.5 for pair in rows.values())
    with figure(path, width=13.0, height=height) as drawing:
        for row, (name, (mesh, learned)) in enumerate(rows.items()):
            distances = colour_map(np.clip(distance[learned.face] / ceiling, 0.0, 1.0))[..., :3]
            for column, (view, colour, title) in enumerate(
                (
                    (mesh, np.array([0.85, 0.87, 0.9]), f"{target.name}, mesh, from {name}"),
                    (learned, distances, f"learned, f̃ = {level:+.3f} m, from {name}"),
                )
            ):
                axes = drawing.add_subplot(len(rows), 2, 2 * row + column + 1)
                picture = np.where(view.hit[..., None], colour * view.light[..., None], 1.0)
                axes.imshow(picture, origin="lower", extent=view.extent)
                axes.set(title=title, xlabel="m", ylabel="m", aspect="equal")
                axes.grid(visible=False)
        shade = ScalarMappable(Normalize(0.0, ceiling), colour_map)
        drawing.colorbar(shade, ax=drawing.axes, label="distance from the mesh m", shrink=0.8)

"""Pictures of a field: slices with its level sets against the exact distance, and its surface."""

from pathlib import Path

import numpy as np
from skimage import measure

from keepout.fields.evaluate import values
from keepout.fields.model import FieldModel
from keepout.geometry.target import Target
from keepout.report.style import COLOURS, figure
from keepout.report.target_view import draw_target

_PLANES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
"""Horizontal axis, vertical axis, and the axis that the slice is across."""


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


def draw_surface(path: Path, model: FieldModel, target: Target, *, nodes: int = 160) -> None:
    """Draw four views of the field's zero level, by marching cubes on a grid of `nodes` along the longest side."""
    lower, upper = target.vertices.min(axis=0) - 0.5, target.vertices.max(axis=0) + 0.5
    step = float((upper - lower).max()) / nodes
    axes = [np.arange(low, high + step, step) for low, high in zip(lower, upper)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = values(model.field, points.reshape(-1, 3)).reshape(points.shape[:3])
    vertices, faces, _, _ = measure.marching_cubes(field, level=0.0, spacing=(step, step, step))
    draw_target(path, f"{target.name}, learned", vertices + lower, faces.astype(np.int64))

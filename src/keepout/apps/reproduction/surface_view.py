"""Figures of learned surfaces beside the mesh, and of what an ellipsoid gives away."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from keepout.core.measures.surface import Ellipsoid
from keepout.flights.report.raster import View, eye_axes, rasterise
from keepout.flights.report.style import COLOURS, figure

_ELEVATION, _AZIMUTH = 28.0, -55.0
"""Of the eye, degrees."""
_GREY = np.array([0.82, 0.85, 0.9])
_COLUMN = 3.5
"""Inches: one column of print."""
_TITLE = 0.36
"""Inches that a panel's title and axis take."""


class Triangles(NamedTuple):
    """A surface: vertices in metres, and faces."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def draw_surfaces(path: Path, surfaces: Mapping[str, Triangles]) -> None:
    """Draw surfaces of one target below each other, seen from the same side, by title."""
    views = {title: _seen(surface) for title, surface in surfaces.items()}
    height = sum((_COLUMN - 0.5) * _shape(view) + _TITLE for view in views.values()) + 0.2
    with figure(path, width=_COLUMN, height=height, vector=True) as drawing:
        panels = drawing.subplots(
            len(views), 1, squeeze=False, sharex=True, height_ratios=[_shape(view) for view in views.values()]
        )[:, 0]
        for axes, (title, view) in zip(panels, views.items()):
            _paint(axes, view)
            axes.set_title(title, fontsize=8)
        panels[-1].set_xlabel("m")


def draw_ellipsoids(path: Path, targets: Mapping[str, tuple[Triangles, Ellipsoid]]) -> None:
    """Draw for each target its learned surface inside the ellipsoid, seen from one side, by title."""
    outlines = {title: _outline(ellipsoid) for title, (_, ellipsoid) in targets.items()}
    shapes = [height / width for width, height in (_extent(outline) for outline in outlines.values())]
    height = sum((_COLUMN - 0.5) * shape + _TITLE for shape in shapes) + 0.2
    with figure(path, width=_COLUMN, height=height, vector=True) as drawing:
        panels = drawing.subplots(len(targets), 1, squeeze=False, height_ratios=shapes)[:, 0]
        for axes, (title, (surface, ellipsoid)) in zip(panels, targets.items()):
            middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
            shift = (eye_axes(_ELEVATION, _AZIMUTH) @ (ellipsoid.centre - middle))[:2]
            outline = outlines[title]
            lengths, directions = np.linalg.eigh(outline)
            width, tall = 2.0 * np.sqrt(lengths)
            angle = float(np.degrees(np.arctan2(directions[1, 0], directions[0, 0])))
            axes.add_patch(
                Ellipse(
                    (float(shift[0]), float(shift[1])),
                    width,
                    tall,
                    angle=angle,
                    facecolor=COLOURS[5],
                    alpha=0.25,
                    zorder=0.5,
                )
            )
            axes.add_patch(
                Ellipse((float(shift[0]), float(shift[1])), width, tall, angle=angle, fill=False, edgecolor=COLOURS[0])
            )
            _paint(axes, _seen(surface))
            half = 0.5 * np.array(_extent(outline)) * 1.04
            axes.set(xlim=(shift[0] - half[0], shift[0] + half[0]), ylim=(shift[1] - half[1], shift[1] + half[1]))
            axes.set_title(title, fontsize=8)
        panels[-1].set_xlabel("m")


def _seen(surface: Triangles) -> View:
    return rasterise(surface.vertices, surface.faces, elevation=_ELEVATION, azimuth=_AZIMUTH, columns=1600)


def _shape(view: View) -> float:
    """Height over width."""
    return view.hit.shape[0] / view.hit.shape[1]


def _outline(ellipsoid: Ellipsoid) -> Float[np.ndarray, "2 2"]:
    """Give P of an ellipsoid's silhouette {x : xᵀ P⁻¹ x ≤ 1}, from its middle, in the axes of the picture."""
    axes = eye_axes(_ELEVATION, _AZIMUTH)[:2]
    return axes @ np.linalg.inv(ellipsoid.matrix) @ axes.T


def _extent(outline: Float[np.ndarray, "2 2"]) -> tuple[float, float]:
    """Width and height of a silhouette, metres."""
    return 2.0 * float(np.sqrt(outline[0, 0])), 2.0 * float(np.sqrt(outline[1, 1]))


def _paint(axes: Axes, view: View) -> None:
    """Show a picture with what is not hit left clear."""
    shade = _GREY * view.light[..., None]
    picture = np.concatenate([shade, view.hit[..., None].astype(float)], axis=2)
    axes.imshow(picture, origin="lower", extent=view.extent, zorder=1.0)
    axes.set(ylabel="m", aspect="equal")
    axes.tick_params(labelsize=7)
    axes.grid(visible=False)

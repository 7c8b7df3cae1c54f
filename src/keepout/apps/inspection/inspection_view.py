"""Pictures of an inspection: coverage over time, what became of the surface, and the best view of each part."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int8
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Patch

from keepout.apps.inspection.best_views import BestView, best_views
from keepout.apps.inspection.coverage import FATE_COLOURS
from keepout.apps.inspection.fate import WORDS, Fate, fates
from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.patch_mesh import PatchMesh
from keepout.apps.inspection.perspective import Studio
from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.flights.report.raster import eye_axes, rasterise
from keepout.flights.report.style import COLOURS, figure

_SIDES = {
    "from above, front left": (30.0, -60.0),
    "from above, front right": (30.0, 30.0),
    "from above, back": (30.0, 150.0),
    "from below, front left": (-30.0, -60.0),
    "from below, front right": (-30.0, 30.0),
    "from below, back": (-30.0, 150.0),
}
"""Elevation and azimuth, degrees."""
_COLUMNS = 900
_SHADE = 0.6
"""Share of the light that every place gets: colours that are read must not turn dark."""
_PIXELS = 400
"""Of a picture on the contact sheet, across."""
_FINER = 2
"""Rays across and down each of those pixels."""
_ACROSS = 4
"""Pictures in a row of the contact sheet."""
_SPACE, _BODY = np.array([0.05, 0.06, 0.08]), np.array([0.86, 0.88, 0.92])
_RING = {"fill": False, "edgecolor": "white", "linewidth": 0.6, "alpha": 0.35}
_MARK = np.array(to_rgb(COLOURS[4]))
"""The edge of what counted as seen in a picture."""


def draw_coverage(path: Path, inspection: Inspection) -> None:
    """Draw coverage and clearance over time into one PNG, with what was planned and what is possible as lines."""
    time, share = inspection.over_time()
    record, light = inspection.record, any(frame.sun is not None for frame in inspection.frames)
    start, end = float(record.time[0]), float(record.time[-1])
    with figure(path, width=8.0, height=5.4) as drawing:
        cover, near = drawing.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
        steps = (
            np.concatenate([[start], time, [end]]),
            np.concatenate([[0.0], share, share[-1:] if len(share) else [0]]),
        )
        cover.step(*steps, where="post", color=COLOURS[2], linewidth=1.6, label="seen, as flown")
        lit = " and be lit" if light else ""
        lines = {
            f"surely can be seen{lit}": (inspection.patches.coverage(inspection.lit), COLOURS[0], "-"),
            "planned at the start": (inspection.patches.coverage(inspection.plan.covered), COLOURS[4], "--"),
            "no chaser can see more (proved)": (inspection.seeable.upper, "black", ":"),
        }
        for words, (level, colour, line) in lines.items():
            cover.axhline(level, color=colour, linestyle=line, linewidth=1.0, label=f"{words}: {level:.2%}")
        if light:
            _shade_dark(cover, inspection, end)
        cover.yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
        cover.set(ylabel="of the area counted", title=f"Coverage over time: {inspection.coverage:.2%} seen")
        cover.set_ylim(-0.02, 1.04)
        cover.legend(fontsize=8, loc="lower right")
        clearance = inspection.target.distance.distance(record.position) - inspection.scenario.chaser.radius
        near.plot(record.time, clearance, color=COLOURS[0], linewidth=1.0)
        near.axhline(0.0, color="black", linewidth=0.8)
        near.set(xlabel="time s", ylabel="m", title="Clearance on the exact mesh")


def _shade_dark(axes, inspection: Inspection, end: float) -> None:
    """Mark the frames that the sun did not light, as spans up to the next frame."""
    frames = inspection.frames
    dark = np.array([frame.sun is None for frame in frames])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(int))).reshape(-1, 2)
    for place, (first, after) in enumerate(edges):
        until = frames[after].time if after < len(frames) else end
        words = {"label": "in the Earth's shadow"} if place == 0 else {}
        axes.axvspan(frames[first].time, until, color="black", alpha=0.12, linewidth=0.0, **words)


def draw_fates(path: Path, inspection: Inspection) -> None:
    """Draw the surface from six sides, each place in the colour of what became of it, into one PNG."""
    fate, mesh = fates(inspection), PatchMesh.of(inspection.patches)
    shown: set[int] = set()
    with figure(path, width=11.0, height=7.6) as drawing:
        panels = drawing.subplots(2, 3)
        for axes, (name, (elevation, azimuth)) in zip(panels.flat, _SIDES.items()):
            view = rasterise(mesh.vertices, mesh.faces, elevation=elevation, azimuth=azimuth, columns=_COLUMNS)
            towards = inspection.patches.normals @ eye_axes(elevation, azimuth)[2]
            patch = mesh.patch[view.face]
            unit = 2 * patch + (towards[patch] < 0.0)
            shown |= set(np.unique(fate[unit[view.hit]]).tolist())
            colours = _palette()[fate[unit]] * (_SHADE + (1.0 - _SHADE) * view.light[..., None])
            picture = np.concatenate([colours, view.hit[..., None].astype(float)], axis=2)
            axes.imshow(picture, origin="lower", extent=view.extent)
            axes.set_title(name, fontsize=9)
            axes.grid(visible=False)
            axes.tick_params(labelsize=7)
        parts = _shares_by_fate(inspection, fate)
        handles = [
            Patch(facecolor=FATE_COLOURS[kind], label=f"{WORDS[kind]}{parts[kind]}") for kind in Fate if kind in shown
        ]
        drawing.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
        drawing.suptitle("What became of the surface: shares are of the area counted", fontsize=10)


def _shares_by_fate(inspection: Inspection, fate: Int8[np.ndarray, " units"]) -> dict[Fate, str]:
    shares = {kind: f", {inspection.patches.coverage(fate == kind):.2%}" for kind in Fate}
    return shares | {Fate.NOT_COUNTED: ""}


def _palette() -> Float[np.ndarray, "fates 3"]:
    return np.array([to_rgb(FATE_COLOURS[kind]) for kind in Fate])


def draw_contact_sheet(path: Path, inspection: Inspection) -> None:
    """Draw the best view of each part that was seen into one PNG: as the camera had it, in the light that there was.

    The edge of what counted as wholly seen, of that part and in that frame, is orange; a ring is the camera's cone.
    """
    parts = best_views(inspection)
    views = [view for view in parts if view.frame >= 0]
    light = any(frame.sun is not None for frame in inspection.frames)
    rows = max(1, math.ceil(len(views) / _ACROSS))
    mesh = PatchMesh.of(inspection.patches)
    studio = Studio(mesh.triangles())
    with figure(path, width=11.0, height=0.75 + 3.05 * rows) as drawing:
        panels = drawing.subplots(rows, _ACROSS, squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        for place, (axes, view) in enumerate(zip(panels.flat, views), start=1):
            axes.imshow(best_picture(inspection, view, mesh, studio))
            middle = 0.5 * _PIXELS - 0.5
            axes.add_patch(Circle((middle, middle), 0.5 * _PIXELS, **_RING))
            axes.set_title(_caption(inspection, view, place), fontsize=7.5)
        lit = "in the sunlight of that moment, with its shadows" if light else "in a light at the camera"
        left = len(parts) - len(views)
        unseen = f" ({left} more were not seen)" if left else ""
        drawing.suptitle(
            f"The best view of each of {len(views)} parts{unseen}, {lit}\n"
            "orange: the edge of what counted as wholly seen; ring: the camera's cone",
            fontsize=10,
        )


def best_picture(
    inspection: Inspection, view: BestView, mesh: PatchMesh, studio: Studio, *, pixels: int = _PIXELS
) -> Float[np.ndarray, "rows columns 3"]:
    """Draw one part that was seen as its best frame had it, 0 to 1 in each colour."""
    frame = inspection.frames[view.frame]
    camera = Pinhole(_FINER * pixels, _FINER * pixels, inspection.rules.field_of_view)
    axes = axes_towards(frame.boresight, np.array([0.0, 0.0, 1.0]))
    picture = studio.take(camera, frame.position, axes)
    bright = studio.light(picture, camera, frame.position, axes, frame.sun)
    drawn = np.where(picture.hit[..., None], _BODY * bright[..., None], _SPACE)
    drawn[studio.outlines(picture)] *= 0.55
    drawn[_edge(_shown(inspection, view, mesh, picture.face, frame.position))] = _MARK
    return drawn.reshape(pixels, _FINER, pixels, _FINER, 3).mean(axis=(1, 3))


def _shown(
    inspection: Inspection, view: BestView, mesh: PatchMesh, face: np.ndarray, position: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "rows columns"]:
    """Say which pixels show a unit of the part that counted as seen in this frame."""
    patches = inspection.patches
    counted = np.zeros(patches.units, bool)
    counted[view.shown] = True
    before = np.einsum("ni,ni->n", position - patches.centres, patches.normals) >= 0.0
    patch = mesh.patch[np.maximum(face, 0)]
    return (face >= 0) & counted[2 * patch + ~before[patch]]


def _edge(marked: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Give what lies within three pixels of the border of what is marked, inside it."""
    inner = np.pad(marked, 1)
    for _ in range(3):
        shifted = [np.roll(inner, step, axis) for axis in (0, 1) for step in (-1, 1)]
        inner = np.logical_and.reduce([inner, *shifted])
    return marked & ~inner[1:-1, 1:-1]


def _caption(inspection: Inspection, view: BestView, place: int) -> str:
    time = inspection.frames[view.frame].time
    return (
        f"part {place}, at {time:.0f} s from {view.distance:.1f} m\n"
        f"{view.share:.0%} of it in this frame, {1e3 * view.sample_distance:.1f} mm a pixel"
    )

"""Pictures of an inspection: coverage over time, what became of the surface, and the best view of each part.

The best views are drawn as a camera has them: in perspective, with depth, lit by the sun or from the camera.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Circle, Patch
from scipy.ndimage import binary_erosion

from keepout.apps.inspection.inspection import Fate, Inspection, fates
from keepout.apps.inspection.seeing.patches import Patches, Units
from keepout.apps.inspection.seeing.sightlines import slab
from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.core.cores import kernel
from keepout.core.geometry.distance import Point
from keepout.flights.pages.figures import COLOURS, figure
from keepout.flights.pages.mesh_pictures import READABLE, eye_axes, fill_triangle, rasterise

_NEAR = 0.01
"""Metres before the camera within which nothing is drawn."""
_ABOVE = 1e-3
"""Metres over the surface from which a ray to the sun starts: an absolute length, so that no shadow is lost."""
_SHADOW = 0.13
"""Share of the light that a place without sun still gets, so that it is seen that something is there."""
_AMBIENT = 0.25
"""The same of the light at the camera."""
_BEND = 0.45
"""Angle between normals from which on there is an outline, rad."""
_STEP = 0.02
"""Step of the depth across a pixel beyond what the slope explains that makes an outline, as a share of the depth."""


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera has in its pixels, row 0 at the top.

    Attributes:
        camera: its image.
        position: of the camera, m.
        axes: of the camera as columns: x right, y down, z along the boresight.
        face: the nearest triangle at the pixel's middle; -1: none.
        depth: its distance along the boresight, m; inf: none.

    """

    camera: Pinhole
    position: Point
    axes: Float[np.ndarray, "3 3"]
    face: Int[np.ndarray, "rows columns"]
    depth: Float[np.ndarray, "rows columns"]

    @property
    def hit(self) -> Bool[np.ndarray, "rows columns"]:
        """Whether anything is there."""
        return self.face >= 0

    def places(self) -> tuple[Float[np.ndarray, "hits 3"], Float[np.ndarray, "hits 3"]]:
        """Give the places that the pixels with something in them show, m, and unit vectors from there to the camera."""
        rows, columns = np.nonzero(self.hit)
        across = (columns + 0.5 - 0.5 * self.camera.width) / self.camera.focal
        down = (rows + 0.5 - 0.5 * self.camera.height) / self.camera.focal
        rays = np.column_stack([across, down, np.ones(len(rows))]) @ self.axes.T
        there = self.position + rays * self.depth[rows, columns, None]
        return there, -rays / np.linalg.norm(rays, axis=1, keepdims=True)


class Studio:
    """Triangles to take pictures of.

    Args:
        triangles: (f, 3, 3) corners, m.

    """

    def __init__(self, triangles: Float[np.ndarray, "f 3 3"]) -> None:
        self.triangles = np.ascontiguousarray(triangles, np.float64)
        self._first_hit = FirstHit(self.triangles.reshape(-1, 3), np.arange(3 * len(self.triangles)).reshape(-1, 3))
        self.normals = self._first_hit.normals

    def take(self, camera: Pinhole, position: Point, axes: Float[np.ndarray, "3 3"]) -> Picture:
        """Take a picture.

        Args:
            camera: its image.
            position: of the camera, m.
            axes: of the camera as columns: x right, y down, z along the boresight.

        """
        face = np.full(camera.shape, -1)
        inverse = np.zeros(camera.shape)  # of the depth, which is linear in the image
        _paint(self.triangles, np.asarray(position, float), np.ascontiguousarray(axes), camera.focal, face, inverse)
        with np.errstate(divide="ignore"):
            return Picture(camera, position, axes, face, 1.0 / inverse)

    def light(self, picture: Picture, sun: Point | None = None) -> Float[np.ndarray, "rows columns"]:
        """Say how bright each pixel is, 0 to 1: by the sun, with the shadows of all triangles, or by a headlight.

        Args:
            picture: of these triangles.
            sun: (3,) unit vector towards it; None: the light is at the camera.

        """
        there, back = picture.places()
        normals = self.normals[picture.face[picture.hit]]
        normals = normals * np.where(np.einsum("ni,ni->n", normals, back) < 0.0, -1.0, 1.0)[:, None]
        if sun is None:
            shade = _AMBIENT + (1.0 - _AMBIENT) * np.clip(np.einsum("ni,ni->n", normals, back), 0.0, 1.0)
        else:
            upright = np.clip(normals @ sun, 0.0, 1.0)
            facing = np.flatnonzero(upright > 0.0)
            rays = np.broadcast_to(sun, (len(facing), 3))
            free = np.isinf(self._first_hit.ranges(there[facing] + _ABOVE * normals[facing], rays))
            sunlight = np.zeros(len(there))
            sunlight[facing[free]] = upright[facing[free]]
            shade = _SHADOW + (1.0 - _SHADOW) * np.sqrt(sunlight)
        bright = np.zeros(picture.face.shape)
        bright[picture.hit] = shade
        return bright

    def outlines(self, picture: Picture) -> Bool[np.ndarray, "rows columns"]:
        """Mark pixels of a picture of these triangles at whose right or lower side the surface bends or breaks off."""
        normals = np.zeros((*picture.face.shape, 3))
        normals[picture.hit] = self.normals[picture.face[picture.hit]]
        depth = np.where(picture.hit, picture.depth, 1e9)
        marked = np.zeros(picture.face.shape, bool)
        for axis in (0, 1):
            near, far = (np.take(normals, np.arange(k, normals.shape[axis] - 1 + k), axis) for k in (0, 1))
            here, there = (np.take(depth, np.arange(k, depth.shape[axis] - 1 + k), axis) for k in (0, 1))
            bends = np.abs(np.einsum("abi,abi->ab", near, far)) < np.cos(_BEND)
            breaks = np.abs(here - there) > _STEP * np.minimum(here, there)
            slanted = np.abs(np.einsum("abi,abi->ab", near, far)) > 1.0 - 1e-9  # one plane: steep, not broken
            found = bends | (breaks & ~slanted)
            marked[: found.shape[0], : found.shape[1]] |= found & (picture.hit[: found.shape[0], : found.shape[1]])
        return marked


@kernel(error_model="numpy")
def _paint(triangles, position, axes, focal, face, inverse):
    """Draw triangles into `face` and the inverse of the depth; what is nearer than `_NEAR` is cut away."""
    rows, columns = face.shape
    corner, cut = np.empty((3, 3)), np.empty((4, 3))
    for f in range(len(triangles)):
        for k in range(3):
            x, y, z = triangles[f, k, 0], triangles[f, k, 1], triangles[f, k, 2]
            dx, dy, dz = x - position[0], y - position[1], z - position[2]
            for axis in range(3):
                corner[k, axis] = dx * axes[0, axis] + dy * axes[1, axis] + dz * axes[2, axis]
        count = slab(corner, corner[:, 2], 3, _NEAR, 1.0, cut, cut[:, 2])
        for k in range(count):
            z = cut[k, 2]
            cut[k, 0] = focal * cut[k, 0] / z + 0.5 * columns - 0.5
            cut[k, 1] = focal * cut[k, 1] / z + 0.5 * rows - 0.5
            cut[k, 2] = 1.0 / z
        for k in range(1, count - 1):
            fill_triangle(cut[0], cut[k], cut[k + 1], f, face, inverse)


_WELD = 1e-6
"""Metres within which corners are one."""
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
_EDGE = 3
"""Pixels that it is wide, inside of what counted."""
MOST_PARTS = 16
_APART = 0.35
"""Units of a part lie within this of its first one: of the target's size, where they face the same way."""
_TURNED = 0.5
"""What a unit vector's difference of 1 between normals counts, beside places as shares of the target's size."""
_TOGETHER = 0.15
"""Edge of the cells, of those places and normals, in which area counts as lying together."""
_ENOUGH = 1.0 / 300.0
"""Share of the area that lies together where a part begins: the rims of plates are no parts of their own."""
_ROUNDS = 8
"""In which the units are given to the nearest part, and the parts moved to the middle of theirs."""


@dataclass(frozen=True, eq=False)
class PatchMesh:
    """Triangles that together are the patches.

    Attributes:
        vertices: m.
        faces: counter-clockwise about the normal of their patch.
        patch: of each face.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    patch: Int[np.ndarray, " f"]

    @classmethod
    def of(cls, patches: Patches) -> "PatchMesh":
        """Divide each patch into triangles that share its first corner."""
        most = patches.corners.shape[1]
        second = np.arange(1, most - 1)
        patch, place = np.nonzero(second[None] + 1 < patches.counts[:, None])
        first = most * patch
        faces = np.column_stack([first, first + second[place], first + second[place] + 1])
        corners = patches.corners.reshape(-1, 3)
        cells = np.rint(corners / _WELD).astype(np.int64)
        _, kept, joined = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        return cls(corners[kept], joined.reshape(-1)[faces], patch)


@dataclass(frozen=True, eq=False)
class BestView:
    """A part, and the frame that shows it best.

    Attributes:
        units: of the part.
        frame: number of that frame; -1 where no frame shows any of it.
        shown: units of the part that were wholly seen in it.
        share: of the part's area, 0 to 1, that those are.
        distance: from the camera to the middle of them, m; nan without a frame.
        sample_distance: median over them, m a pixel along the slant; nan without a frame.

    """

    units: Units
    frame: int
    shown: Units
    share: float
    distance: float
    sample_distance: float


def draw_coverage(path: Path, inspection: Inspection) -> None:
    """Draw coverage and clearance over time into one PNG, with what was planned and what is possible as lines."""
    time, share = inspection.over_time()
    record, light = inspection.record, any(frame.sun is not None for frame in inspection.frames)
    start, end = float(record.time[0]), float(record.time[-1])
    with figure(path, width=8.0, height=5.4) as drawing:
        cover, near = drawing.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
        shares = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
        times, drawn = np.concatenate([[start], time, [end]]), {"color": COLOURS[2], "linewidth": 1.6}
        cover.step(times, shares, where="post", label="seen, as flown", **drawn)
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
        near.plot(record.time, inspection.flight.clearance, color=COLOURS[0], linewidth=1.0)
        near.axhline(0.0, color="black", linewidth=0.8)
        near.set(xlabel="time, s", ylabel="clearance, m", title="Clearance on the exact mesh")


def _shade_dark(axes: Axes, inspection: Inspection, end: float) -> None:
    """Mark the frames that the sun did not light, as spans up to the next frame."""
    frames = inspection.frames
    dark = np.array([frame.sun is None for frame in frames])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(int))).reshape(-1, 2)
    for place, (first, after) in enumerate(edges):
        until = frames[after].time if after < len(frames) else end
        label = "in the Earth's shadow" if place == 0 else None
        axes.axvspan(frames[first].time, until, color="black", alpha=0.12, linewidth=0.0, label=label)


def draw_fates(path: Path, inspection: Inspection) -> None:
    """Draw the surface from six sides, each place in the colour of what became of it, into one PNG."""
    fate, patches, mesh = fates(inspection), inspection.patches, PatchMesh.of(inspection.patches)
    palette = np.array([to_rgb(kind.colour) for kind in Fate])
    shown: set[int] = set()
    with figure(path, width=11.0, height=7.6) as drawing:
        for axes, (name, side) in zip(drawing.subplots(2, 3).flat, _SIDES.items()):
            view = rasterise(mesh.vertices, mesh.faces, eye_axes(*side), columns=_COLUMNS)
            patch = mesh.patch[view.face]
            here = fate[2 * patch + ((patches.normals @ view.axes[2])[patch] < 0.0)]
            shown |= set(np.unique(here[view.hit]).tolist())
            view.paint(axes, palette[here], least=READABLE)
            axes.set(xlabel="", ylabel="")
            axes.set_title(name, fontsize=9)
            axes.tick_params(labelsize=7)
        shares = {kind: f", {patches.coverage(fate == kind):.2%}" for kind in Fate} | {Fate.NOT_COUNTED: ""}
        handles = [Patch(facecolor=kind.colour, label=f"{kind.words}{shares[kind]}") for kind in Fate if kind in shown]
        drawing.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
        drawing.suptitle("What became of the surface: shares are of the area counted", fontsize=10)


def draw_contact_sheet(path: Path, inspection: Inspection) -> None:
    """Draw the best view of each part that was seen into one PNG: as the camera had it, in the light that there was.

    The edge of what counted as wholly seen, of that part and in that frame, is orange; a ring is the camera's cone.
    """
    parts = best_views(inspection)
    views = [view for view in parts if view.frame >= 0]
    light = any(frame.sun is not None for frame in inspection.frames)
    rows = max(1, math.ceil(len(views) / _ACROSS))
    mesh = PatchMesh.of(inspection.patches)
    studio = Studio(mesh.vertices[mesh.faces])
    with figure(path, width=11.0, height=0.75 + 3.05 * rows) as drawing:
        panels = drawing.subplots(rows, _ACROSS, squeeze=False)
        for axes in panels.flat:
            axes.set_axis_off()
        for place, (axes, view) in enumerate(zip(panels.flat, views), start=1):
            axes.imshow(best_picture(inspection, view, mesh, studio))
            middle = 0.5 * _PIXELS - 0.5
            axes.add_patch(Circle((middle, middle), 0.5 * _PIXELS, **_RING))
            axes.set_title(
                f"part {place}, at {inspection.frames[view.frame].time:.0f} s from {view.distance:.1f} m\n"
                f"{view.share:.0%} of it in this frame, {1e3 * view.sample_distance:.1f} mm a pixel",
                fontsize=7.5,
            )
        lit = "in the sunlight of that moment, with its shadows" if light else "in a light at the camera"
        left = len(parts) - len(views)
        unseen = f" ({left} more were not seen)" if left else ""
        drawing.suptitle(
            f"The best view of each of {len(views)} parts{unseen}, {lit}\n"
            "orange: the edge of what counted as wholly seen; ring: the camera's cone",
            fontsize=10,
        )


def best_picture(
    inspection: Inspection, view: BestView, mesh: PatchMesh, studio: Studio
) -> Float[np.ndarray, "rows columns 3"]:
    """Draw one part that was seen as its best frame had it, 0 to 1 in each colour."""
    frame = inspection.frames[view.frame]
    camera = Pinhole(_FINER * _PIXELS, _FINER * _PIXELS, inspection.rules.field_of_view)
    axes = axes_towards(frame.boresight, np.array([0.0, 0.0, 1.0]))
    picture = studio.take(camera, frame.position, axes)
    bright = studio.light(picture, frame.sun)
    drawn = np.where(picture.hit[..., None], _BODY * bright[..., None], _SPACE)
    drawn[studio.outlines(picture)] *= 0.55
    marked = _shown(inspection, view, mesh, picture.face, frame.position)
    drawn[marked & ~binary_erosion(marked, iterations=_EDGE)] = _MARK
    return drawn.reshape(_PIXELS, _FINER, _PIXELS, _FINER, 3).mean(axis=(1, 3))


def _shown(
    inspection: Inspection, view: BestView, mesh: PatchMesh, face: np.ndarray, position: Point
) -> Bool[np.ndarray, "rows columns"]:
    """Say which pixels show a unit of the part that counted as seen in this frame."""
    patches = inspection.patches
    counted = np.zeros(patches.units, bool)
    counted[view.shown] = True
    before = np.einsum("ni,ni->n", position - patches.centres, patches.normals) >= 0.0
    patch = mesh.patch[np.maximum(face, 0)]
    return (face >= 0) & counted[2 * patch + ~before[patch]]


def best_views(inspection: Inspection) -> list[BestView]:
    """Divide what was or could have been seen into parts, and choose the best frame of each; the largest part first.

    A part is what lies together and faces the same way. A frame is the better the more pixels the part's wholly seen
    patches fill in it, times the share of the part's area that they are.
    """
    patches, fate = inspection.patches, fates(inspection)
    chosen = np.flatnonzero((fate == Fate.SEEN) | (fate == Fate.MISSED))
    if len(chosen) == 0:
        return []
    areas = patches.unit_areas()
    part = np.full(patches.units, -1)
    part[chosen] = _parts(patches, chosen, areas[chosen])
    count = int(part.max()) + 1
    whole = np.bincount(part[chosen], areas[chosen], count)
    best, score = np.full(count, -1), np.zeros(count)
    for number, frame in enumerate(inspection.frames):
        units = frame.units[part[frame.units] >= 0]
        if len(units) == 0:
            continue
        cosine, distance = _aspect(patches, units, frame.position)
        pixels = np.bincount(part[units], areas[units] * cosine / distance**2, count)
        here = pixels * np.bincount(part[units], areas[units], count) / whole
        best, score = np.where(here > score, number, best), np.maximum(here, score)
    order = [k for k in np.argsort(-whole, kind="stable") if whole[k] > 0.0]
    return [_view(inspection, np.flatnonzero(part == k), int(best[k])) for k in order]


def _view(inspection: Inspection, units: Units, frame: int) -> BestView:
    patches, areas = inspection.patches, inspection.patches.unit_areas()
    if frame < 0:
        return BestView(units, -1, units[:0], 0.0, np.nan, np.nan)
    taken = inspection.frames[frame]
    shown = np.intersect1d(units, taken.units)
    cosine, distance = _aspect(patches, shown, taken.position)
    middle = np.average(patches.centres[shown // 2], axis=0, weights=areas[shown])
    share, away = float(areas[shown].sum() / areas[units].sum()), float(np.linalg.norm(middle - taken.position))
    sample_distance = float(np.median(distance * inspection.rules.pixel_angle / cosine))
    return BestView(units, frame, shown, share, away, sample_distance)


def _aspect(
    patches: Patches, units: Int[np.ndarray, " k"], position: Point
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Give the cosine of the angle at which a camera looks at the middle of each unit, and how far off that is, m."""
    away = position - patches.centres[units // 2]
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    normals = patches.unit_normals()[units]
    return np.maximum(np.einsum("ni,ni->n", away, normals) / distance, 1e-3), distance


def _parts(patches: Patches, units: Int[np.ndarray, " k"], areas: Float[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Give each unit a part: first ones as far apart as can be, then each unit to the nearest, weighed by area."""
    centres = patches.centres[units // 2]
    size = max(float(np.linalg.norm(np.ptp(patches.corners.reshape(-1, 3), axis=0))), 1e-9)
    normals = patches.unit_normals()[units]
    places = np.concatenate([centres / size, _TURNED * normals], axis=1)
    _, cell = np.unique(np.floor(places / _TOGETHER).astype(int), axis=0, return_inverse=True)
    beside = np.bincount(cell.reshape(-1), areas)[cell.reshape(-1)]
    first = places[beside >= min(_ENOUGH * areas.sum(), beside.max())]
    middles = [places[int(np.argmax(beside))]]
    away = np.linalg.norm(first - middles[0], axis=1)
    while len(middles) < MOST_PARTS and away.max() > _APART:
        middles.append(first[int(np.argmax(away))])
        away = np.minimum(away, np.linalg.norm(first - middles[-1], axis=1))
    found = np.array(middles)
    nearest = np.zeros(len(units), int)
    for _ in range(_ROUNDS):
        nearest = np.argmin(np.linalg.norm(places[:, None] - found[None], axis=2), axis=1)
        weight = np.bincount(nearest, areas, len(found))
        sums = np.stack([np.bincount(nearest, areas * column, len(found)) for column in places.T], axis=1)
        found = np.where(weight[:, None] > 0.0, sums / np.maximum(weight, 1e-300)[:, None], found)
    return nearest

"""The folder of an exploration: map, flight file, summary, pictures, replay and a page that shows them.

The pictures show what was seen when, the map in slices, its growth, what is in the way, and what departs.
"""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from scipy.spatial import KDTree

from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown import map_file
from keepout.apps.unknown.cells import ACROSS
from keepout.apps.unknown.equipment import pinhole
from keepout.apps.unknown.exploration import Exploration
from keepout.apps.unknown.known_free import Seen, whole_blocks
from keepout.apps.unknown.next_view import UP
from keepout.apps.unknown.skin import skin_spacing
from keepout.apps.unknown.ways import reachable
from keepout.core.progress import Progress, silent
from keepout.flights.pages.drawn import fewer
from keepout.flights.pages.figures import COLOURS, figure
from keepout.flights.pages.flight_page import Told, draw_result
from keepout.flights.pages.folder import write_summary
from keepout.flights.pages.mesh_pictures import READABLE, View, eye_axes, paint_paths, rasterise
from keepout.flights.pages.replayed import Layer
from keepout.flights.pages.scene import Packing
from keepout.flights.requirements import judged

MAP = "map.keepmap"
ROWS = {
    "outcome": "outcome",
    "why": "because",
    "contact_verdict": "contact, on the true mesh",
    "minimum_clearance_m": "min clearance m",
    "seen_share": "share of the outer surface seen",
    "views": "views",
    "refused_views": "of them refused",
    "contradicting_returns": "returns in room known free",
    "opened_m3": "opened m³",
    "departures_largest_m": "largest departure from the expected mesh m",
    "duration_s": "flown s",
    "delta_v_mps": "Δv m/s",
    "guard_interventions": "guard steps",
    "start_certified": "start certified",
    "seconds": "computed in s",
}
"""Words for the entries of an exploration's summary that a person is shown first."""
MOST_TRIANGLES = 16_000
"""Of a skin as it is drawn: eight of them leave the page below 4 MB."""


def write_exploration(
    out: Path, exploration: Exploration, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Write all that an exploration has to show into a folder; give its summary with the names of the files.

    Args:
        out: made if it is not there.
        exploration: at its end.
        figures: also draw the PNG files, and write `index.html` and `replay.html`.
        progress: told how far it is.

    """
    name = exploration.scenario.name
    flight, kept = out / f"{name}.parquet", out / MAP
    map_file.save(exploration.map, kept)
    exploration.record.save(flight)
    summary = {"name": name, **exploration.summary(), "map": str(kept), "flight": str(flight)}
    summary["requirements"] = judged(exploration.scenario, summary)
    if figures:
        digests = {MAP: hashlib.sha256(kept.read_bytes()).hexdigest()}
        told, layer, drawn = Told(said(exploration), digests, ROWS), Growth(exploration), _drawn(exploration)
        summary["pictures"] = draw_result(out, exploration, summary, told, drawn, layer=layer, progress=progress)
    write_summary(out, summary)
    return summary


def _drawn(exploration: Exploration) -> dict[str, Any]:
    """Give what draws the pictures that there are, with captions."""
    drawn = {
        "seen": (draw_seen, "What was seen when, on the true surface, which nothing on board knew."),
        "map": (
            draw_slices,
            "The map at the end. What is not known free is an obstacle, whether something is there or not.",
        ),
        "progress": (draw_progress, "How the map grew, and where the chaser was."),
    }
    if len(exploration.unknown):
        drawn["unknown"] = (draw_unknown, f"What is unknown, and why it stays so: {exploration.why}.")
    if exploration.departures is not None:
        drawn["departures"] = (
            draw_departures,
            "Where the seen surface is not where the expected mesh says, beyond what the sensor's errors explain.",
        )
    return drawn


def said(exploration: Exploration) -> str:
    """Say in a sentence or two how an exploration ended."""
    taken = sum(view.status == "seen" for view in exploration.views)
    return (
        f"{exploration.outcome[0].upper()}{exploration.outcome[1:]}: {exploration.why}. {taken} views of "
        f"{len(exploration.views)} were taken in, and {exploration.seen_share:.0%} of the outer surface was seen. "
        f"{exploration.contact_said(' on the true mesh')}."
    )


@dataclass(frozen=True, eq=False)
class Growth(Layer):
    """What a replay shows of an exploration: the skins of its map, and its views."""

    exploration: Exploration
    name = "growth"

    def told(self, packing: Packing, start: float) -> dict[str, Any]:
        """Give it as JSON holds it, with the arrays packed; times count from `start`, s."""
        exploration, known = self.exploration, self.exploration.map
        camera, views, stages = pinhole(exploration.scenario), exploration.views, exploration.stages
        # A skin's squares are one edge wide: such a cell leaves about so many triangles as are drawn.
        edge = skin_spacing(known)
        sides = [edge * max(1.0, math.sqrt(len(stage.faces) / MOST_TRIANGLES)) for stage in stages]
        drawn = [
            fewer(stage.vertices, stage.faces, MOST_TRIANGLES, side=side)[:2] for stage, side in zip(stages, sides)
        ]
        # With the map's z axis upwards in the image, as the views were taken.
        axes = [axes_towards(view.direction, UP).T for view in views]
        return {
            "stages": [
                {
                    "time": float(stage.time - start),
                    "vertices": packing.steps(vertices),
                    "faces": packing.indices(faces),
                }
                for stage, (vertices, faces) in zip(stages, drawn, strict=True)
            ],
            "remark": self._remark(max((len(faces) for _, faces in drawn), default=0), edge),
            "views": {
                "time": packing.exact(np.array([view.time for view in views]) - start),
                "position": packing.exact(np.array([view.position for view in views]).reshape(-1, 3)),
                "axes": packing.exact(np.array(axes).reshape(-1, 3, 3)),
                "taken": packing.exact(np.array([view.status == "seen" for view in views], dtype=bool), "uint8"),
                "free_volume": packing.exact(np.array([view.free_volume for view in views])),
            },
            "slopes": [0.5 * camera.width / camera.focal, 0.5 * camera.height / camera.focal],
            "reach": known.bounds.usable_range(camera),
        }

    def _remark(self, shown: int, edge: float) -> str:
        """Say, as a sentence, how the drawn map differs from the map."""
        spacing, stages = self.exploration.map.spacing, self.exploration.stages
        most = max((len(stage.faces) for stage in stages), default=0)
        blocks = f", in blocks of {edge:g} m for cubes of {spacing:g} m" if edge > spacing else ""
        thinned = f", with at most {shown:,} of up to {most:,} triangles" if shown < most else ""
        return (
            f"The map is drawn at {len(stages)} times{blocks}{thinned}; law and guard flew by all of it, as it was "
            "at every instant."
        )


_SIDES = {"from above, left": (25.0, -60.0), "from above, right": (25.0, 120.0), "from below": (-35.0, 30.0)}
"""Elevation and azimuth, degrees."""
_COLUMNS = 700
_NEVER = (0.84, 0.37, 0.0)
_FAINT = 0.12
_ABOVE = 0.05
"""Metres from a point, towards the eye, from which the mesh may hide it."""
_PRESENT, _ABSENT = (ListedColormap(colormaps[name](np.linspace(0.3, 1.0, 256))) for name in ("YlOrRd", "Blues"))
"""Without their palest parts, which would not stand out from the grey mesh."""
_PLANES = (2, 1, 0)
"""Axes that the slices are across."""
_SAMPLES = 12_000
_SHORT = 0.002
"""Metres by which a ray to a place on the surface may end before it and still count as reaching it."""
_APART = 3.0
"""Metres that two sides of a sheet count as apart, so that a place takes its time from its own side."""
FREE, SURFACE, UNKNOWN, WAY, BLOCKING = range(5)
_COLOURS = {FREE: "#ffffff", SURFACE: "#e3c9a0", UNKNOWN: "#9db0c4", WAY: "#d6efdf", BLOCKING: "#d55e00"}
_WORDS = {
    FREE: "known free",
    SURFACE: "not known free, at returns",
    UNKNOWN: "unknown",
    WAY: "the chaser's centre can get here",
    BLOCKING: "unknown, and in the way or at the rim",
}


def taken(exploration: Exploration) -> list[Seen]:
    """Give the poses of the views that the map took in this flight, without those of a map that it went on from."""
    count = sum(view.status == "seen" for view in exploration.views)
    return exploration.map.seen[len(exploration.map.seen) - count :]


def draw_seen(path: Path, exploration: Exploration) -> None:
    """Draw the true surface from three sides, coloured by when it was first in an image, into one PNG."""
    target, sight = exploration.target, FirstSight(exploration)
    end = max([view.time for view in taken(exploration)], default=1.0)
    scale = ScalarMappable(Normalize(0.0, max(end, 1.0)), "viridis")
    with figure(path, width=11.0, height=4.6) as drawing:
        panels = drawing.subplots(1, 3)
        for axes, (name, side) in zip(panels, _SIDES.items()):
            view = rasterise(target.vertices, target.faces, eye_axes(*side), columns=_COLUMNS)
            times = sight.of_view(view)
            colours = scale.to_rgba(np.where(np.isfinite(times), times, 0.0))[..., :3]
            colours[np.isinf(times)] = _NEVER
            view.paint(axes, colours, least=READABLE)
            axes.set(title=name, ylabel="")
        bar = drawing.colorbar(scale, ax=panels, shrink=0.75)
        bar.set_label("first in an image at, s")
        drawing.suptitle(
            f"What was first in an image when; {exploration.seen_share:.0%} of the outer surface was seen", fontsize=10
        )
        never = Patch(facecolor=_NEVER, label="never in an image (inner surfaces cannot be)")
        drawing.legend(handles=[never], loc="outside lower center")


def draw_slices(path: Path, exploration: Exploration) -> None:
    """Draw the map in three planes through the target's middle, with the path, into one PNG."""
    target = exploration.target
    middle = 0.5 * (target.distance.lower + target.distance.upper)
    with figure(path, width=11.0, height=4.9) as drawing:
        shown: set[int] = set()
        for axes, axis in zip(drawing.subplots(1, 3), _PLANES):
            level = float(middle[axis])
            kinds, _ = _kinds_in_slice(exploration, axis, level)
            shown |= set(np.unique(kinds).tolist())
            _paint_slice(axes, exploration, kinds, axis, level, exploration.record.position)
        drawing.suptitle("The map at the end, in three planes through the target's middle", fontsize=10)
        _legend(drawing, shown, exploration)


def draw_progress(path: Path, exploration: Exploration) -> None:
    """Draw known-free room, what each view opened, and the distance to the goal, over time, into one PNG."""
    views, record, known = exploration.views, exploration.record, exploration.map
    time = np.array([view.time for view in views])
    seen = np.array([view.status == "seen" for view in views], dtype=bool)
    opened = np.array([view.opened for view in views], dtype=float) * known.spacing**3
    with figure(path, width=8.0, height=6.4) as drawing:
        room, each, way = drawing.subplots(3, 1, sharex=True)
        ball = 4.0 / 3.0 * np.pi * known.radius**3
        room.step(time, [view.free_volume for view in views], where="post", color=COLOURS[0])
        room.set(ylabel="free room, m³", title=f"Known-free room inside the declared ball, which holds {ball:.0f} m³")
        room.set_ylim(bottom=0.0)
        each.vlines(time[seen], 0.0, opened[seen], color=COLOURS[2], linewidth=1.2)
        each.plot(time[seen], opened[seen], "o", color=COLOURS[2], markersize=3, label="view taken in")
        if not seen.all():
            refused = sorted({view.status for view in views if view.status != "seen"})
            words = ", ".join(status.replace("_", " ") for status in refused)
            each.plot(time[~seen], np.zeros((~seen).sum()), "x", color=COLOURS[1], label=f"refused: {words}")
        each.set(ylabel="opened, m³", title=f"Opened by each of {len(views)} views")
        each.set_ylim(bottom=-0.04 * max(float(opened.max(initial=0.0)), 1e-3))
        each.legend(fontsize=8)
        way.plot(record.time, exploration.flight.clearance, color=COLOURS[0], label="clearance on the true mesh")
        if exploration.scenario.explore.towards == "goal":
            away = np.linalg.norm(record.position - np.asarray(exploration.scenario.goal.position), axis=1)
            way.plot(record.time, away, color=COLOURS[4], label="distance to the goal")
        way.axhline(0.0, color="black", linewidth=0.8)
        way.set(ylabel="distance, m", xlabel="time, s", title="The chaser")
        way.legend(fontsize=8)


def draw_unknown(path: Path, exploration: Exploration) -> None:
    """Draw the unknown cells that mattered at the end into one PNG: in the way to the goal, or left at the rim.

    Three planes through the goal, or through the middle of those cells; and all of them from one side.
    """
    known = exploration.map
    goal, unknown = np.asarray(exploration.scenario.goal.position), exploration.unknown
    through = goal if exploration.scenario.explore.towards == "goal" else np.median(unknown, axis=0)
    end = exploration.record.position[-1:]
    reach = reachable(known, end[0], exploration.keep)
    with figure(path, width=11.0, height=9.6) as drawing:
        shown: set[int] = set()
        for place, axis in enumerate(_PLANES, start=1):
            axes = drawing.add_subplot(2, 2, place)
            level = float(through[axis])
            kinds, centres = _kinds_in_slice(exploration, axis, level)
            nodes = np.rint((centres - reach.origin) / reach.spacing).astype(int)
            nodes = np.clip(nodes, 0, np.array(reach.reached.shape) - 1)
            kinds[(kinds == FREE) & reach.reached[tuple(np.moveaxis(nodes, -1, 0))]] = WAY
            in_way = _cubes_at(exploration, unknown, centres)
            kinds[in_way & np.isin(kinds, (UNKNOWN, SURFACE))] = BLOCKING
            shown |= set(np.unique(kinds).tolist())
            _paint_slice(axes, exploration, kinds, axis, level, end, outside=WAY)
        _in_the_way(drawing.add_subplot(2, 2, 4), exploration)
        edge = ACROSS * known.spacing
        where = "in the way to the goal" if exploration.outcome == "no way known" else "left at the rim of free room"
        drawing.suptitle(f"{len(unknown)} unknown cells of {edge:g} m are {where}", fontsize=10)
        _legend(drawing, shown | {BLOCKING}, exploration, path="the chaser at the end")


def draw_departures(path: Path, exploration: Exploration) -> None:
    """Draw where the seen surface departs from the expected mesh, and by how much, into one PNG."""
    found, expected = exploration.departures, exploration.expected
    if found is None or expected is None:
        return
    kinds = [
        (found.missing, found.depth, _ABSENT, "expected, but free: m deep"),
        (found.points, found.distance, _PRESENT, "seen, not expected: m off the mesh"),
    ]
    scales = [Normalize(0.0, max(float(length.max(initial=0.0)), 1e-3)) for _, length, *_ in kinds]
    with figure(path, width=11.0, height=4.9) as drawing:
        panels = drawing.subplots(1, 3)
        for axes, (name, side) in zip(panels, _SIDES.items()):
            eye = eye_axes(*side)
            view = rasterise(expected.vertices, expected.faces, eye, columns=_COLUMNS)
            view.paint(axes)
            for (points, length, colours, _), scale in zip(kinds, scales):
                hidden, flat = view.hides(points + _ABOVE * eye[2]), points @ eye.T
                for chosen, alpha in ((hidden, _FAINT), (~hidden, 1.0)):
                    look = {"cmap": colours, "norm": scale, "s": 5, "alpha": alpha, "linewidths": 0}
                    axes.scatter(*flat[chosen, :2].T, c=length[chosen], **look)
            axes.set(title=name, ylabel="")
        for (_, length, colours, words), scale in reversed(list(zip(kinds, scales))):
            bar = drawing.colorbar(ScalarMappable(scale, colours), ax=panels, shrink=0.75, pad=0.01)
            bar.set_label(words if len(length) else f"{words} (none)")
        nothing = "" if len(found.points) + len(found.missing) else " nowhere"
        drawing.suptitle(
            f"Departures from the expected mesh (grey){nothing}, beyond the sensor's error bounds; "
            f"the largest is {found.largest:.2f} m. What the mesh hides is faint.",
            fontsize=10,
        )


class FirstSight:
    """Times of first sight at places spread over the true mesh, by the poses of the views that the map took."""

    def __init__(self, exploration: Exploration) -> None:
        target, entry = exploration.target, exploration.scenario.depth_sensor
        first_hit, camera = FirstHit(target.vertices, target.faces), pinhole(exploration.scenario)
        mesh = trimesh.Trimesh(target.vertices, target.faces, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)[:2]
        self._normals = first_hit.normals
        self.points: Float[np.ndarray, "n 3"] = np.asarray(points)
        self.times: Float[np.ndarray, " n"] = np.full(len(self.points), np.inf)
        """s; inf: never."""
        normals = self._normals[faces]
        self._tree = KDTree(np.concatenate([self.points, _APART * normals], axis=1))
        slopes = 0.5 * np.array([camera.width, camera.height]) / camera.focal
        for view in taken(exploration):
            unseen = np.flatnonzero(np.isinf(self.times))
            away = self.points[unseen] - view.position
            depth = away @ view.axes
            within = (depth[:, 2] > 0.0) & (np.abs(depth[:, :2]) <= slopes * depth[:, 2:]).all(axis=1)
            length = np.linalg.norm(away, axis=1)
            within &= (length > _SHORT) & (length <= entry.greatest_range)
            upright = np.abs(np.einsum("ni,ni->n", away, normals[unseen])) > np.cos(entry.grazing_angle) * length
            chosen = np.flatnonzero(within & upright)
            ranges = first_hit.ranges(view.position[None], away[chosen])
            self.times[unseen[chosen[ranges >= length[chosen] - _SHORT]]] = view.time

    def of_view(self, view: View) -> Float[np.ndarray, "rows columns"]:
        """Give the time of what is seen at each pixel of a picture of the target, s; inf: never; nan: nothing there."""
        places = np.concatenate([view.places(), _APART * self._normals[view.face[view.hit]]], axis=1)
        times = np.full(view.face.shape, np.nan)
        times[view.hit] = self.times[self._tree.query(places)[1]]
        return times


def _cubes_at(
    exploration: Exploration, cells: Float[np.ndarray, "m 3"], centres: Float[np.ndarray, "n n 3"]
) -> np.ndarray:
    """Say which cubes of a slice lie in cells (`ACROSS` cubes wide) with these centres."""
    known, held = exploration.map, np.zeros_like(whole_blocks(exploration.map.free, ACROSS))
    held_at, asked = (
        tuple(np.moveaxis(np.floor((places - known.origin) / (ACROSS * known.spacing)).astype(int), -1, 0))
        for places in (cells, centres)
    )
    held[held_at] = True
    return held[asked]


def _in_the_way(axes: Axes, exploration: Exploration) -> None:
    eye, goal = eye_axes(*_SIDES["from above, left"]), exploration.scenario.goal.position
    goals = [goal] if exploration.scenario.explore.towards == "goal" else []
    paint_paths(axes, exploration.target, {"path": exploration.record.position}, goals, eye)
    axes.scatter(*(exploration.unknown @ eye.T)[:, :2].T, linewidths=0, color=COLOURS[1], s=4, alpha=0.5)
    axes.set(title="all of it, from above, left; the true target in grey", ylabel="")


def _kinds_in_slice(
    exploration: Exploration, axis: int, level: float
) -> tuple[Int[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]:
    """Sort the cubes that the plane {axis = level} cuts: their kinds, and their centres, m.

    Args:
        exploration: of whose map they are; a cube that is not free and `explore.explained` near to a return is at the
            surface.
        axis: 0, 1 or 2.
        level: m; a plane outside the box takes its outermost cubes.

    """
    known, explained = exploration.map, exploration.scenario.explore.explained
    place = int(np.clip(np.floor((level - known.origin[axis]) / known.spacing), 0, len(known.free) - 1))
    free = np.take(known.free, place, axis=axis)
    along = list(known.origin[:, None] + known.spacing * (np.arange(len(free)) + 0.5))
    along[axis] = along[axis][place : place + 1]
    centres = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).squeeze(axis)
    kinds = np.where(free, FREE, UNKNOWN)
    if len(known.returns):
        distance, _ = KDTree(known.returns).query(centres[~free], distance_upper_bound=explained)
        kinds[~free] = np.where(np.isfinite(distance), SURFACE, UNKNOWN)
    return kinds, centres


def _paint_slice(
    axes: Axes,
    exploration: Exploration,
    kinds: Int[np.ndarray, "n n"],
    axis: int,
    level: float,
    path: Float[np.ndarray, "rows 3"],
    *,
    outside: int = FREE,
) -> None:
    """Paint a slice with the true mesh's cut, the returns next to the plane, declared ball, path, and goal.

    `outside` is the kind of the room outside the map's box.
    """
    known, target, scenario = exploration.map, exploration.target, exploration.scenario
    across, up = (k for k in range(3) if k != axis)
    lower, upper = known.origin, known.upper
    axes.imshow(
        kinds.T,
        origin="lower",
        extent=(lower[across], upper[across], lower[up], upper[up]),
        cmap=ListedColormap([_COLOURS[k] for k in range(5)]),
        vmin=-0.5,
        vmax=4.5,
        interpolation="nearest",
    )
    near = known.returns[np.abs(known.returns[:, axis] - level) <= 0.5 * known.spacing]
    axes.plot(near[:, across], near[:, up], ",", color="#a0522d", alpha=0.7)
    mesh = trimesh.Trimesh(target.vertices, target.faces, process=False)
    cut = np.asarray(trimesh.intersections.mesh_plane(mesh, np.eye(3)[axis], level * np.eye(3)[axis]))
    axes.add_collection(LineCollection(list(cut[:, :, [across, up]]), colors="black", linewidths=0.7))
    off = level - known.centre[axis]
    if abs(off) < known.radius:
        radius = float(np.sqrt(known.radius**2 - off**2))
        ball = Circle((known.centre[across], known.centre[up]), radius, fill=False, color="grey", linestyle=":")
        axes.add_patch(ball)
    axes.plot(path[:, across], path[:, up], color="#0072B2", linewidth=1.0)
    if len(path) > 1:
        axes.plot(path[0, across], path[0, up], "s", color="#0072B2", markersize=4)
    axes.plot(path[-1, across], path[-1, up], "o", color="#0072B2", markersize=4)
    everything = np.concatenate([path[:, [across, up]], [lower[[across, up]] + 0.5], [upper[[across, up]] - 0.5]])
    low, high = everything.min(axis=0) - 0.5, everything.max(axis=0) + 0.5
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", facecolor=_COLOURS[outside])
    axes.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m", title=f"{'xyz'[axis]} = {level + 0.0:z.1f} m")
    axes.grid(visible=False)
    if scenario.explore.towards == "goal":
        axes.plot(scenario.goal.position[across], scenario.goal.position[up], "*", color="black", markersize=9)


def _legend(drawing: Figure, shown: set[int], exploration: Exploration, *, path: str = "path, projected") -> None:
    lines = [
        Line2D([], [], color="black", linewidth=0.8, label="true mesh, cut"),
        Line2D([], [], color="#0072B2", marker="o", markersize=4, linewidth=1.0, label=path),
        Line2D([], [], color="grey", linestyle=":", label="declared ball"),
    ]
    if exploration.scenario.explore.towards == "goal":
        lines.append(Line2D([], [], color="black", marker="*", linestyle="", label="goal, projected"))
    kinds = [Patch(facecolor=_COLOURS[k], edgecolor="grey", linewidth=0.5, label=_WORDS[k]) for k in sorted(shown)]
    drawing.legend(handles=[*kinds, *lines], loc="outside lower center", ncols=4)

"""Pictures of an exploration: what was seen when, the map in slices, its growth, what is in the way, what departs."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown.cells import ACROSS
from keepout.apps.unknown.exploration import Exploration
from keepout.apps.unknown.first_sight import FirstSight
from keepout.apps.unknown.known_free import Seen
from keepout.apps.unknown.map_slices import (
    BLOCKING,
    FREE,
    SURFACE,
    UNKNOWN,
    WAY,
    kinds_in_slice,
    legend_of,
    paint_slice,
)
from keepout.apps.unknown.ways import reachable
from keepout.core.geometry.first_hit import FirstHit
from keepout.core.geometry.target import Target
from keepout.flights.report.raster import eye_axes, rasterise
from keepout.flights.report.style import COLOURS, figure

_SIDES = {"from above, left": (25.0, -60.0), "from above, right": (25.0, 120.0), "from below": (-35.0, 30.0)}
"""Elevation and azimuth, degrees."""
_COLUMNS = 700
_NEVER = np.array([0.84, 0.37, 0.0])
_GREY = np.array([0.82, 0.85, 0.9])
_SHADE = 0.6
"""Share of the light that every place gets: colours that are read must not turn dark."""
_FAINT = 0.12
_ABOVE = 0.05
"""Metres from a point, towards the eye, from which the mesh may hide it."""
_PRESENT, _ABSENT = (ListedColormap(colormaps[name](np.linspace(0.3, 1.0, 256))) for name in ("YlOrRd", "Blues"))
"""Without their palest parts, which would not stand out from the grey mesh."""
_PLANES = (2, 1, 0)
"""Axes that the slices are across."""


def camera_of(exploration: Exploration) -> Pinhole:
    """Give the camera that the views were taken with."""
    entry = exploration.scenario.depth_sensor
    return Pinhole(entry.width, entry.height, entry.field_of_view)


def taken(exploration: Exploration) -> list[Seen]:
    """Give the poses of the views that the map took in this flight, without those of a map that it went on from."""
    count = sum(view.status == "seen" for view in exploration.views)
    return exploration.map.seen[len(exploration.map.seen) - count :]


def draw_seen(path: Path, exploration: Exploration) -> None:
    """Draw the true surface from three sides, coloured by when it was first in an image, into one PNG."""
    target, entry, views = exploration.target, exploration.scenario.depth_sensor, taken(exploration)
    sight = FirstSight(
        target,
        views,
        camera_of(exploration),
        greatest_range=entry.greatest_range,
        grazing_angle=entry.grazing_angle,
    )
    end = max([view.time for view in views], default=1.0)
    scale = ScalarMappable(Normalize(0.0, max(end, 1.0)), "viridis")
    with figure(path, width=11.0, height=4.6) as drawing:
        panels = drawing.subplots(1, 3)
        for axes, (name, (elevation, azimuth)) in zip(panels, _SIDES.items()):
            view = rasterise(target.vertices, target.faces, elevation=elevation, azimuth=azimuth, columns=_COLUMNS)
            times = sight.of_picture(target, view, elevation=elevation, azimuth=azimuth)
            colours = scale.to_rgba(np.where(np.isfinite(times), times, 0.0))[..., :3]
            colours[np.isinf(times)] = _NEVER
            light = _SHADE + (1.0 - _SHADE) * view.light[..., None]
            picture = np.concatenate([colours * light, view.hit[..., None].astype(float)], axis=2)
            axes.imshow(picture, origin="lower", extent=view.extent)
            axes.set(title=name, xlabel="m")
            axes.grid(visible=False)
        bar = drawing.colorbar(scale, ax=panels, shrink=0.75)
        bar.set_label("first in an image at, s")
        share = float(np.mean(np.isfinite(sight.times)))
        drawing.suptitle(
            f"What was seen when: {share:.0%} of the true surface, each side by itself, was in an image; "
            f"{exploration.seen_share:.0%} of its outer part is near a return",
            fontsize=10,
        )
        never = Patch(facecolor=tuple(_NEVER), label="never in an image (inner surfaces cannot be)")
        drawing.legend(handles=[never], loc="outside lower center")


def draw_slices(path: Path, exploration: Exploration) -> None:
    """Draw the map in three planes through the target's middle, with the path, into one PNG."""
    known, target = exploration.map, exploration.target
    middle = 0.5 * (target.distance.lower + target.distance.upper)
    with figure(path, width=11.0, height=4.9) as drawing:
        shown: set[int] = set()
        for axes, axis in zip(drawing.subplots(1, 3), _PLANES):
            level = float(middle[axis])
            kinds, _ = kinds_in_slice(known, axis, level, explained=exploration.scenario.explore.explained)
            shown |= set(np.unique(kinds).tolist())
            paint_slice(axes, known, kinds, axis, level, target=target, path=exploration.record.position)
            _goal(axes, exploration, axis)
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
        room.set(ylabel="m³", title=f"Known-free room inside the declared ball, which holds {ball:.0f} m³")
        room.set_ylim(bottom=0.0)
        each.vlines(time[seen], 0.0, opened[seen], color=COLOURS[2], linewidth=1.2)
        each.plot(time[seen], opened[seen], "o", color=COLOURS[2], markersize=3, label="view taken in")
        if not seen.all():
            refused = sorted({view.status for view in views if view.status != "seen"})
            words = ", ".join(status.replace("_", " ") for status in refused)
            each.plot(time[~seen], np.zeros((~seen).sum()), "x", color=COLOURS[1], label=f"refused: {words}")
        each.set(ylabel="m³", title=f"Opened by each of {len(views)} views")
        each.set_ylim(bottom=-0.04 * max(float(opened.max(initial=0.0)), 1e-3))
        each.legend(fontsize=8)
        distance = exploration.target.distance.distance(record.position) - exploration.scenario.chaser.radius
        way.plot(record.time, distance, color=COLOURS[0], label="clearance on the true mesh")
        if exploration.scenario.explore.towards == "goal":
            away = np.linalg.norm(record.position - np.asarray(exploration.scenario.goal.position), axis=1)
            way.plot(record.time, away, color=COLOURS[4], label="distance to the goal")
        way.axhline(0.0, color="black", linewidth=0.8)
        way.set(ylabel="m", xlabel="time s", title="The chaser")
        way.legend(fontsize=8)


def draw_unknown(path: Path, exploration: Exploration) -> None:
    """Draw the unknown cells that mattered at the end into one PNG: in the way to the goal, or left at the rim.

    Three planes through the goal, or through the middle of those cells; and all of them from one side.
    """
    known, target = exploration.map, exploration.target
    goal, unknown = np.asarray(exploration.scenario.goal.position), exploration.unknown
    through = goal if exploration.scenario.explore.towards == "goal" else np.median(unknown, axis=0)
    end = exploration.record.position[-1:]
    reach = reachable(known, end[0], exploration.keep)
    with figure(path, width=11.0, height=9.6) as drawing:
        shown: set[int] = set()
        for place, axis in enumerate(_PLANES, start=1):
            axes = drawing.add_subplot(2, 2, place)
            level = float(through[axis])
            kinds, centres = kinds_in_slice(known, axis, level, explained=exploration.scenario.explore.explained)
            nodes = np.rint((centres - reach.origin) / reach.spacing).astype(int)
            nodes = np.clip(nodes, 0, np.array(reach.reached.shape) - 1)
            kinds[(kinds == FREE) & reach.reached[tuple(np.moveaxis(nodes, -1, 0))]] = WAY
            in_way = _cubes_at(exploration, unknown, centres)
            kinds[in_way & np.isin(kinds, (UNKNOWN, SURFACE))] = BLOCKING
            shown |= set(np.unique(kinds).tolist())
            paint_slice(axes, known, kinds, axis, level, target=target, path=end, outside=WAY)
            _goal(axes, exploration, axis)
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
    first_hit = FirstHit(expected.vertices, expected.faces)
    kinds = [
        (found.missing, found.depth, _ABSENT, "expected, but free: m deep"),
        (found.points, found.distance, _PRESENT, "seen, not expected: m off the mesh"),
    ]
    with figure(path, width=11.0, height=4.9) as drawing:
        panels = drawing.subplots(1, 3)
        for axes, (name, side) in zip(panels, _SIDES.items()):
            _grey(axes, expected, side)
            for points, length, colours, _ in kinds:
                hidden = _hidden(first_hit, points, side)
                most = max(float(length.max(initial=0.0)), 1e-3)
                for chosen, alpha in ((hidden, _FAINT), (~hidden, 1.0)):
                    look = {"c": length[chosen], "cmap": colours, "vmin": 0.0, "vmax": most, "s": 5, "alpha": alpha}
                    _scatter(axes, expected, points[chosen], side, **look)
            axes.set(title=name, xlabel="m")
        for _, length, colours, words in reversed(kinds):
            scale = Normalize(0.0, max(float(length.max(initial=0.0)), 1e-3))
            bar = drawing.colorbar(ScalarMappable(scale, colours), ax=panels, shrink=0.75, pad=0.01)
            bar.set_label(words if len(length) else f"{words} (none)")
        nothing = "" if len(found.points) + len(found.missing) else " nowhere"
        drawing.suptitle(
            f"Departures from the expected mesh (grey){nothing}, beyond the sensor's error bounds; "
            f"the largest is {found.largest:.2f} m. What the mesh hides is faint.",
            fontsize=10,
        )


def _cubes_at(
    exploration: Exploration, cells: Float[np.ndarray, "m 3"], centres: Float[np.ndarray, "n n 3"]
) -> np.ndarray:
    """Say which cubes of a slice lie in cells (`ACROSS` cubes wide) with these centres."""
    edge = ACROSS * exploration.map.spacing
    keys = {tuple(key) for key in np.floor((cells - exploration.map.origin) / edge).astype(int).tolist()}
    asked = np.floor((centres - exploration.map.origin) / edge).astype(int).reshape(-1, 3).tolist()
    return np.array([tuple(key) in keys for key in asked], dtype=bool).reshape(centres.shape[:2])


def _in_the_way(axes: Axes, exploration: Exploration) -> None:
    target, side = exploration.target, _SIDES["from above, left"]
    _grey(axes, target, side)
    _scatter(axes, target, exploration.unknown, side, color=COLOURS[1], s=4, alpha=0.5)
    path = _flat(target, exploration.record.position, side)
    axes.plot(path[:, 0], path[:, 1], color=COLOURS[0], linewidth=1.0)
    axes.plot(path[-1:, 0], path[-1:, 1], "o", color=COLOURS[0], markersize=4)
    if exploration.scenario.explore.towards == "goal":
        goal = _flat(target, np.asarray(exploration.scenario.goal.position)[None], side)
        axes.plot(goal[:, 0], goal[:, 1], "*", color="black", markersize=9)
    axes.set(title="all of it, from above, left; the true target in grey", xlabel="m")


def _grey(axes: Axes, target: Target, side: tuple[float, float]) -> None:
    view = rasterise(target.vertices, target.faces, elevation=side[0], azimuth=side[1], columns=_COLUMNS)
    picture = np.concatenate([_GREY * view.light[..., None], view.hit[..., None].astype(float)], axis=2)
    axes.imshow(picture, origin="lower", extent=view.extent)
    axes.grid(visible=False)
    axes.set_aspect("equal")


def _flat(target: Target, points: Float[np.ndarray, "n 3"], side: tuple[float, float]) -> Float[np.ndarray, "n 2"]:
    """Place points in the picture that `rasterise` makes of a target."""
    middle = 0.5 * (target.vertices.min(axis=0) + target.vertices.max(axis=0))
    return ((points - middle) @ eye_axes(*side).T)[:, :2]


def _hidden(first_hit: FirstHit, points: Float[np.ndarray, "n 3"], side: tuple[float, float]) -> Bool[np.ndarray, "n"]:
    """Say which points a mesh hides from an eye at infinity."""
    eye = eye_axes(*side)[2]
    rays = np.broadcast_to(eye, points.shape)
    return np.isfinite(first_hit.ranges(points + _ABOVE * eye, rays))


def _scatter(axes: Axes, target: Target, points: Float[np.ndarray, "n 3"], side: tuple[float, float], **look) -> None:
    if len(points):
        axes.scatter(*_flat(target, points, side).T, linewidths=0, **look)


def _goal(axes: Axes, exploration: Exploration, axis: int) -> None:
    if exploration.scenario.explore.towards == "goal":
        across, up = (k for k in range(3) if k != axis)
        goal = exploration.scenario.goal.position
        axes.plot(goal[across], goal[up], "*", color="black", markersize=9)


def _legend(drawing: Figure, shown: set[int], exploration: Exploration, *, path: str = "path, projected") -> None:
    lines = [
        Line2D([], [], color="black", linewidth=0.8, label="true mesh, cut"),
        Line2D([], [], color="#0072B2", marker="o", markersize=4, linewidth=1.0, label=path),
        Line2D([], [], color="grey", linestyle=":", label="declared ball"),
    ]
    if exploration.scenario.explore.towards == "goal":
        lines.append(Line2D([], [], color="black", marker="*", linestyle="", label="goal, projected"))
    drawing.legend(handles=[*legend_of(shown), *lines], loc="outside lower center", ncols=4)

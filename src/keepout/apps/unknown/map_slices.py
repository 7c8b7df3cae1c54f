"""Planes through a map of known-free room, drawn as kinds of cubes."""

import numpy as np
import trimesh
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.patches import Circle, Patch
from scipy.spatial import KDTree

from keepout.apps.unknown.known_free import KnownFreeMap
from keepout.core.geometry.target import Target

FREE, SURFACE, UNKNOWN, WAY, BLOCKING = range(5)
_COLOURS = {FREE: "#ffffff", SURFACE: "#e3c9a0", UNKNOWN: "#9db0c4", WAY: "#d6efdf", BLOCKING: "#d55e00"}
_WORDS = {
    FREE: "known free",
    SURFACE: "not known free, at returns",
    UNKNOWN: "unknown",
    WAY: "the chaser's centre can get here",
    BLOCKING: "unknown, and in the way or at the rim",
}
_NAMES = "xyz"


def kinds_in_slice(
    known: KnownFreeMap, axis: int, level: float, *, explained: float
) -> tuple[Int[np.ndarray, "n n"], Float[np.ndarray, "n n 3"]]:
    """Sort the cubes that the plane {axis = level} cuts: their kinds, and their centres, m.

    Args:
        known: the map.
        axis: 0, 1 or 2.
        level: m; a plane outside the box takes its outermost cubes.
        explained: a cube that is not free and this near to a return is at the surface, m.

    """
    place = int(np.clip(np.floor((level - known.origin[axis]) / known.spacing), 0, len(known.free) - 1))
    free = np.take(known.free, place, axis=axis)
    others = [k for k in range(3) if k != axis]
    centres = np.empty((*free.shape, 3))
    along = known.spacing * (np.arange(len(free)) + 0.5)
    centres[..., others[0]] = known.origin[others[0]] + along[:, None]
    centres[..., others[1]] = known.origin[others[1]] + along
    centres[..., axis] = known.origin[axis] + known.spacing * (place + 0.5)
    kinds = np.where(free, FREE, UNKNOWN)
    if len(known.returns):
        distance, _ = KDTree(known.returns).query(centres[~free], distance_upper_bound=explained)
        kinds[~free] = np.where(np.isfinite(distance), SURFACE, UNKNOWN)
    return kinds, centres


def paint_slice(
    axes: Axes,
    known: KnownFreeMap,
    kinds: Int[np.ndarray, "n n"],
    axis: int,
    level: float,
    *,
    target: Target,
    path: Float[np.ndarray, "rows 3"],
    outside: int = FREE,
) -> None:
    """Paint a slice with the true mesh's cut, the returns next to the plane, the declared ball, and the path.

    `outside` is the kind of the room outside the map's box.
    """
    across, up = (k for k in range(3) if k != axis)
    lower, upper = known.lower, known.upper
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
    axes.set(xlabel=f"{_NAMES[across]} m", ylabel=f"{_NAMES[up]} m", title=f"{_NAMES[axis]} = {level + 0.0:z.1f} m")
    axes.grid(visible=False)


def legend_of(kinds: set[int]) -> list[Patch]:
    """Give a patch for each kind, in order, with its words."""
    return [Patch(facecolor=_COLOURS[k], edgecolor="grey", linewidth=0.5, label=_WORDS[k]) for k in sorted(kinds)]

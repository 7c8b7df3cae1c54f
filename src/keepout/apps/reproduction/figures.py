"""Figures of the parts, as the paper has them, for print in one column: PNG and SVG."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from matplotlib.ticker import NullFormatter

from keepout.apps.reproduction.in_memory import FlightSeries
from keepout.core.mission.flight import Flight
from keepout.flights.pages.figures import BANDS, COLOURS, COLUMN, column, draw_bands, draw_signal, logarithmic, looks
from keepout.flights.pages.mesh_pictures import View, eye_axes, paint_paths, rasterise
from keepout.flights.surface import Ellipsoid

_MARKERS = ("o", "s", "^", "D", "v")
_TOLD = {"trapped": "trapped", "clean": "arrived untouched", "touched": "touched"}
_POINTS = 1500
"""Of a line: more than can be told apart in print."""
SIDE = 28.0, -55.0
"""Elevation and azimuth of the eye that looks at learned surfaces, degrees."""
_TITLE = 0.36
"""Inches that a panel's title and axis take."""
QUANTITIES = {
    **{"barrier": "h, m", "lyapunov": "V₁, m²", "position_error": "‖r − goal‖, m"},
    "axis_speed": "largest |vᵢ|, m/s",
}
"""That are drawn of many flights, top to bottom, with their labels."""
WORST = 3
"""Flights drawn by themselves in each panel."""
_SAMPLES = 600
"""Of a band: more than can be told apart in print."""
_LEAST = 1e-4
"""Lower end of a logarithmic axis, in its unit."""

Line = tuple[Any, Any]
"""Times, s, or steps, and values."""
Curve = Mapping[str, Sequence[float] | Sequence[int]]
"""Of a fit: `steps`, `value_term`, `gradient_term` and `mean_error_m`."""


class Triangles(NamedTuple):
    """A surface: vertices in metres, and faces."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def draw_training(path: Path, curves: Mapping[str, Curve]) -> None:
    """Draw both terms of the loss, and the mean error, over the steps of several fits, by target."""
    keys = ("value_term", "gradient_term", "mean_error_m")
    lines = [{name: (curve["steps"], curve[key]) for name, curve in curves.items()} for key in keys]
    with _lines(path, 5.2, lines) as panels:
        panels[0].set(yscale="log", ylabel="L_P (normalised)")
        panels[1].set(yscale="log", ylabel="η L_E (normalised)")
        panels[2].set(ylabel="mean f̃ − d, m", xlabel="step")
        panels[2].set_yscale("symlog", linthresh=0.01)
        panels[2].axhline(0.0, color="black", linewidth=0.8)
        panels[0].legend()


def draw_sinking(path: Path, curves: Mapping[str, Curve]) -> None:
    """Draw the mean error over the steps of fits of one target, by reading of the loss."""
    last = min(curve["steps"][-1] for curve in curves.values())
    lines = {}
    for name, curve in curves.items():
        shown = sum(step <= last for step in curve["steps"])
        lines[name] = curve["steps"][:shown], curve["mean_error_m"][:shown]
    with _lines(path, 2.6, [lines], marker="o", markersize=3) as [axes]:
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="step", ylabel="mean f̃ − d, m")
        axes.legend()


def draw_surfaces(path: Path, surfaces: Mapping[str, Triangles]) -> None:
    """Draw surfaces of one target below each other, seen from the same side, by title."""
    views = {title: _seen(surface) for title, surface in surfaces.items()}
    shapes = [view.shape for view in views.values()]
    with column(path, sum((COLUMN - 0.5) * shape + _TITLE for shape in shapes) + 0.2) as drawing:
        panels = drawing.subplots(len(views), 1, squeeze=False, sharex=True, height_ratios=shapes)[:, 0]
        for axes, (title, view) in zip(panels, views.items()):
            view.paint(axes)
            axes.set(title=title, xlabel="")
        panels[-1].set_xlabel("m")


def draw_ellipsoids(path: Path, targets: Mapping[str, tuple[Triangles, Ellipsoid]]) -> None:
    """Draw for each target its learned surface inside the ellipsoid, seen from one side, by title."""
    outlines = [outline(ellipsoid) for _, ellipsoid in targets.values()]
    shapes = [height / width for width, height in map(extent, outlines)]
    with column(path, sum((COLUMN - 0.5) * shape + _TITLE for shape in shapes) + 0.2) as drawing:
        panels = drawing.subplots(len(targets), 1, squeeze=False, height_ratios=shapes)[:, 0]
        for axes, (title, (surface, ellipsoid)), of in zip(panels, targets.items(), outlines):
            x, y = (eye_axes(*SIDE) @ ellipsoid.centre)[:2]
            lengths, directions = np.linalg.eigh(of)
            width, tall = 2.0 * np.sqrt(lengths)
            angle = float(np.degrees(np.arctan2(directions[1, 0], directions[0, 0])))
            for look in (
                {"facecolor": COLOURS[5], "alpha": 0.25, "zorder": 0.5},
                {"fill": False, "edgecolor": COLOURS[0]},
            ):
                axes.add_patch(Ellipse((float(x), float(y)), width, tall, angle=angle, **look))
            _seen(surface).paint(axes, zorder=1.0)
            across, up = 0.52 * np.array(extent(of))
            axes.set(xlim=(x - across, x + across), ylim=(y - up, y + up), title=title, xlabel="")
        panels[-1].set_xlabel("m")


def _seen(surface: Triangles) -> View:
    return rasterise(surface.vertices, surface.faces, eye_axes(*SIDE), columns=1600)


def outline(ellipsoid: Ellipsoid) -> Float[np.ndarray, "2 2"]:
    """Give P of an ellipsoid's silhouette {x : xᵀ P⁻¹ x ≤ 1}, from its middle, in the axes of the picture."""
    axes = eye_axes(*SIDE)[:2]
    return axes @ np.linalg.inv(ellipsoid.matrix) @ axes.T


def extent(outline: Float[np.ndarray, "2 2"]) -> tuple[float, float]:
    """Width and height of a silhouette, metres."""
    return 2.0 * float(np.sqrt(outline[0, 0])), 2.0 * float(np.sqrt(outline[1, 1]))


def draw_case(folder: Path, flights: Mapping[str, Flight], *, suffix: str, remark: str) -> dict[str, str]:
    """Draw flights of Case 1 as the paper does; the first two are those without and with circulation.

    Args:
        folder: to draw into.
        flights: by name.
        suffix: of the files' names.
        remark: ends each caption, as ", 20 Hz".

    Returns:
        Caption of each figure, by name.

    """
    names = list(flights)
    pair = {name: flights[name] for name in names[:2]}
    first = flights[names[0]]
    told = f"k_p = {first.scenario.control.paper.slowing_length:g} m{remark}"
    _draw_path_panels(folder / f"paths{suffix}.png", flights, {names[0]: names[:1], names[1]: names[1:]}, (18.0, -25.0))
    barriers = {name: (flight.record.time, flight.record.barrier) for name, flight in flights.items()}
    with _lines(folder / f"barrier{suffix}.png", 2.6, [barriers]) as [axes]:
        axes.axhline(0.0, color="black", linewidth=0.8)
        # Linear to a decimetre, so that the sign is seen where h comes near zero.
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set(xlabel="time, s", ylabel="barrier h, m")
        axes.legend()
    errors = {name: (flight.record.time, goal_error(flight)) for name, flight in flights.items()}
    with _lines(folder / f"error{suffix}.png", 2.6, [errors]) as [axes]:
        axes.axhline(first.scenario.goal.tolerance, color="grey", linewidth=0.8, linestyle=":")
        axes.set(xlabel="time, s", ylabel="position error ‖r_e‖, m", yscale="log")
        axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.78))
    _draw_by_axis(folder / f"safe-velocity{suffix}.png", pair, "safe_velocity", "v_s, m/s")
    _draw_by_axis(folder / f"velocity{suffix}.png", pair, "velocity", "v, m/s")
    return {
        f"paths{suffix}": f"Paths (start: square, end: disc, goal: star), {told}",
        f"barrier{suffix}": f"Barrier h of the law's own field, linear up to 0.1 m, {told}",
        f"error{suffix}": f"Distance to the goal, and its tolerance (dotted), {told}",
        f"safe-velocity{suffix}": f"Safe velocity by axis, and ±v_max (dotted), {told}",
        f"velocity{suffix}": f"Velocity by axis, and ±v_max (dotted), {told}",
    }


def goal_error(flight: Flight) -> Float[np.ndarray, "N"]:
    """Give the distance to the goal, m."""
    return np.linalg.norm(flight.record.position - np.asarray(flight.scenario.goal.position), axis=1)


@contextmanager
def _lines(path: Path, height: float, panels: Sequence[Mapping[str, Line]], **style: Any) -> Iterator[list[Axes]]:
    """Draw lines by label in panels one above the other, to be finished; a label has one look in all of them."""
    looks = {name: look for (name, _), look in _looks({name: 0 for lines in panels for name in lines})}
    with column(path, height) as drawing:
        every = list(drawing.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0])
        for axes, lines in zip(every, panels):
            for name, (along, values) in lines.items():
                axes.plot(along, values, label=name, **looks[name] | style)
        yield every


def draw_wing(folder: Path, flights: Mapping[str, Flight]) -> dict[str, str]:
    """Draw the paths across a wing; returns the figure's caption, by name."""
    scenario = next(iter(flights.values())).scenario
    _draw_path_panels(folder / "wing.png", flights, {name: [name] for name in flights}, (20.0, -60.0))
    start, goal, length = scenario.start.position, scenario.goal.position, scenario.control.paper.slowing_length
    told = f"From {start} to {goal} m, across a wing, k_p = {length:g} m (start: square, end: disc, goal: star)"
    return {"wing": told}


def _draw_path_panels(
    path: Path, flights: Mapping[str, Flight], panels: Mapping[str, Sequence[str]], side: tuple[float, float]
) -> None:
    """Draw the flights named for each panel, side by side around their target."""
    first = next(iter(flights.values()))
    looked = dict(zip(flights, looks(len(flights))))
    with column(path, 3.1, width=2.0 * COLUMN) as drawing:
        for axes, (title, names) in zip(drawing.subplots(1, len(panels)), panels.items()):
            paths = {name: flights[name].record.position for name in names}
            paint_paths(axes, first.target, paths, [first.scenario.goal.position], eye_axes(*side), looked)
            axes.set_title(title)
        told = dict(pair for axes in drawing.axes for pair in zip(*axes.get_legend_handles_labels()[::-1]))
        drawing.legend(told.values(), told.keys(), loc="outside lower center", ncols=6)


def _draw_by_axis(path: Path, flights: Mapping[str, Flight], of: str, label: str) -> None:
    """Draw a velocity's components over time, a panel each flight."""
    with column(path, 4.0) as drawing:
        panels = drawing.subplots(len(flights), 1, sharex=True, sharey=True)
        for axes, (name, flight) in zip(panels, flights.items(), strict=True):
            time, velocity = flight.record.time, getattr(flight.record, of)
            for (letter, component), look in _looks(dict(zip("xyz", velocity.T))):
                draw_signal(axes, time, component, label=letter, **look | {"linewidth": 0.8})
            limit = flight.scenario.chaser.speed_limit
            for bound in (limit, -limit):
                axes.axhline(bound, color="black", linewidth=0.9, linestyle=":")
            axes.set(ylabel=label, title=name)
        panels[-1].set(xlabel="time, s")
        panels[0].legend(ncols=3, loc="upper right", bbox_to_anchor=(1.0, 0.95))


def draw_map(folder: Path, counts: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Draw how often each choice of circulation is trapped, arrives, touches, over k_p; gives its caption, by name."""
    choices = dict.fromkeys(count["circulation"] for count in counts)
    with column(folder / "map.png", 5.2) as drawing:
        panels = drawing.subplots(3, 1, sharex=True)
        for axes, what in zip(panels, _TOLD, strict=True):
            for ((choice, _), look), marker in zip(_looks(choices), _MARKERS):
                own = [count for count in counts if count["circulation"] == choice]
                shares = [100.0 * count[what] / count["pairs"] for count in own]
                if own[0]["k_p m"] is None:
                    axes.axhline(shares[0], label=choice, **look)
                else:
                    lengths = [count["k_p m"] for count in own]
                    axes.plot(lengths, shares, marker=marker, markersize=4, label=choice, **look)
            axes.set(ylabel=f"{_TOLD[what]}, %", ylim=(-4.0, 104.0))
        panels[-1].set(xlabel="k_p, m")
        drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    pairs = counts[0]["pairs"]
    return {"map": f"Of {pairs} random ±y pairs, the share that is trapped, arrives clean, or touches"}


def draw_settings(path: Path, settings: Sequence[Mapping[str, Any]], beside: Sequence[Mapping[str, Any]]) -> None:
    """Draw reached against contacts, in %, of the paper's law at its settings, and of laws beside it, a panel a target.

    Args:
        path: of the PNG.
        settings: rows with `target`, `k_p m`, `e_∇h`, `flights`, `reached` and `contacts`.
        beside: rows with `target`, `law`, `flights`, `reached` and `contacts`.

    """
    targets = dict.fromkeys(row["target"] for row in settings)
    with column(path, 3.0 * len(targets) + 0.7) as drawing:
        panels = drawing.subplots(len(targets), 1, squeeze=False)[:, 0]
        for axes, target in zip(panels, targets, strict=True):
            own = [row for row in settings if row["target"] == target]
            lengths = {f"paper's, k_p {row['k_p m']:g} m": row["k_p m"] for row in own}
            labels: list[tuple[float, list[float]]] = []
            for ((label, length), look), marker in zip(_looks(lengths), _MARKERS):
                some = [row for row in own if row["k_p m"] == length]
                x, y = ([100.0 * row[name] / row["flights"] for row in some] for name in ("contacts", "reached"))
                axes.plot(x, y, marker=marker, markersize=4, label=label, **look)
                labels += [(row["e_∇h"], place) for row, *place in zip(some, x, y)]
            for row, marker in zip((row for row in beside if row["target"] == target), ("*", "P")):
                share = [100.0 * row[name] / row["flights"] for name in ("contacts", "reached")]
                axes.plot(*share, marker, color="black", markersize=8, label=f"Keepout, {row['law']}")
            axes.set(title=target, xlabel="contact not excluded, %", ylabel="reached, %")
            _label_apart(axes, labels)
        drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)


def _label_apart(axes: Axes, labels: Sequence[tuple[float, Sequence[float]]]) -> None:
    """Write numbers at points, but for those whose text would lie over one written before."""
    axes.autoscale_view()
    written: list[np.ndarray] = []
    for value, place in labels:
        at = axes.transAxes.inverted().transform(axes.transData.transform(place))
        if all(np.any(np.abs(at - other) > (0.08, 0.05)) for other in written):
            axes.annotate(f"{value:g}", (place[0], place[1]), (3, 3), textcoords="offset points", fontsize=6)
            written.append(at)


def draw_comparisons(
    path: Path,
    panels: Mapping[str, Mapping[str, Line]],
    *,
    label: str,
    logarithmic: bool = False,
    levels: Sequence[float] = (),
) -> None:
    """Draw one quantity of Case 2, panels one above the other, a line for each observer.

    Args:
        path: of the PNG.
        panels: by heading; lines by label, which have the same look in each panel.
        label: of the quantity, with its unit.
        logarithmic: whether its axis is.
        levels: dotted lines across each panel.

    """
    looks = {name: look for (name, _), look in _looks({name: 0 for lines in panels.values() for name in lines})}
    with column(path, 1.5 * len(panels) + 0.5) as drawing:
        every = drawing.subplots(len(panels), 1, squeeze=False)[:, 0]
        for axes, (heading, lines) in zip(every, panels.items()):
            for name, (time, values) in lines.items():
                few = slice(None, None, max(1, len(time) // _POINTS))
                axes.plot(time[few], values[few], label=name, **looks[name])
            for level in levels:
                axes.axhline(level, color="black", linewidth=0.7, linestyle=(0, (1, 3)))
            if logarithmic:
                _whole_decades(axes)
            axes.set(title=heading, ylabel=label)
        every[-1].set_xlabel("time, s")
        handles = {text: line for axes in every for line, text in zip(*axes.get_legend_handles_labels())}
        drawing.legend([handles[name] for name in looks], list(looks), loc="outside lower center", ncols=2)


def _whole_decades(axes: Axes) -> None:
    """Make the vertical axis logarithmic, from a power of ten to another."""
    shown = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter(NullFormatter())
    if shown.size:
        axes.set_ylim(10.0 ** np.floor(np.log10(shown.min())), 10.0 ** np.ceil(np.log10(shown.max())))


def draw_step_times(path: Path, times: Mapping[str, Line], *, limit: float) -> None:
    """Draw milliseconds of each step over the flight for each contender.

    Args:
        path: of the PNG.
        times: by label: seconds flown, and milliseconds of the step.
        limit: the paper's, ms.

    """
    with column(path, 3.2 + 0.15 * len(times)) as drawing:
        axes = drawing.add_subplot()
        for (label, (time, taken)), look in _looks(times):
            axes.plot(time, taken, color=look["color"], linewidth=0.4, alpha=0.5)
            median = float(np.median(taken))
            axes.plot(time[[0, -1]], [median, median], label=label, **look)
        axes.axhline(limit, color="black", linewidth=0.9, linestyle=(0, (1, 2)), label=f"the paper's {limit:g} ms")
        axes.set(yscale="log", xlabel="time, s", ylabel="time of a control step, ms")
        drawing.legend(loc="outside lower center", ncols=1)


def draw_series(path: Path, campaigns: Mapping[str, FlightSeries], *, tolerance: float, speed_limit: float) -> None:
    """Draw a column of panels for each campaign, a row for each quantity: bands over flights, and the worst flights.

    Args:
        path: of the PNG.
        campaigns: by their heading, with the `QUANTITIES`.
        tolerance: within which the goal is reached, m.
        speed_limit: of each axis, m/s.

    """
    lines = {"barrier": 0.0, "position_error": tolerance, "axis_speed": speed_limit}
    with column(path, 1.55 * len(QUANTITIES) + 0.5, width=COLUMN * len(campaigns)) as drawing:
        grid = drawing.subplots(len(QUANTITIES), len(campaigns), sharex="col", sharey="row", squeeze=False)
        for panels, (heading, series) in zip(grid.T, campaigns.items()):
            panels[0].set_title(heading)
            for axes, name in zip(panels, QUANTITIES):
                _draw_worst(axes, name, series)
            panels[-1].set_xlabel("time, s")
        for row, (name, label) in zip(grid, QUANTITIES.items()):
            row[0].set_ylabel(label)
            for axes in row:
                if name in lines:
                    axes.axhline(lines[name], color="black", linewidth=0.8, linestyle=":")
                if name in ("lyapunov", "position_error"):
                    logarithmic(axes, least=_LEAST)
        drawing.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)


def _draw_worst(axes: Axes, name: str, series: FlightSeries) -> None:
    """Draw the bands of a quantity, and its worst flights.

    Of h those that came lowest, of the speed those that were fastest at any time, of the others those that ended
    highest; a flight that is not finite comes before all.
    """
    values = series.values[name]
    few = slice(None, None, max(1, len(series.time) // _SAMPLES))
    draw_bands(axes, series.time[few], np.nanquantile(values[:, few], BANDS, axis=0))
    bad = {"barrier": -values.min(axis=1), "axis_speed": values.max(axis=1)}.get(name, values[:, -1])
    worst = np.argsort(-np.where(np.isfinite(bad), bad, np.inf), kind="stable")[:WORST]
    for place, flight in enumerate(worst):
        label = "worst flights" if place == 0 else None
        axes.plot(series.time, values[flight], color=COLOURS[1], linewidth=0.6, linestyle="--", label=label)


def _looks(things: Mapping[str, Any]) -> Iterable[tuple[tuple[str, Any], dict[str, Any]]]:
    """Give each thing, by name, with the colour and the kind of its line."""
    return zip(things.items(), ({"linewidth": 1.2, **look} for look in looks(len(things), printed=True)))

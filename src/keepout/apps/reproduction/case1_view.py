"""Figures of Case 1, as the paper draws them: paths, barrier, error, safe velocity and velocity; and the map."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from keepout.core.mission.flight import Flight
from keepout.flights.report import target_view
from keepout.flights.report.style import COLOURS, figure

_COLUMN = 3.5
"""Width of a printed column, inches."""
_LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)))
_MARKERS = ("o", "s", "^", "D", "v")
_SMALL = {"fontsize": 7.5}
_TOLD = {"trapped": "trapped", "clean": "arrived untouched", "touched": "touched"}
_MANY = 5000
"""Samples from which on a line is drawn as pixels in a vector file."""


def draw_case(folder: Path, flights: Mapping[str, Flight], *, suffix: str, remark: str) -> list[tuple[str, str]]:
    """Draw flights of Case 1 as the paper does; the first two are those without and with circulation.

    Args:
        folder: to draw into.
        flights: by name.
        suffix: of the files' names.
        remark: ends each caption, as ", 20 Hz".

    Returns:
        Name and caption of each figure.

    """
    names = list(flights)
    pair = {name: flights[name] for name in names[:2]}
    first = next(iter(flights.values()))
    length = first.scenario.control.paper.slowing_length
    told = f"k_p = {length:g} m{remark}"
    target_view.draw_path_panels(
        folder / f"paths{suffix}.png",
        first.target.vertices,
        first.target.faces,
        {
            names[0]: {names[0]: flights[names[0]].record.position},
            names[1]: {name: flights[name].record.position for name in names[1:]},
        },
        first.scenario.goal.position,
        view=(18.0, -25.0),
    )
    with figure(folder / f"barrier{suffix}.png", width=_COLUMN, height=2.6, vector=True) as drawing:
        axes = drawing.add_subplot()
        for style, (name, flight) in zip(_styles(flights), flights.items()):
            axes.plot(flight.record.time, flight.record.barrier, label=name, **style)
        _zero(axes)
        axes.set(xlabel="time s", ylabel="barrier h, m")
        axes.legend(**_SMALL)
    with figure(folder / f"error{suffix}.png", width=_COLUMN, height=2.6, vector=True) as drawing:
        axes = drawing.add_subplot()
        for style, (name, flight) in zip(_styles(flights), flights.items()):
            error = np.linalg.norm(flight.record.position - np.asarray(flight.scenario.goal.position), axis=1)
            axes.semilogy(flight.record.time, error, label=name, **style)
        axes.axhline(first.scenario.goal.tolerance, color="grey", linewidth=0.8, linestyle=":")
        axes.set(xlabel="time s", ylabel="position error ‖r_e‖, m")
        axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.78), **_SMALL)
    _by_axis(folder / f"safe-velocity{suffix}.png", pair, "safe_velocity", "v_s, m/s")
    _by_axis(folder / f"velocity{suffix}.png", pair, "velocity", "v, m/s")
    return [
        (f"paths{suffix}", f"Paths (start: square, end: disc, goal: star), {told}"),
        (f"barrier{suffix}", f"Barrier h of the law's own field, {told}"),
        (f"error{suffix}", f"Distance to the goal, and its tolerance (dotted), {told}"),
        (f"safe-velocity{suffix}", f"Safe velocity by axis, and ±v_max (dotted), {told}"),
        (f"velocity{suffix}", f"Velocity by axis, and ±v_max (dotted), {told}"),
    ]


def draw_wing(folder: Path, flights: Mapping[str, Flight]) -> tuple[str, str]:
    """Draw the paths across a wing; returns the figure's name and caption."""
    first = next(iter(flights.values()))
    length = first.scenario.control.paper.slowing_length
    target_view.draw_path_panels(
        folder / "wing.png",
        first.target.vertices,
        first.target.faces,
        {name: {name: flight.record.position} for name, flight in flights.items()},
        first.scenario.goal.position,
        view=(20.0, -60.0),
    )
    start, goal = first.scenario.start.position, first.scenario.goal.position
    return "wing", f"From {start} to {goal} m, across a wing, k_p = {length:g} m (start: square, end: disc, goal: star)"


def draw_map(folder: Path, counts: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """Draw how often each choice of circulation is trapped, arrives, touches, over k_p; returns name and caption."""
    choices = list(dict.fromkeys(count["circulation"] for count in counts))
    with figure(folder / "map.png", width=_COLUMN, height=5.2, vector=True) as drawing:
        panels = drawing.subplots(3, 1, sharex=True)
        for axes, what in zip(panels, ("trapped", "clean", "touched"), strict=True):
            for place, choice in enumerate(choices):
                own = [count for count in counts if count["circulation"] == choice]
                shares = [100.0 * count[what] / count["pairs"] for count in own]
                style = {"color": COLOURS[place], "linestyle": _LINES[place], "linewidth": 1.2, "label": choice}
                if own[0]["k_p m"] is None:
                    axes.axhline(shares[0], **style)
                else:
                    axes.plot([c["k_p m"] for c in own], shares, marker=_MARKERS[place], markersize=4, **style)
            axes.set(ylabel=f"{_TOLD[what]}, %", ylim=(-4.0, 104.0))
        panels[-1].set(xlabel="k_p, m")
        drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, **_SMALL)
    pairs = counts[0]["pairs"]
    return "map", f"Of {pairs} random ±y pairs, the share that is trapped, arrives clean, or touches"


def _by_axis(path: Path, flights: Mapping[str, Flight], column: str, label: str) -> None:
    """Draw a velocity's components over time, a panel each flight."""
    with figure(path, width=_COLUMN, height=4.0, vector=True) as drawing:
        panels = drawing.subplots(len(flights), 1, sharex=True, sharey=True)
        for axes, (name, flight) in zip(panels, flights.items(), strict=True):
            time, velocity = flight.record.time, getattr(flight.record, column)
            for axis, (letter, style) in enumerate(zip("xyz", _styles("xyz"))):
                pixels = len(time) > _MANY
                axes.plot(time, velocity[:, axis], label=letter, rasterized=pixels, **style | {"linewidth": 0.8})
            limit = flight.scenario.chaser.speed_limit
            for bound in (limit, -limit):
                axes.axhline(bound, color="black", linewidth=0.9, linestyle=":")
            axes.set(ylabel=label)
            axes.set_title(name, fontsize=8)
        panels[-1].set(xlabel="time s")
        panels[0].legend(ncols=3, loc="upper right", bbox_to_anchor=(1.0, 0.95), **_SMALL)


def _styles(things: Any) -> list[dict[str, Any]]:
    return [{"color": COLOURS[k], "linestyle": _LINES[k], "linewidth": 1.2} for k, _ in enumerate(things)]


def _zero(axes: Axes) -> None:
    axes.axhline(0.0, color="black", linewidth=0.8)

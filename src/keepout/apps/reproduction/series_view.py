"""Figures of many flights over time: quantile bands over the flights, and the worst of them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from keepout.flights.campaign.campaign import FlightSeries
from keepout.flights.report.style import COLOURS, figure

LABELS = {"barrier": "h, m", "lyapunov": "V₁, m²", "position_error": "‖r − goal‖, m", "axis_speed": "largest |vᵢ|, m/s"}
"""Of the quantities that are drawn, top to bottom."""
WORST = 3
"""Flights drawn by themselves in each panel."""
_SAMPLES = 600
"""Of a band: more than can be told apart in print."""
_LEAST = 1e-4
"""Lower end of a logarithmic axis, in its unit."""


def worst_flights(name: str, values: Float[np.ndarray, "flights samples"]) -> np.ndarray:
    """Give the places of the worst flights, worst first.

    Of h those that came lowest, of a speed those that were fastest at any time, of the others those that ended highest;
    a flight that is not finite comes before all.
    """
    if name == "barrier":
        bad = -values.min(axis=1)
    else:
        bad = values.max(axis=1) if name in ("speed", "axis_speed") else values[:, -1]
    return np.argsort(-np.where(np.isfinite(bad), bad, np.inf), kind="stable")[:WORST]


def draw_series(
    path: Path,
    campaigns: Mapping[str, FlightSeries],
    *,
    tolerance: float,
    speed_limit: float,
    vector: bool = False,
) -> None:
    """Draw a column of panels for each campaign, a row for each quantity: bands over flights, and the worst flights.

    Args:
        path: of the PNG.
        campaigns: by their heading, with the quantities of `LABELS`.
        tolerance: within which the goal is reached, m.
        speed_limit: of each axis, m/s.
        vector: also write an SVG.

    """
    names = list(LABELS)
    size = {"width": 3.5 * len(campaigns), "height": 1.55 * len(names) + 0.5}
    with figure(path, **size, vector=vector) as drawing:
        grid = drawing.subplots(len(names), len(campaigns), sharex="col", sharey="row", squeeze=False)
        for column, (heading, series) in zip(grid.T, campaigns.items()):
            column[0].set_title(heading, fontsize=8)
            for axes, name in zip(column, names):
                _panel(axes, name, series)
                axes.tick_params(labelsize=7)
            column[-1].set_xlabel("time, s", fontsize=8)
        lines = {"barrier": (0.0,), "position_error": (tolerance,), "axis_speed": (speed_limit,)}
        for row, name in zip(grid, names):
            row[0].set_ylabel(LABELS[name], fontsize=8)
            for axes in row:
                for level in lines.get(name, ()):
                    axes.axhline(level, color="black", linewidth=0.8, linestyle=":")
                if name in ("lyapunov", "position_error"):
                    axes.set_yscale("log")
                    axes.set_ylim(bottom=max(axes.get_ylim()[0], _LEAST))
        handles, labels = grid[0, 0].get_legend_handles_labels()
        drawing.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7)


def _panel(axes, name: str, series: FlightSeries) -> None:
    values = series.values[name]
    few = slice(None, None, max(1, len(series.time) // _SAMPLES))
    time = series.time[few]
    lowest, low, middle, high, highest = np.nanquantile(values[:, few], (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
    axes.fill_between(time, lowest, highest, color=COLOURS[5], alpha=0.35, linewidth=0, label="5 to 95 %")
    axes.fill_between(time, low, high, color=COLOURS[0], alpha=0.45, linewidth=0, label="25 to 75 %")
    axes.plot(time, middle, color=COLOURS[0], linewidth=1.2, label="median", zorder=3)
    for place, flight in enumerate(worst_flights(name, values)):
        label = "worst flights" if place == 0 else None
        axes.plot(series.time, values[flight], color=COLOURS[1], linewidth=0.6, linestyle="--", label=label)

"""Figures of a campaign: where its flights ended, and, for print in one column, those of its report."""

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib import colormaps, colors
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from keepout.flights.campaign.bands import QUANTITIES, Bands
from keepout.flights.campaign.results import SIGNIFICANT, Results, Scatter
from keepout.flights.campaign.statistics import Influence
from keepout.flights.pages.figures import BANDS, COLOURS, column, draw_bands, figure, logarithmic

DRAWN = ("minimum_clearance", "reached", "time_to_reach", "delta_v")
"""The columns of a campaign's table that are drawn."""
SMALL = 7
"""Points: the smallest text."""
LABELS = {"barrier": "h, m", "lyapunov": "V₁, m²", "position_error": "‖r − goal‖, m", "speed": "‖v‖, m/s"}
ROWS = 24
"""Factors in the picture of influences, the strongest; the table has all."""


def draw_campaign(path: Path, flights: pa.Table) -> None:
    """Draw least clearances, times to reach, and Δv of all flown flights of a campaign's table into one PNG."""
    flown = flights.filter(flights["reached"].is_valid())
    clearance, reached, time_to_reach, speed = (flown[name].to_numpy(zero_copy_only=False) for name in DRAWN)
    reached = reached.astype(bool)
    with figure(path, width=11.0, height=3.8) as drawing:
        first, second, third = panels = drawing.subplots(1, 3)
        measured = (clearance[np.isfinite(clearance)], time_to_reach[reached], speed[np.isfinite(speed)])
        for axes, values, colour in zip(panels, measured, COLOURS[::2]):
            if values.size:
                axes.hist(values, bins=40, color=colour)
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        first.axvline(0.0, color="black", linewidth=0.8)
        first.set(xlabel="least clearance between samples, m", ylabel="flights")
        second.set(xlabel="time to reach, s", title=f"{int(reached.sum())} of {len(reached)} reached")
        third.set(xlabel="Δv, m/s")


def draw_distributions(path: Path, results: Results) -> None:
    """Draw the share of flights at or below each value, with a band that holds the true share everywhere at 95 %."""
    with column(path, 3.3) as drawing:
        panels = drawing.subplots(2, 2, sharey=True)
        for axes, of in zip(panels.flat, results.distributions):
            axes.xaxis.set_major_locator(MaxNLocator(3))
            if of.flights:
                # Dvoretzky, Kiefer and Wolfowitz, with Massart's constant.
                wide = np.sqrt(np.log(2.0 / 0.05) / (2.0 * of.flights))
                low, high = np.clip(of.shares - wide, 0.0, 1.0), np.clip(of.shares + wide, 0.0, 1.0)
                step = {"step": "post", "linewidth": 0.0}
                axes.fill_between(of.curve, 100.0 * low, 100.0 * high, color=COLOURS[5], alpha=0.4, **step)
                axes.step(of.curve, 100.0 * of.shares, where="post", color=COLOURS[0], linewidth=1.2)
                if of.figure.name == "final_error" and of.curve[0] > 0.0:
                    logarithmic(axes, "x", ticks=4)
            else:
                axes.text(0.5, 0.5, "no flights", transform=axes.transAxes, ha="center", fontsize=SMALL)
            if of.figure.name == "clearance":
                axes.axvline(0.0, color="black", linewidth=0.8)
            axes.set_xlabel(of.figure.label)
        for axes in panels[:, 0]:
            axes.set_ylabel("flights at or below, %")


def draw_over_time(path: Path, bands: Bands) -> None:
    """Draw quantiles over the flights of h, V₁, error and speed over time."""
    with column(path, 5.4) as drawing:
        panels = drawing.subplots(len(QUANTITIES), 1, sharex=True)
        for axes, name in zip(panels, QUANTITIES):
            draw_bands(axes, bands.time, bands.quantiles(name, BANDS))
            [least], [largest] = bands.quantiles(name, (0.0,)), bands.quantiles(name, (1.0,))
            end = least if name == "barrier" else largest
            label = "least (h), largest (others)" if name == QUANTITIES[0] else None
            axes.plot(bands.time, end, color=COLOURS[1], linewidth=0.8, linestyle="--", label=label)
            if name == "barrier":
                axes.axhline(0.0, color="black", linewidth=0.8)
            elif np.any(bands.quantiles(name, BANDS)[-1] > 0.0):
                logarithmic(axes, least=1e-5)
            axes.set_ylabel(LABELS[name])
        panels[-1].set_xlabel("time, s")
        handles, labels = panels[0].get_legend_handles_labels()
        drawing.legend(handles, labels, loc="outside lower center", ncols=2)


def draw_influences(path: Path, results: Results) -> None:
    """Draw which dispersed number goes together with which figure: ρ by colour where it is no chance, else grey."""
    pairs = zip(results.influences, results.corrected)
    found = {(one.factor, one.figure): (one, p) for one, p in pairs}
    factors = list(dict.fromkeys(one.factor for one in results.influences))
    strength = {
        name: max((one.strength for one, p in found.values() if one.factor == name and _told(p)), default=0.0)
        for name in factors
    }
    shown = sorted(factors, key=lambda name: -strength[name])[:ROWS]
    figures = [of.figure for of in results.distributions]
    names = [textwrap.wrap(name.replace(".", ". "), 18) for name in shown]
    labels = ["\n".join(line.replace(". ", ".") for line in name) for name in names]
    height = 0.75 + sum(0.14 * max(len(name), 1) + 0.12 for name in names)
    with column(path, height) as drawing:
        axes = drawing.add_subplot()
        axes.grid(visible=False)
        colours = {True: _scale("PuOr_r", -1.0), False: _scale("Greens", 0.0)}
        for row, name in enumerate(shown):
            for place, of in enumerate(figures):
                one, p = found[name, of.name]
                signed, value, words = _cell(one)
                face, ink = "#ffffff", "#6b7280"
                if value is not None and _told(p):
                    face, ink = colours[signed](value), "white" if abs(value) > 0.65 else "black"
                edge = {"edgecolor": "#d5dae0", "linewidth": 0.6}
                axes.add_patch(Rectangle((place - 0.5, row - 0.5), 1.0, 1.0, facecolor=face, **edge))
                axes.text(place, row, words, ha="center", va="center", fontsize=SMALL, color=ink)
        axes.set_xlim(-0.5, len(figures) - 0.5)
        axes.set_ylim(max(len(shown), 1) - 0.5, -0.5)
        heads = [of.label.rpartition(",")[0].replace(" ", "\n") for of in figures]
        axes.set_xticks(range(len(figures)), heads)
        axes.set_yticks(range(len(shown)), labels)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        for side in axes.spines.values():
            side.set_visible(False)


def draw_scatters(path: Path, results: Results) -> None:
    """Draw the runs of the strongest pairs of dispersed number and figure; contacts stand out."""
    with column(path, 3.6) as drawing:
        panels = drawing.subplots(2, 2)
        for place, axes in enumerate(panels.flat):
            if place >= len(results.scatters):
                axes.set_axis_off()
                continue
            _draw_scatter(axes, results.scatters[place])


def _draw_scatter(axes: Axes, of: Scatter) -> None:
    across, levels = np.asarray(of.factor.values, float), of.factor.levels
    if levels is not None:
        across = across + np.random.default_rng(0).uniform(-0.3, 0.3, len(across))
        axes.set_xticks(range(len(levels)), [_short(level, max(24 // len(levels), 3)) for level in levels])
    size = float(np.clip(400.0 / max(len(across), 1), 1.0, 9.0))
    clear = ~of.contact
    axes.scatter(across[clear], of.values[clear], s=size, color=COLOURS[0], alpha=0.5, linewidths=0, rasterized=True)
    axes.scatter(across[of.contact], of.values[of.contact], s=9.0, color=COLOURS[1], marker="x", linewidths=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(4) if levels is None else axes.xaxis.get_major_locator())
    if of.figure.name == "final_error" and np.all(of.values > 0.0):
        logarithmic(axes, ticks=4)
    axes.set_xlabel("\n".join(textwrap.wrap(of.factor.name.replace(".", ". "), 22)).replace(". ", "."), fontsize=SMALL)
    axes.set_ylabel(of.figure.label, fontsize=SMALL)
    signed, _, text = _cell(of.influence)
    axes.set_title(f"ρ {text}" if signed else text, fontsize=SMALL)


def _cell(one: Influence) -> tuple[bool, float | None, str]:
    """Give whether it has a sign, the number and its text: ρ, or η of a choice and of what goes up and down again."""
    rho, ratio = one.correlation, one.ratio
    if rho is not None and (ratio is None or ratio < abs(rho) + 0.1):
        return True, rho, f"{rho:+.2f}".replace("-", "−").replace("+0.00", "0.00").replace("−0.00", "0.00")
    return False, ratio, "–" if ratio is None else f"η {ratio:.2f}"


def _told(p: float | None) -> bool:
    return p is not None and p < SIGNIFICANT


def _scale(name: str, least: float) -> Callable[[float], Any]:
    return lambda value: colormaps[name](float(colors.Normalize(least, 1.0)(value)))


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"

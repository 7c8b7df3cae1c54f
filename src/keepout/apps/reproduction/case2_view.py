"""Figures of Case 2: one quantity over time, a panel for each comparison, a line for each observer."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullFormatter

from keepout.flights.report.style import COLOURS, figure

STYLES = ("-", "--", ":", "-.")
_POINTS = 1500
"""Of a line: more than can be told apart in print."""

Line = tuple[np.ndarray, np.ndarray]
"""Times, s, and values."""


def draw_comparisons(
    path: Path,
    panels: Mapping[str, Mapping[str, Line]],
    *,
    label: str,
    logarithmic: bool = False,
    levels: Sequence[float] = (),
) -> None:
    """Draw one quantity, panels one above the other, for print in one column; PNG and SVG.

    Args:
        path: of the PNG.
        panels: by heading; lines by label, which have the same look in each panel.
        label: of the quantity, with its unit.
        logarithmic: whether its axis is.
        levels: dotted lines across each panel.

    """
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    with figure(path, width=3.5, height=1.5 * len(panels) + 0.5, vector=True) as drawing:
        every = drawing.subplots(len(panels), 1, squeeze=False)[:, 0]
        for axes, (heading, lines) in zip(every, panels.items()):
            for name, (time, values) in lines.items():
                few = slice(None, None, max(1, len(time) // _POINTS))
                place = names.index(name)
                look = {"color": COLOURS[place], "linestyle": STYLES[place % len(STYLES)], "linewidth": 1.1}
                axes.plot(time[few], values[few], label=name, **look)
            for level in levels:
                axes.axhline(level, color="black", linewidth=0.7, linestyle=(0, (1, 3)))
            if logarithmic:
                _whole_decades(axes)
            axes.set_title(heading, fontsize=7.5)
            axes.set_ylabel(label, fontsize=8)
            axes.tick_params(labelsize=7)
        every[-1].set_xlabel("time, s", fontsize=8)
        looks = {text: line for axes in every for line, text in zip(*axes.get_legend_handles_labels())}
        ordered = [looks[name] for name in names]
        drawing.legend(ordered, names, loc="outside lower center", ncols=2, fontsize=7)


def _whole_decades(axes) -> None:
    """Make the vertical axis logarithmic, from a power of ten to another."""
    shown = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.lines])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter(NullFormatter())
    if shown.size:
        axes.set_ylim(10.0 ** np.floor(np.log10(shown.min())), 10.0 ** np.ceil(np.log10(shown.max())))

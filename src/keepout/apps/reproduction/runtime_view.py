"""Figure of the time that each control step takes over a flight."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from keepout.flights.report.style import COLOURS, figure

STYLES = ("-", "--", "-.", ":", (0, (5, 1)))


def draw_step_times(
    path: Path, times: Mapping[str, tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]], *, limit: float
) -> None:
    """Draw milliseconds of each step over the flight for each contender, for print in one column; PNG and SVG.

    Args:
        path: of the PNG.
        times: by label: seconds flown, and milliseconds of the step.
        limit: the paper's, ms.

    """
    with figure(path, width=3.5, height=3.2 + 0.15 * len(times), vector=True) as drawing:
        axes = drawing.add_subplot()
        for (label, (time, taken)), colour, style in zip(times.items(), COLOURS, STYLES):
            axes.plot(time, taken, color=colour, linewidth=0.4, alpha=0.5)
            median = float(np.median(taken))
            axes.plot(time[[0, -1]], [median, median], color=colour, linestyle=style, linewidth=1.4, label=label)
        axes.axhline(limit, color="black", linewidth=0.9, linestyle=(0, (1, 2)), label=f"the paper's {limit:g} ms")
        axes.set_yscale("log")
        axes.set_xlabel("time, s", fontsize=8)
        axes.set_ylabel("time of a control step, ms", fontsize=8)
        axes.tick_params(labelsize=7)
        drawing.legend(loc="outside lower center", ncols=1, fontsize=7)

"""Figures of campaigns: where flights started and how near they came."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib.ticker import MaxNLocator

from keepout.flights.report.style import COLOURS, figure

DRAWN = ("minimum_clearance", "reached", "time_to_reach", "delta_v")
"""The columns of a campaign's table that are drawn."""


def draw_campaign(path: Path, flights: pa.Table) -> None:
    """Draw least clearances, times to reach, and Δv of all flown flights of a campaign's table into one PNG."""
    flown = flights.filter(flights["reached"].is_valid())
    clearance, reached, time_to_reach, speed = (flown[name].to_numpy(zero_copy_only=False) for name in DRAWN)
    reached = reached.astype(bool)
    with figure(path, width=11.0, height=3.8) as drawing:
        first, second, third = drawing.subplots(1, 3)
        finite = clearance[np.isfinite(clearance)]
        if finite.size:
            first.hist(finite, bins=40, color=COLOURS[0])
        first.axvline(0.0, color="black", linewidth=0.8)
        first.set(xlabel="least clearance between samples, m", ylabel="flights")
        if reached.any():
            second.hist(time_to_reach[reached], bins=40, color=COLOURS[2])
        second.set(xlabel="time to reach, s", title=f"{int(reached.sum())} of {len(reached)} reached")
        if np.isfinite(speed).any():
            third.hist(speed[np.isfinite(speed)], bins=40, color=COLOURS[4])
        third.set(xlabel="Δv, m/s")
        for axes in (first, second, third):
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))

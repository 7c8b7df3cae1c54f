"""Figures of campaigns: where flights started and how near they came."""

from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from keepout.mission.campaign import Campaign
from keepout.report.style import COLOURS, figure


def draw_campaign(path: Path, campaign: Campaign) -> None:
    """Draw least clearances, times to reach, and Δv of all flights into one PNG."""
    clearance = np.array([audit.minimum_clearance for audit in campaign.audits])
    reached = np.asarray(campaign.outcome.reached)
    with figure(path, width=11.0, height=3.8) as drawing:
        first, second, third = drawing.subplots(1, 3)
        finite = clearance[np.isfinite(clearance)]
        if finite.size:
            first.hist(finite, bins=40, color=COLOURS[0])
        first.axvline(0.0, color="black", linewidth=0.8)
        first.set(xlabel="least clearance between samples, m", ylabel="flights")
        if reached.any():
            second.hist(np.asarray(campaign.outcome.time_to_reach)[reached], bins=40, color=COLOURS[2])
        second.set(xlabel="time to reach, s", title=f"{int(reached.sum())} of {len(reached)} reached")
        speed = np.asarray(campaign.outcome.delta_v)
        if np.isfinite(speed).any():
            third.hist(speed[np.isfinite(speed)], bins=40, color=COLOURS[4])
        third.set(xlabel="Δv, m/s")
        for axes in (first, second, third):
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))

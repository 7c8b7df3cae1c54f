"""Figures of flights over time: clearance, error, speed, force, disturbance estimate."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullLocator

from keepout.core.mission.flight import Flight
from keepout.flights.report.style import COLOURS, figure


def draw_clearance(path: Path, flights: Mapping[str, Flight]) -> None:
    """Draw the exact clearance of the chaser's ball and the law's own barrier value over time into one PNG."""
    with figure(path) as drawing:
        axes = drawing.add_subplot()
        for colour, (name, flight) in zip(COLOURS, flights.items()):
            time = flight.record.time
            axes.plot(time, flight.clearance, color=colour, label=f"{name}: exact clearance")
            axes.plot(time, flight.record.barrier, color=colour, linewidth=0.8, linestyle="--", label=f"{name}: h")
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="time s", ylabel="m", title="Clearance on the exact mesh, and the barrier the law flies by")
        axes.legend(fontsize=8)


def draw_error(path: Path, flights: Mapping[str, Flight]) -> None:
    """Draw the distance to the goal over time into one PNG."""
    with figure(path) as drawing:
        axes = drawing.add_subplot()
        for colour, (name, flight) in zip(COLOURS, flights.items()):
            error = np.linalg.norm(flight.record.position - np.asarray(flight.scenario.goal.position), axis=1)
            axes.semilogy(flight.record.time, error, color=colour, label=name)
            axes.axhline(flight.scenario.goal.tolerance, color="grey", linewidth=0.8)
        # Formulas for powers of ten, and ticks between them, would take as long as all the rest of the figure.
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set(xlabel="time s", ylabel="‖r − goal‖ m", title="Distance to the goal, and the tolerance (grey)")
        axes.legend(fontsize=8)


def draw_motion(path: Path, flight: Flight, *, name: str) -> None:
    """Draw one flight's velocity, applied force and disturbance estimate, each by axis, into one PNG."""
    record, chaser = flight.record, flight.scenario.chaser
    with figure(path, width=8.0, height=8.0) as drawing:
        velocity, force, disturbance = drawing.subplots(3, 1, sharex=True)
        thin = {"linewidth": 0.7, "linestyle": "--"}
        for axis, (label, colour) in enumerate(zip("xyz", COLOURS)):
            velocity.plot(record.time, record.velocity[:, axis], color=colour, label=f"v {label}")
            velocity.plot(record.time, record.safe_velocity[:, axis], color=colour, **thin)
            force.plot(record.time, record.force[:, axis], color=colour, linewidth=0.8, label=f"F {label}")
            disturbance.plot(record.time, record.disturbance[:, axis], color=colour, linewidth=0.8, label=f"d {label}")
            disturbance.plot(record.time, record.disturbance_estimate[:, axis], color=colour, **thin)
        velocity.plot(record.time, np.linalg.norm(record.velocity, axis=1), color="black", linewidth=0.8, label="‖v‖")
        for axes, limit in ((velocity, chaser.speed_limit), (force, chaser.force_limit)):
            axes.axhline(limit, color="grey", linewidth=0.8)
            axes.axhline(-limit, color="grey", linewidth=0.8)
        velocity.set(ylabel="m/s", title=f"{name}: velocity, and safe velocity (dashed)")
        force.set(ylabel="N", title="applied force")
        disturbance.set(ylabel="N", xlabel="time s", title="disturbance, and its estimate (dashed)")
        for axes in (velocity, force, disturbance):
            axes.legend(fontsize=8, ncols=4, loc="upper right")

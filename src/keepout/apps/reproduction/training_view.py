"""Figures of a fit over its steps: the terms of its loss, and where the field goes."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from keepout.flights.report.style import COLOURS, figure

Curve = Mapping[str, Sequence[float] | Sequence[int]]
"""Of a fit: `steps`, `value_term`, `gradient_term` and `mean_error_m`."""
_LINES = ("-", "--", "-.")


def draw_training(path: Path, curves: Mapping[str, Curve]) -> None:
    """Draw both terms of the loss, and the mean error, over the steps of several fits, by target."""
    with figure(path, width=3.5, height=5.2, vector=True) as drawing:
        panels = drawing.subplots(3, 1, sharex=True)
        for (name, curve), colour, line in zip(curves.items(), COLOURS, _LINES):
            for axes, key in zip(panels, ("value_term", "gradient_term", "mean_error_m")):
                axes.plot(curve["steps"], curve[key], color=colour, linestyle=line, linewidth=1.2, label=name)
        panels[0].set(yscale="log", ylabel="L_P (normalised)")
        panels[1].set(yscale="log", ylabel="η L_E (normalised)")
        panels[2].set(ylabel="mean f̃ − d [m]", xlabel="step")
        panels[2].set_yscale("symlog", linthresh=0.01)
        panels[2].axhline(0.0, color="black", linewidth=0.8)
        panels[0].legend(fontsize=8)


def draw_sinking(path: Path, curves: Mapping[str, Curve]) -> None:
    """Draw the mean error over the steps of fits of one target, by reading of the loss."""
    last = min(curve["steps"][-1] for curve in curves.values())
    with figure(path, width=3.5, height=2.6, vector=True) as drawing:
        axes = drawing.subplots()
        for (name, curve), colour, line in zip(curves.items(), COLOURS[1::-1], _LINES):
            shown = [k for k, step in enumerate(curve["steps"]) if step <= last]
            steps, error = ([curve[key][k] for k in shown] for key in ("steps", "mean_error_m"))
            axes.plot(steps, error, color=colour, linestyle=line, marker="o", markersize=3, label=name)
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="step", ylabel="mean f̃ − d [m]")
        axes.legend(fontsize=8)

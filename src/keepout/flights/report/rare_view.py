"""The folder of a rare event: its levels and curve as tables, a figure, the worst flight, and a page."""

import base64
import csv
import html
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from keepout.core.whole_file import write_whole
from keepout.flights.rare_events.estimate import band, curve
from keepout.flights.rare_events.event import RareEvent
from keepout.flights.replay.flights import of_flights
from keepout.flights.report.page import STYLE, embedded
from keepout.flights.report.replay_view import write_replay
from keepout.flights.report.style import COLOURS, figure


def write_rare(out: Path, event: RareEvent) -> dict[str, Any]:
    """Write all that a rare event has to show into a folder; give its summary with the names of the files."""
    name = event.scenario.name
    flight, tape = out / f"{name}-worst.parquet", out / f"{name}-worst-tape.npy"
    event.worst.record.save(flight)
    stream = io.BytesIO()
    np.save(stream, event.worst_tape, allow_pickle=False)
    write_whole(tape, stream.getvalue())
    levels = _levels(event)
    points = curve(event.simulation)
    _write_table(out / "levels.csv", list(levels[0]), [list(row.values()) for row in levels])
    _write_table(out / "curve.csv", ["clearance_m", "probability", "lower", "upper"], points.tolist())
    draw_curve(out / "curve.png", event)
    summary = {
        "said": event.said,
        **event.summary(),
        "worst_flight": str(flight),
        "worst_tape": str(tape),
    }
    write_replay(
        out / "replay.html", of_flights({"nearest": event.worst}), title=f"{name}: the flight that came nearest"
    )
    _write_page(out / "index.html", event, levels, out / "curve.png")
    return summary


def draw_curve(path: Path, event: RareEvent) -> None:
    """Draw the probability of a clearance below a number against that number, with its band, into one PNG."""
    points = curve(event.simulation)
    with figure(path, width=7.0, height=4.2) as drawing:
        axes = drawing.add_subplot()
        if len(points):
            clearance, mean, lower, upper = points.T
            axes.fill_between(
                clearance, lower, upper, color=COLOURS[5], alpha=0.4, label="95 % band, of the whole curve"
            )
            axes.semilogy(clearance, mean, color=COLOURS[0], label="measured")
        for level in event.simulation.levels[1:]:
            axes.axvline(level.threshold, color="grey", linewidth=0.6, linestyle=":")
        axes.axvline(event.below, color="black", linewidth=0.8)
        axes.set(
            xlabel="clearance m",
            ylabel="probability of a flight that comes nearer",
            title="Least clearance of a flight; thresholds of the levels dotted",
        )
        axes.set_yscale("log")
        if len(points):
            axes.legend(fontsize=8)


def _levels(event: RareEvent) -> list[dict[str, Any]]:
    rows, levels = [], event.simulation.levels
    ends = band([level.threshold for level in levels[::-1]], [level.probability for level in levels[::-1]])[::-1]
    for number, (level, (_, mean, lower, upper)) in enumerate(zip(levels, ends.tolist()), 1):
        least = float(level.values.min())
        rows.append(
            {
                "level": number,
                "threshold_m": None if math.isinf(level.threshold) else level.threshold,
                "probability": mean,
                "lower": lower,
                "upper": None if math.isnan(upper) else upper,
                "least_clearance_m": least if math.isfinite(least) else None,
                "acceptance": level.acceptance,
                "step": level.step,
            }
        )
    return rows


def _write_table(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    write_whole(path, stream.getvalue())


def _write_page(path: Path, event: RareEvent, levels: Sequence[dict[str, Any]], image: Path) -> None:
    title = f"Rare event: {event.scenario.name}"
    picture = base64.b64encode(image.read_bytes()).decode("ascii")
    head = "".join(f"<th>{html.escape(key)}</th>" for key in levels[0])
    body = "".join(
        "<tr>" + "".join(f"<td>{'–' if value is None else f'{value:.4g}'}</td>" for value in row.values()) + "</tr>"
        for row in levels
    )
    broken = "".join(f"<p>Beyond the guard's assumptions: {html.escape(b)}</p>" for b in event.assumptions_broken or ())
    write_whole(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><p><b>{html.escape(event.said)}</b></p>{broken}"
        f"<p>{event.simulation.evaluations} flights, ended: {event.simulation.ended}.</p>"
        f'<p><img alt="curve" src="data:image/png;base64,{picture}"></p>'
        f"<h2>Levels</h2><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        f"<h2>The flight that came nearest</h2>{embedded('replay.html')}</html>",
    )

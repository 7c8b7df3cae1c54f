"""The folder of a rare event: its levels and curve as tables, a figure, the worst flight, and a page."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from keepout.core.whole_file import write_whole
from keepout.flights.pages.figures import COLOURS, figure, logarithmic
from keepout.flights.pages.page import Headline, Page, Provenance, Table, finite
from keepout.flights.pages.replay_page import write_replay
from keepout.flights.pages.replayed import of_flights
from keepout.flights.rare_events.event import RareEvent
from keepout.flights.rare_events.subset import band, curve

_LABELS = {"threshold_m": "threshold, m", "least_clearance_m": "least clearance, m"}


def write_rare(out: Path, event: RareEvent) -> dict[str, Any]:
    """Write all that a rare event has to show into a folder; give its summary with the names of the files."""
    name = event.scenario.name
    flight, tape = out / f"{name}-worst.parquet", out / f"{name}-worst-tape.npy"
    event.worst.record.save(flight)
    stream = io.BytesIO()
    np.save(stream, event.worst_tape, allow_pickle=False)
    write_whole(tape, stream.getvalue())
    levels = Table("levels", "Levels", _levels(event))
    levels.write(out)
    heads = ("clearance_m", "probability", "lower", "upper")
    Table("curve", "Curve", [dict(zip(heads, row)) for row in curve(event.simulation).tolist()]).write(out)
    draw_curve(out / "curve.png", event)
    title = f"{name}: the flight that came nearest"
    nearest = of_flights({"nearest": event.worst})
    write_replay(out / "replay.html", nearest, title=title)
    page = Page(out / "index.html", f"Rare event {name}", _verdict(event), Provenance.of(nearest))
    page.heading("How probable")
    page.words(f"{event.simulation.evaluations} flights, ended: {event.simulation.ended}.")
    words = "How probable it is that a flight comes nearer than a clearance; thresholds of the levels dotted."
    page.picture(out / "curve.png", words)
    page.heading(levels.caption)
    page.table([{_LABELS.get(key, key): value for key, value in row.items()} for row in levels.rows])
    page.heading("The flight that came nearest")
    page.replay(out / "replay.html")
    page.write()
    return {"said": event.said, **event.summary(), "worst_flight": str(flight), "worst_tape": str(tape)}


def _verdict(event: RareEvent) -> Headline:
    broken = event.assumptions_broken
    if broken is None:
        theorem = "No guard flew, so no theorem promises anything."
    elif broken:
        theorem = f"The guard's theorem does not hold: flown beyond what is assumed: {'; '.join(broken)}."
    else:
        theorem = "Nothing is flown beyond what the guard's theorem assumes."
    return Headline(event.said, theorem=theorem)


def draw_curve(path: Path, event: RareEvent) -> None:
    """Draw the probability of a clearance below a number against that number, with its band, into one PNG."""
    points = curve(event.simulation)
    with figure(path, width=7.0, height=4.2) as drawing:
        axes = drawing.add_subplot()
        if len(points):
            clearance, mean, lower, upper = points.T
            band = {"color": COLOURS[5], "alpha": 0.4, "label": "95 % band, of the whole curve"}
            axes.fill_between(clearance, lower, upper, **band)
            axes.plot(clearance, mean, color=COLOURS[0], label="measured")
            # The band's lower end falls to nothing where few flights tell; what is drawn ends below what was measured.
            logarithmic(axes, least=0.01 * float(mean.min()))
            axes.set_ylim(top=1.5)
        for level in event.simulation.levels[1:]:
            axes.axvline(level.threshold, color="grey", linewidth=0.6, linestyle=":")
        axes.axvline(event.below, color="black", linewidth=0.8)
        axes.set(
            xlabel="clearance, m",
            ylabel="probability of a flight that comes nearer",
        )
        if len(points):
            axes.legend(fontsize=8)


def _levels(event: RareEvent) -> list[dict[str, Any]]:
    levels = event.simulation.levels
    ends = band([level.threshold for level in levels[::-1]], [level.probability for level in levels[::-1]])[::-1]
    return [
        {
            "level": number,
            "threshold_m": finite(level.threshold),
            "probability": mean,
            "lower": lower,
            "upper": finite(upper),
            "least_clearance_m": finite(float(level.values.min())),
            "acceptance": level.acceptance,
            "step": level.step,
        }
        for number, (level, (_, mean, lower, upper)) in enumerate(zip(levels, ends.tolist()), 1)
    ]

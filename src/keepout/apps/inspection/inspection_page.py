"""The folder of an inspection: flight file, what was not seen, summary, pictures, replay and a page that shows them."""

import base64
import html
import json
from pathlib import Path
from typing import Any

from keepout.apps.inspection import inspection_view
from keepout.apps.inspection.coverage import FATE_COLOURS, Coverage
from keepout.apps.inspection.fate import WORDS, Fate, shares, unseen
from keepout.apps.inspection.inspection import Inspection
from keepout.core.mission.flight import Flight
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole
from keepout.flights.replay.flights import Replayed
from keepout.flights.report import flight_view
from keepout.flights.report.folder import make_folder, write_summary
from keepout.flights.report.page import STYLE, embedded
from keepout.flights.report.replay_view import write_replay
from keepout.flights.report.terminal import INSPECTION_ROWS, broken_assumptions, shown

UNSEEN = "unseen.json"
_SHARES = {
    "seeable": "surely can be seen from the room allowed",
    "seeable_and_lit": "and is lit in the mission's time",
    "hidden": "proved hidden from the room allowed",
    **{kind.name.lower(): WORDS[kind] for kind in Fate if kind is not Fate.NOT_COUNTED},
    "seen_beyond_proof": "seen, though proved hidden from the room allowed",
}


def write_inspection(
    out: Path, inspection: Inspection, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Write all that an inspection has to show into a folder; give its summary with the names of the files.

    Args:
        out: made if it is not there.
        inspection: at its end.
        figures: also draw the PNG files, and write `index.html` and `replay.html`.
        progress: told how far it is.

    """
    make_folder(out)
    name = inspection.scenario.name
    flight, left = out / f"{name}.parquet", out / UNSEEN
    inspection.record.save(flight)
    write_unseen(left, inspection)
    summary = {
        "name": name,
        **inspection.summary(),
        "shares": shares(inspection),
        "flight": str(flight),
        "unseen": str(left),
    }
    if figures:
        images = _draw(out, inspection, part_of(progress, 0.0, 0.6))
        replayed = Replayed(
            name,
            inspection.record,
            inspection.scenario,
            inspection.target,
            inspection.audit,
            coverage=Coverage.of(inspection),
        )
        write_replay(
            out / "replay.html",
            [replayed],
            title=f"{name}: {inspection.outcome}",
            progress=part_of(progress, 0.6, 1.0),
        )
        summary["pictures"] = [str(image) for image in images]
        write_page(out / "index.html", inspection, summary, images)
    write_summary(out, summary)
    return summary


def write_unseen(path: Path, inspection: Inspection) -> None:
    """Write the list of what was not seen and why, a patch's side a line, with the sums by reason before it."""
    patches = unseen(inspection)
    reasons: dict[str, dict[str, float]] = {}
    for entry in patches:
        sums = reasons.setdefault(entry["reason"], {"count": 0, "area": 0.0})
        sums["count"] += 1
        sums["area"] += entry["area"]
    head = json.dumps({"area_counted": float(inspection.patches.unit_areas().sum()), "reasons": reasons})
    lines = ",\n".join(json.dumps(entry, allow_nan=False) for entry in patches)
    write_whole(path, f'{head[:-1]}, "patches": [\n{lines}\n]}}\n')


def _draw(out: Path, inspection: Inspection, progress: Progress) -> dict[Path, str]:
    """Draw the pictures; give each with its caption."""
    drawn = {
        "coverage": (
            inspection_view.draw_coverage,
            "What was seen when, as flown: every frame is judged at the record's true position.",
        ),
        "surface": (inspection_view.draw_fates, "What became of the surface, and why the rest was not seen."),
    }
    if inspection.seen.any():
        drawn["contact-sheet"] = (
            inspection_view.draw_contact_sheet,
            "The best view of each part. Drawn from the mesh, as the camera had it before it.",
        )
    images = {}
    for place, (stem, (draw, caption)) in enumerate(drawn.items()):
        progress(place / (len(drawn) + 1), f"picture {stem}")
        draw(out / f"{stem}.png", inspection)
        images[out / f"{stem}.png"] = caption
    motion = out / "motion.png"
    flight_view.draw_motion(motion, _flight(inspection), name=inspection.scenario.name)
    images[motion] = "Velocity, force and disturbance over time."
    progress(1.0, "")
    return images


def _flight(inspection: Inspection) -> Flight:
    """Give the inspection's flight as any other is told of."""
    record, scenario = inspection.record, inspection.scenario
    return Flight(
        scenario,
        inspection.target,
        record,
        inspection.flown,
        inspection.audit,
        inspection.target.distance.distance(record.position) - scenario.chaser.radius,
        start_certified=inspection.start_certified,
        assumptions_broken=inspection.assumptions_broken,
        guard=inspection.guard,
    )


def write_page(path: Path, inspection: Inspection, summary: dict[str, Any], images: dict[Path, str]) -> None:
    """Write the page: how it ended, its figures, the shares of the surface, the replay, and pictures with captions."""
    title = f"Inspection {inspection.scenario.name}"
    bad = {"contact_verdict"} if summary["contact"] else set()
    rows = "".join(
        f"<tr><td>{html.escape(words)}</td><td{' class=bad' if key in bad else ''}>"
        f"{html.escape(_said(key, summary[key]))}</td></tr>"
        for key, words in INSPECTION_ROWS.items()
        if summary[key] is not None
    )
    pictures = "".join(
        f'<h3>{html.escape(caption)}</h3><p><img alt="{html.escape(image.stem)}" '
        f'src="data:image/png;base64,{base64.b64encode(image.read_bytes()).decode("ascii")}"></p>'
        for image, caption in images.items()
    )
    broken = "".join(f"<p class=bad>{html.escape(line)}</p>" for line in broken_assumptions([summary]))
    write_whole(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style><h1>{html.escape(title)}</h1><p><b>{html.escape(said(inspection))}</b></p>{broken}"
        f"<table>{rows}</table><h2>The surface</h2>{_shares_table(inspection)}"
        f'<p><a href="{UNSEEN}">Every patch that was not seen, and why</a></p>'
        f"<h2>Replay</h2>{embedded('replay.html')}<h2>Pictures</h2>{pictures}</html>",
    )


def _shares_table(inspection: Inspection) -> str:
    """Give the shares of the area counted, and the areas; what the pictures colour has its colour."""
    area = float(inspection.patches.unit_areas().sum())
    colours = {kind.name.lower(): FATE_COLOURS[kind] for kind in Fate}
    rows = []
    for key, share in shares(inspection).items():
        if key == "seen_beyond_proof" and share == 0.0:
            continue
        square = f'<span style="color:{colours[key]}">■</span> ' if key in colours else ""
        rows.append(
            f"<tr><td>{square}{html.escape(_SHARES[key])}</td><td>{100.0 * share:.3f} %</td>"
            f"<td>{share * area:.4g} m²</td></tr>"
        )
    return (
        "<table><thead><tr><th></th><th>share of the area counted</th><th>area</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _said(key: str, value: Any) -> str:
    return f"{100.0 * value:.3f} %" if key.startswith("coverage") else shown(value)


def said(inspection: Inspection) -> str:
    """Say in a sentence or two how an inspection ended."""
    contact = {"no": "No contact, proved", "yes": "Contact", "undecided": "Contact not excluded"}
    lit = " and be lit" if any(frame.sun is not None for frame in inspection.frames) else ""
    words = (
        f"{inspection.outcome[0].upper()}{inspection.outcome[1:]}: {inspection.why}. {inspection.coverage:.2%} of the "
        f"surface was seen, {inspection.coverage_possible:.2%} of what is not proved hidden{lit} "
        f"({inspection.coverage_seeable:.2%} of what surely can be seen{lit}); no chaser can see more "
        f"than {inspection.seeable.upper:.2%} of it. {contact[str(inspection.audit.contact)]}"
    )
    if inspection.audit.contact == "no":
        words += f": the clearance is at least {inspection.audit.minimum_clearance:.3f} m"
    if inspection.plan.duration > inspection.scenario.duration:
        by_then = inspection.patches.coverage(inspection.plan.seen_by(inspection.scenario.duration))
        words += (
            f". The first plan takes {inspection.plan.duration:.0f} s and the mission lasts "
            f"{inspection.scenario.duration:g} s: by then the plan sees {by_then:.2%} of the surface"
        )
    if inspection.seeable.by_clock:
        words += (
            f". A clock (inspect.proof_time, {inspection.scenario.inspect.proof_time:g} s) ended the proof of what can "
            "be seen: on another machine more or less may be undecided, and plan and figures differ"
        )
    return words + "."

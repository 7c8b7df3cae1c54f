"""The folder of an inspection: flight file, what was not seen, summary, pictures, replay and a page that shows them."""

import functools
import json
from pathlib import Path
from typing import Any

from keepout.apps.inspection import inspection_pictures as pictures
from keepout.apps.inspection.coverage import FATE_COLOURS, Coverage
from keepout.apps.inspection.frames import save_frames
from keepout.apps.inspection.inspection import WORDS, Fate, Inspection, shares, unseen
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole
from keepout.flights.pages.flight_page import Told, draw_result
from keepout.flights.pages.folder import make_folder, write_summary
from keepout.flights.pages.page import Markup, Page, text
from keepout.flights.requirements import judged

UNSEEN, FRAMES = "unseen.json", "frames.parquet"
_SHARES = {
    "seeable": "surely can be seen from the room allowed",
    "seeable_and_lit": "and is lit in the mission's time",
    "hidden": "proved hidden from the room allowed",
    **{kind.name.lower(): WORDS[kind] for kind in Fate if kind is not Fate.NOT_COUNTED},
    "seen_beyond_proof": "seen, though proved hidden from the room allowed",
}
ROWS = {
    "outcome": "outcome",
    "why": "because",
    "contact_verdict": "contact, on the mesh",
    "minimum_clearance_m": "min clearance m",
    "coverage": "share of the area seen",
    "coverage_possible": "of what is not proved hidden, and can be lit",
    "coverage_seeable": "of what surely can be seen, and be lit",
    "coverage_upper_bound": "share that no chaser exceeds (proved)",
    "proof_ended_by_clock": "proof ended by a clock",
    "coverage_planned": "share of the area in the first plan",
    "coverage_planned_in_time": "of that, by the mission's end",
    "plan_duration_s": "first plan takes s",
    "views": "views planned, with frames on the way",
    "views_at_least": "least of the short list without them (proved)",
    "candidates_short_listed": "views on the short list",
    "candidates": "of so many candidates",
    "plans": "plans made",
    "frames": "frames",
    "way_m": "planned way m",
    "duration_s": "flown s",
    "delta_v_mps": "Δv m/s",
    "guard_interventions": "guard steps",
    "start_certified": "start certified",
    "seconds": "computed in s",
}
"""Words for the entries of an inspection's summary that a person is shown first."""


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
    files = {"flight": str(flight), "unseen": str(left)}
    summary = {"name": name, **inspection.summary(), "shares": shares(inspection), **files}
    summary["requirements"] = judged(inspection.scenario, summary)
    if figures:
        tell = functools.partial(_tell_surface, inspection=inspection, shares=summary["shares"])
        field = inspection.field_sha256
        digests = {f"field of {inspection.target.name}": field} if field else {}
        told, layer, drawn = Told(said(inspection), digests, ROWS, tell), Coverage(inspection), _drawn(inspection)
        summary["pictures"] = draw_result(out, inspection, summary, told, drawn, layer=layer, progress=progress)
    frames = save_frames(out / FRAMES, inspection.frames, target_sha256=inspection.target.sha256)
    summary["frames_file"] = str(frames)
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


def _drawn(inspection: Inspection) -> dict[str, Any]:
    """Give what draws the pictures that there are, with captions."""
    drawn = {
        "coverage": (
            pictures.draw_coverage,
            "What was seen when, as flown: every frame is judged at the record's true position.",
        ),
        "surface": (pictures.draw_fates, "What became of the surface, and why the rest was not seen."),
    }
    if inspection.seen.any():
        drawn["contact-sheet"] = (
            pictures.draw_contact_sheet,
            "The best view of each part. Drawn from the mesh, as the camera had it before it.",
        )
    return drawn


def _tell_surface(page: Page, inspection: Inspection, shares: dict[str, float]) -> None:
    """Say the shares of the area counted; what the pictures colour has its colour."""
    page.heading("The surface")
    area = float(inspection.patches.unit_areas().sum())
    colours = {kind.name.lower(): FATE_COLOURS[kind] for kind in Fate}
    rows = []
    for key, share in shares.items():
        if key == "seen_beyond_proof" and share == 0.0:
            continue
        square = f'<span style="color:{colours[key]}">■</span> ' if key in colours else ""
        row = {"": Markup(f"{square}{text(_SHARES[key])}"), "share of the area counted": f"{100.0 * share:.3f} %"}
        rows.append(row | {"area": f"{share * area:.4g} m²"})
    page.table(rows)
    page.words(page.link(page.path.parent / UNSEEN, "Every patch that was not seen, and why"))


def said(inspection: Inspection) -> str:
    """Say in a sentence or two how an inspection ended."""
    lit = " and be lit" if any(frame.sun is not None for frame in inspection.frames) else ""
    words = (
        f"{inspection.outcome[0].upper()}{inspection.outcome[1:]}: {inspection.why}. {inspection.coverage:.2%} of the "
        f"surface was seen, {inspection.coverage_possible:.2%} of what is not proved hidden{lit} "
        f"({inspection.coverage_seeable:.2%} of what surely can be seen{lit}); no chaser can see more "
        f"than {inspection.seeable.upper:.2%} of it. {inspection.contact_said()}"
    )
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

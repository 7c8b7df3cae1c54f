"""The folder of an inspection: flight file, what was not seen, summary, pictures, replay and a page that shows them.

In the replay stand what became of the surface and when, the camera of each frame, and the sun.
"""

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection import inspection_pictures as pictures
from keepout.apps.inspection.frames import save_frames
from keepout.apps.inspection.inspection import Fate, Inspection, fates, first_frames, shares, unseen
from keepout.apps.inspection.inspection_pictures import PatchMesh
from keepout.apps.inspection.seeing.patches import Patches
from keepout.core.geometry.distance import Points
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole
from keepout.flights.pages.drawn import MOST_TRIANGLES, fewer
from keepout.flights.pages.flight_page import Told, draw_result
from keepout.flights.pages.folder import write_summary
from keepout.flights.pages.page import Markup, Page, text
from keepout.flights.pages.replayed import Layer
from keepout.flights.pages.scene import Packing
from keepout.flights.pages.terminal import with_zones
from keepout.flights.requirements import judged

UNSEEN, FRAMES = "unseen.json", "frames.parquet"
_SHARES = {
    "seeable": "surely can be seen from the room allowed",
    "seeable_and_lit": "and is lit in the mission's time",
    "hidden": "proved hidden from the room allowed",
    **{kind.name.lower(): kind.words for kind in Fate if kind is not Fate.NOT_COUNTED},
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
        known, rows = with_zones(summary, ROWS)
        told, layer, drawn = Told(said(inspection), digests, rows, tell), Coverage(inspection), _drawn(inspection)
        summary["pictures"] = draw_result(out, inspection, known, told, drawn, layer=layer, progress=progress)
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
    colours = {kind.name.lower(): kind.colour for kind in Fate}
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


class Coverage(Layer):
    """What a replay shows of an inspection; a surface of very many triangles is drawn with fewer.

    Args:
        inspection: at its end.

    Attributes:
        vertices: of the patches' triangles, m.
        faces: triangles.
        fates: of each face, seen from where it is counter-clockwise, and from its back: a `Fate`.
        firsts: the frame that first saw them, -1: none.
        whole: triangles before some were left out of the drawing.
        times: of the frames, s, in order.
        boresights: unit vectors, body frame.
        suns: unit vectors towards the sun, body frame; nan where it does not light the target, or does not matter.
        shares: of the area counted that were seen after each frame.
        possible: share that surely can be seen and lit.
        rules: of the camera.

    """

    name = "coverage"

    def __init__(self, inspection: Inspection) -> None:
        patches, mesh, frames = inspection.patches, PatchMesh.of(inspection.patches), inspection.frames
        side = float(np.ptp(mesh.vertices, axis=0).max()) / 1000.0
        self.vertices, self.faces, became = fewer(mesh.vertices, mesh.faces, MOST_TRIANGLES, side=side)
        units = _units(mesh, patches, self.vertices, self.faces, became)
        self.fates, self.firsts, self.whole = fates(inspection)[units], first_frames(inspection)[units], len(mesh.faces)
        self.times, self.shares = inspection.over_time()
        self.boresights = np.array([frame.boresight for frame in frames]).reshape(-1, 3)
        self.suns = np.array([frame.sun_or_nan for frame in frames]).reshape(-1, 3)
        self.possible, self.rules = patches.coverage(inspection.lit), inspection.rules

    def share_at(self, time: Float[np.ndarray, "rows"]) -> Float[np.ndarray, "rows"]:
        """Give the share seen up to each time (s)."""
        place = np.searchsorted(self.times, time + 1e-6, side="right")
        return np.concatenate([[0.0], self.shares])[place]

    def told(self, packing: Packing, start: float) -> dict[str, Any]:
        """Give it as JSON holds it, with the arrays packed; times count from `start`, s."""
        return {
            "vertices": packing.steps(self.vertices),
            "faces": packing.indices(self.faces),
            "fates": packing.exact(self.fates, "uint8"),
            "firsts": packing.exact(self.firsts, "int32"),
            "frames": {
                "time": packing.exact(self.times - start),
                "boresight": packing.exact(self.boresights),
                "sun": packing.exact(self.suns),
                "share": packing.exact(self.shares),
            },
            "possible": self.possible,
            "lit": bool(np.isfinite(self.suns).any()),  # whether the sun matters in any frame
            "half_angle": self.rules.half_angle,
            "reach": self.rules.greatest_range,
            "legend": [
                {"words": kind.words, "colour": kind.colour, "shown": bool((self.fates == kind).any())} for kind in Fate
            ],
            "remark": self._remark(),
        }

    def _remark(self) -> str:
        """Say, as a sentence, what the drawing leaves out; empty where it is whole."""
        if len(self.faces) == self.whole:
            return ""
        return (
            f"The coverage is drawn with {len(self.faces):,} of the patches' {self.whole:,} triangles; "
            "the shares are of all."
        )


def _units(
    mesh: PatchMesh,
    patches: Patches,
    vertices: Points,
    faces: Int[np.ndarray, "f 3"],
    became: Int[np.ndarray, " g"],
) -> Int[np.ndarray, "f 2"]:
    """Give the units that are drawn on the front and on the back of each face.

    The two sides of a thin plate may have become one face: each side of it is that of the larger unit that is counted
    there, and of one that is not where none is.
    """
    there = became >= 0
    patch, drawn = mesh.patch[there], became[there]
    a, b, c = np.moveaxis(vertices[faces[drawn]], 1, 0)
    against = np.einsum("fi,fi->f", np.cross(b - a, c - a), patches.normals[patch]) < 0.0
    place = np.concatenate([2 * drawn, 2 * drawn + 1])  # front, back
    unit = np.concatenate([2 * patch + against, 2 * patch + ~against])
    order = np.lexsort((patches.areas[unit // 2], patches.counted[unit], place))
    last = np.append(place[order][1:] != place[order][:-1], True)
    return unit[order][last].reshape(-1, 2)

"""The folder of an exploration: map, flight file, summary, pictures, replay and a page that shows them."""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from keepout.apps.led.camera import axes_towards
from keepout.apps.unknown import exploration_pictures as pictures
from keepout.apps.unknown import map_file
from keepout.apps.unknown.equipment import pinhole
from keepout.apps.unknown.exploration import Exploration
from keepout.apps.unknown.next_view import UP
from keepout.apps.unknown.skin import skin_spacing
from keepout.core.progress import Progress, silent
from keepout.flights.pages.drawn import fewer
from keepout.flights.pages.flight_page import Told, draw_result
from keepout.flights.pages.folder import make_folder, write_summary
from keepout.flights.pages.replayed import Layer
from keepout.flights.pages.scene import Packing
from keepout.flights.requirements import judged

MAP = "map.keepmap"
ROWS = {
    "outcome": "outcome",
    "why": "because",
    "contact_verdict": "contact, on the true mesh",
    "minimum_clearance_m": "min clearance m",
    "seen_share": "share of the outer surface seen",
    "views": "views",
    "refused_views": "of them refused",
    "contradicting_returns": "returns in room known free",
    "opened_m3": "opened m³",
    "departures_largest_m": "largest departure from the expected mesh m",
    "duration_s": "flown s",
    "delta_v_mps": "Δv m/s",
    "guard_interventions": "guard steps",
    "start_certified": "start certified",
    "seconds": "computed in s",
}
"""Words for the entries of an exploration's summary that a person is shown first."""
MOST_TRIANGLES = 16_000
"""Of a skin as it is drawn: eight of them leave the page below 4 MB."""


def write_exploration(
    out: Path, exploration: Exploration, *, figures: bool = True, progress: Progress = silent
) -> dict[str, Any]:
    """Write all that an exploration has to show into a folder; give its summary with the names of the files.

    Args:
        out: made if it is not there.
        exploration: at its end.
        figures: also draw the PNG files, and write `index.html` and `replay.html`.
        progress: told how far it is.

    """
    make_folder(out)
    name = exploration.scenario.name
    flight, kept = out / f"{name}.parquet", out / MAP
    map_file.save(exploration.map, kept)
    exploration.record.save(flight)
    summary = {"name": name, **exploration.summary(), "map": str(kept), "flight": str(flight)}
    summary["requirements"] = judged(exploration.scenario, summary)
    if figures:
        digests = {MAP: hashlib.sha256(kept.read_bytes()).hexdigest()}
        told, layer, drawn = Told(said(exploration), digests, ROWS), Growth(exploration), _drawn(exploration)
        summary["pictures"] = draw_result(out, exploration, summary, told, drawn, layer=layer, progress=progress)
    write_summary(out, summary)
    return summary


def _drawn(exploration: Exploration) -> dict[str, Any]:
    """Give what draws the pictures that there are, with captions."""
    drawn = {
        "seen": (pictures.draw_seen, "What was seen when, on the true surface, which nothing on board knew."),
        "map": (
            pictures.draw_slices,
            "The map at the end. What is not known free is an obstacle, whether something is there or not.",
        ),
        "progress": (pictures.draw_progress, "How the map grew, and where the chaser was."),
    }
    if len(exploration.unknown):
        drawn["unknown"] = (pictures.draw_unknown, f"What is unknown, and why it stays so: {exploration.why}.")
    if exploration.departures is not None:
        drawn["departures"] = (
            pictures.draw_departures,
            "Where the seen surface is not where the expected mesh says, beyond what the sensor's errors explain.",
        )
    return drawn


def said(exploration: Exploration) -> str:
    """Say in a sentence or two how an exploration ended."""
    taken = sum(view.status == "seen" for view in exploration.views)
    return (
        f"{exploration.outcome[0].upper()}{exploration.outcome[1:]}: {exploration.why}. {taken} views of "
        f"{len(exploration.views)} were taken in, and {exploration.seen_share:.0%} of the outer surface was seen. "
        f"{exploration.contact_said(' on the true mesh')}."
    )


@dataclass(frozen=True, eq=False)
class Growth(Layer):
    """What a replay shows of an exploration: the skins of its map, and its views."""

    exploration: Exploration
    name = "growth"

    def told(self, packing: Packing, start: float) -> dict[str, Any]:
        """Give it as JSON holds it, with the arrays packed; times count from `start`, s."""
        exploration, known = self.exploration, self.exploration.map
        camera, views, stages = pinhole(exploration.scenario), exploration.views, exploration.stages
        # A skin's squares are one edge wide: such a cell leaves about so many triangles as are drawn.
        edge = skin_spacing(known)
        sides = [edge * max(1.0, math.sqrt(len(stage.faces) / MOST_TRIANGLES)) for stage in stages]
        drawn = [
            fewer(stage.vertices, stage.faces, MOST_TRIANGLES, side=side)[:2] for stage, side in zip(stages, sides)
        ]
        # With the map's z axis upwards in the image, as the views were taken.
        axes = [axes_towards(view.direction, UP).T for view in views]
        return {
            "stages": [
                {
                    "time": float(stage.time - start),
                    "vertices": packing.steps(vertices),
                    "faces": packing.indices(faces),
                }
                for stage, (vertices, faces) in zip(stages, drawn, strict=True)
            ],
            "remark": self._remark(max((len(faces) for _, faces in drawn), default=0), edge),
            "views": {
                "time": packing.exact(np.array([view.time for view in views]) - start),
                "position": packing.exact(np.array([view.position for view in views]).reshape(-1, 3)),
                "axes": packing.exact(np.array(axes).reshape(-1, 3, 3)),
                "taken": packing.exact(np.array([view.status == "seen" for view in views], dtype=bool), "uint8"),
                "free_volume": packing.exact(np.array([view.free_volume for view in views])),
            },
            "slopes": [0.5 * camera.width / camera.focal, 0.5 * camera.height / camera.focal],
            "reach": known.bounds.usable_range(camera),
        }

    def _remark(self, shown: int, edge: float) -> str:
        """Say, as a sentence, how the drawn map differs from the map."""
        spacing, stages = self.exploration.map.spacing, self.exploration.stages
        most = max((len(stage.faces) for stage in stages), default=0)
        blocks = f", in blocks of {edge:g} m for cubes of {spacing:g} m" if edge > spacing else ""
        thinned = f", with at most {shown:,} of up to {most:,} triangles" if shown < most else ""
        return (
            f"The map is drawn at {len(stages)} times{blocks}{thinned}; law and guard flew by all of it, as it was "
            "at every instant."
        )

"""A map that grew during a flight, as a replay shows it: its skin at some times, and the camera at each view."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from keepout.apps.led.camera import axes_towards
from keepout.apps.unknown.equipment import pinhole
from keepout.apps.unknown.next_view import UP
from keepout.apps.unknown.skin import skin_spacing
from keepout.flights.pages.drawn import fewer
from keepout.flights.pages.replayed import Layer
from keepout.flights.pages.scene import Packing

if TYPE_CHECKING:
    from keepout.apps.unknown.exploration import Exploration

MOST_TRIANGLES = 16_000
"""Of a skin as it is drawn: eight of them leave the page below 4 MB."""


@dataclass(frozen=True, eq=False)
class Growth(Layer):
    """What a replay shows of an exploration: the skins of its map, and its views."""

    exploration: "Exploration"
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

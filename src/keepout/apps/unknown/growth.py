"""A map that grew during a flight, as a replay shows it: its skin at some times, and the camera at each view."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.apps.led.camera import Pinhole, axes_towards
from keepout.flights.pages.drawn import fewer
from keepout.flights.pages.replayed import Layer
from keepout.flights.pages.scene import Packing

if TYPE_CHECKING:
    from keepout.apps.unknown.exploration import Exploration

_UP = np.array([0.0, 0.0, 1.0])
"""In the image, as the views were taken."""
MOST_TRIANGLES = 16_000
"""Of a skin as it is drawn: eight of them leave the page below 4 MB."""


@dataclass(frozen=True, eq=False)
class Growth(Layer):
    """What a replay shows of a map that grew.

    Attributes:
        times: of the skins, s, in order.
        skins: vertices (v, 3), m, and faces (f, 3) of each.
        edge: of the squares that the skins are made of, m.
        spacing: edge of the map's cubes, m.
        view_times: of all views, s, in order.
        positions: of the sensor, m.
        directions: unit vectors of the boresight.
        taken: whether the map took the view.
        free_volume: known-free room inside the declared ball after each view, m³.
        slopes: tangents of half the camera's angles of view, across and down.
        reach: the range that was used, m.

    """

    times: Float[np.ndarray, "stages"]
    skins: tuple[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]], ...]
    edge: float
    spacing: float
    view_times: Float[np.ndarray, "views"]
    positions: Float[np.ndarray, "views 3"]
    directions: Float[np.ndarray, "views 3"]
    taken: Bool[np.ndarray, "views"]
    free_volume: Float[np.ndarray, "views"]
    slopes: tuple[float, float]
    reach: float
    name = "growth"

    @classmethod
    def of(cls, exploration: "Exploration") -> "Growth":
        """Gather it from an exploration."""
        from keepout.apps.unknown.skin import skin_spacing

        views, entry = exploration.views, exploration.scenario.depth_sensor
        camera = Pinhole(entry.width, entry.height, entry.field_of_view)
        return cls(
            times=np.array([stage.time for stage in exploration.stages]),
            skins=tuple((stage.vertices, stage.faces) for stage in exploration.stages),
            edge=skin_spacing(exploration.map),
            spacing=exploration.map.spacing,
            view_times=np.array([view.time for view in views]),
            positions=np.array([view.position for view in views]).reshape(-1, 3),
            directions=np.array([view.direction for view in views]).reshape(-1, 3),
            taken=np.array([view.status == "seen" for view in views], dtype=bool),
            free_volume=np.array([view.free_volume for view in views]),
            slopes=(0.5 * camera.width / camera.focal, 0.5 * camera.height / camera.focal),
            reach=exploration.map.bounds.usable_range(camera),
        )

    def told(self, packing: Packing, start: float) -> dict[str, Any]:
        """Give it as JSON holds it, with the arrays packed; times count from `start`, s."""
        # A skin's squares are one edge wide: such a cell leaves about so many triangles as are drawn.
        sides = [self.edge * max(1.0, math.sqrt(len(faces) / MOST_TRIANGLES)) for _, faces in self.skins]
        drawn = [fewer(*skin, MOST_TRIANGLES, side=side)[:2] for skin, side in zip(self.skins, sides)]
        most = max((len(faces) for _, faces in self.skins), default=0)
        shown = max((len(faces) for _, faces in drawn), default=0)
        return {
            "stages": [
                {"time": float(time - start), "vertices": packing.steps(vertices), "faces": packing.indices(faces)}
                for time, (vertices, faces) in zip(self.times, drawn, strict=True)
            ],
            "remark": self._remark(shown, most),
            "views": {
                "time": packing.exact(self.view_times - start),
                "position": packing.exact(self.positions),
                "axes": packing.exact(_axes(self.directions)),
                "taken": packing.exact(self.taken, "uint8"),
                "free_volume": packing.exact(self.free_volume),
            },
            "slopes": list(self.slopes),
            "reach": self.reach,
        }

    def _remark(self, shown: int, most: int) -> str:
        """Say, as a sentence, how the drawn map differs from the map."""
        blocks = f", in blocks of {self.edge:g} m for cubes of {self.spacing:g} m" if self.edge > self.spacing else ""
        thinned = f", with at most {shown:,} of up to {most:,} triangles" if shown < most else ""
        return (
            f"The map is drawn at {len(self.skins)} times{blocks}{thinned}; law and guard flew by all of it, as it was "
            "at every instant."
        )


def _axes(directions: Float[np.ndarray, "views 3"]) -> Float[np.ndarray, "views 3 3"]:
    """Give the camera's axes x, y, z as rows, with the map's z axis upwards in the image, as the views were taken."""
    return np.array([axes_towards(one, _UP).T for one in directions]).reshape(-1, 3, 3)

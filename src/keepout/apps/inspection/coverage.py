"""An inspection as a replay shows it: what became of the surface and when, the camera of each frame, and the sun.

And the patches as triangles, for this and all pictures.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from keepout.apps.inspection.inspection import WORDS, Fate, Inspection, fates, first_frames
from keepout.apps.inspection.seeing.patches import Patches
from keepout.flights.pages.drawn import MOST_TRIANGLES, fewer
from keepout.flights.pages.replayed import Layer
from keepout.flights.pages.scene import Packing

FATE_COLOURS = {
    Fate.SEEN: "#2fa77d",
    Fate.MISSED: "#d9722e",
    Fate.SHADOWED: "#3f5fa8",
    Fate.ENCLOSED_BY_RAYS: "#5b616b",
    Fate.NARROW_BY_RAYS: "#b76aa4",
    Fate.UNDECIDED: "#e8d44a",
    Fate.NOT_COUNTED: "#c9ced6",
}
"""Told apart by colour-blind readers, on light paper and on a dark ground."""
_WELD = 1e-6
"""Metres within which corners are one."""


@dataclass(frozen=True, eq=False)
class PatchMesh:
    """Triangles that together are the patches.

    Attributes:
        vertices: m.
        faces: counter-clockwise about the normal of their patch.
        patch: of each face.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    patch: Int[np.ndarray, " f"]

    @classmethod
    def of(cls, patches: Patches) -> "PatchMesh":
        """Divide each patch into triangles that share its first corner."""
        most = patches.corners.shape[1]
        second = np.arange(1, most - 1)
        patch, place = np.nonzero(second[None] + 1 < patches.counts[:, None])
        first = most * patch
        faces = np.column_stack([first, first + second[place], first + second[place] + 1])
        corners = patches.corners.reshape(-1, 3)
        cells = np.rint(corners / _WELD).astype(np.int64)
        _, kept, joined = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        return cls(corners[kept], joined.reshape(-1)[faces], patch)

    def triangles(self) -> Float[np.ndarray, "f 3 3"]:
        """Give the corners of each face, m."""
        return self.vertices[self.faces]


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
                {"words": WORDS[kind], "colour": FATE_COLOURS[kind], "shown": bool((self.fates == kind).any())}
                for kind in Fate
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
    vertices: Float[np.ndarray, "v 3"],
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

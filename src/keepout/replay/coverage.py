"""An inspection as a replay shows it: what became of the surface and when, the camera of each frame, and the sun."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, Int8

from keepout.inspecting.fate import WORDS, Fate, fates, first_frames
from keepout.replay.body import MOST_TRIANGLES, fewer_of
from keepout.replay.packing import Packing
from keepout.replay.patch_mesh import PatchMesh

if TYPE_CHECKING:
    from keepout.inspecting.inspection import Inspection

FATE_COLOURS = {
    Fate.SEEN: "#2fa77d",
    Fate.MISSED: "#d9722e",
    Fate.SHADOWED: "#3f5fa8",
    Fate.ENCLOSED: "#5b616b",
    Fate.TOO_NARROW: "#b76aa4",
    Fate.UNDECIDED: "#e8d44a",
    Fate.NOT_COUNTED: "#c9ced6",
}
"""Told apart by colour-blind readers, on light paper and on a dark ground."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """What a replay shows of an inspection.

    Attributes:
        vertices: of the patches' triangles, m.
        faces: counter-clockwise about the patch's normal.
        fates: of each face, seen from its front and from its back: a `Fate`.
        firsts: the frame that first saw them, -1: none.
        whole: triangles before some were left out of the drawing.
        times: of the frames, s, in order.
        boresights: unit vectors, body frame.
        suns: unit vectors towards the sun, body frame; nan where it does not light the target, or does not matter.
        shares: of the area counted that were seen after each frame.
        possible: share that surely can be seen and lit.
        half_angle: of the camera's cone, rad.
        reach: greatest range, m.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    fates: Int8[np.ndarray, "f 2"]
    firsts: Int[np.ndarray, "f 2"]
    whole: int
    times: Float[np.ndarray, "frames"]
    boresights: Float[np.ndarray, "frames 3"]
    suns: Float[np.ndarray, "frames 3"]
    shares: Float[np.ndarray, "frames"]
    possible: float
    half_angle: float
    reach: float

    @classmethod
    def of(cls, inspection: "Inspection") -> "Coverage":
        """Gather it from an inspection; a surface of very many triangles is drawn with fewer."""
        patches, mesh = inspection.patches, PatchMesh.of(inspection.patches)
        side = float(np.ptp(mesh.vertices, axis=0).max()) / 1000.0
        vertices, faces, kept = fewer_of(mesh.vertices, mesh.faces, MOST_TRIANGLES, side=side)
        patch = mesh.patch[kept]
        faces = _towards(vertices, faces, patches.normals[patch])
        units = np.stack([2 * patch, 2 * patch + 1], axis=1)
        times, shares = inspection.over_time()
        none = np.full(3, np.nan)
        return cls(
            vertices=vertices,
            faces=faces,
            fates=fates(inspection)[units],
            firsts=first_frames(inspection)[units],
            whole=len(mesh.faces),
            times=times,
            boresights=np.array([frame.boresight for frame in inspection.frames]).reshape(-1, 3),
            suns=np.array([none if one.sun is None else one.sun for one in inspection.frames]).reshape(-1, 3),
            shares=shares,
            possible=patches.coverage(inspection.lit),
            half_angle=inspection.rules.half_angle,
            reach=inspection.rules.greatest_range,
        )

    @property
    def lit(self) -> bool:
        """Whether the sun matters in any frame."""
        return bool(np.isfinite(self.suns).any())

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
            "lit": self.lit,
            "half_angle": self.half_angle,
            "reach": self.reach,
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


def _towards(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], normals: Float[np.ndarray, "f 3"]
) -> Int[np.ndarray, "f 3"]:
    """Turn round faces that lie clockwise about their patch's normal, as joined corners may leave them."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    against = np.einsum("fi,fi->f", np.cross(b - a, c - a), normals) < 0.0
    return np.where(against[:, None], faces[:, ::-1], faces)

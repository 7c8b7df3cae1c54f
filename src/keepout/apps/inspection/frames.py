"""What frames show: by the camera's rule, of the true mesh, from where the camera truly was."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from keepout.apps.inspection.inspection import Frame
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.rules import SeeingRules
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import in_frame, lit_units
from keepout.core.errors import InspectionError
from keepout.core.progress import Progress, silent

Vector = Float[np.ndarray, "3"]


@runtime_checkable
class SunAt(Protocol):
    """What the frames ask of the light."""

    @property
    def matters(self) -> bool:
        """Whether a patch must be lit to count."""
        ...

    def sun(self, time: float) -> Vector | None:
        """Give the unit vector towards the sun, body frame, at a time (s); None where there is no light."""
        ...


@runtime_checkable
class Way(Protocol):
    """What the frames ask of a flight's record."""

    @property
    def time(self) -> Float[np.ndarray, " rows"]:
        """Of each row, s."""
        ...

    @property
    def position(self) -> Float[np.ndarray, "rows 3"]:
        """The true one in each row, m, body frame."""
        ...


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame as the camera was told: at which row of the flight's record, and along which unit vector."""

    row: int
    boresight: Vector


@dataclass(eq=False)
class Camera:
    """What a camera sees of one mesh, frame by frame; what is lit is kept as long as the sun stays.

    Attributes:
        patches: of the mesh.
        sight: lines of sight about it.
        rules: when a patch counts as seen.
        light: where the sun is.

    """

    patches: Patches
    sight: Sightlines
    rules: SeeingRules
    light: SunAt
    _sun: Vector | None = None
    _lit: Int8[np.ndarray, " units"] = field(default_factory=lambda: np.zeros(0, np.int8))

    def sun(self, time: float) -> Vector | None:
        """Give the unit vector towards the sun; None in the Earth's shadow, or where light does not matter."""
        return self.light.sun(time) if self.light.matters else None

    def units(
        self, time: float, place: Vector, boresight: Vector, among: Bool[np.ndarray, " units"] | None = None
    ) -> Int[np.ndarray, " k"]:
        """Give the units wholly seen, by all the rules, in a frame.

        Args:
            time: of the frame, s.
            place: (3,) of the camera, m, body frame.
            boresight: (3,) unit vector.
            among: (2 n,) units that are asked for; by default all that are counted.

        """
        sun = self.sun(time)
        if self.light.matters and sun is None:
            return np.zeros(0, dtype=np.int64)
        units = in_frame(self.sight, self.rules, place, boresight, among=among)
        return units if sun is None else units[self.lit(sun, units)]

    def lit(self, sun: Vector, units: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether units are wholly lit from a direction (unit vector), at a fit incidence."""
        if self._sun is None or not np.array_equal(self._sun, sun):
            self._sun, self._lit = sun, np.full(self.patches.units, -1, dtype=np.int8)
        fresh = units[self._lit[units] < 0]
        if len(fresh):
            among = np.zeros(self.patches.units, dtype=bool)
            among[fresh] = True
            self._lit[fresh] = lit_units(self.sight, self.rules, sun, among=among)[fresh]
        return self._lit[units] == 1


def as_flown(
    record: Way, shots: Sequence[Shot], camera: Camera, *, progress: Progress = silent
) -> tuple[tuple[Frame, ...], Bool[np.ndarray, " units"]]:
    """Say what each frame truly showed, and what all of them together.

    Args:
        record: of the flight: true positions and times.
        shots: at which rows, and where the camera looked.
        camera: its rule and the true mesh.
        progress: called as frames are looked at.

    Raises:
        InspectionError: a shot at a row that the record has not.

    """
    frames, seen = [], np.zeros(camera.patches.units, dtype=bool)
    for place, shot in enumerate(shots):
        if not 0 <= shot.row < len(record.time):
            raise InspectionError(f"frames: row {shot.row}; the flight has rows 0 to {len(record.time) - 1}")
        time, position = float(record.time[shot.row]), record.position[shot.row]
        units = camera.units(time, position, shot.boresight)
        seen[units] = True
        frames.append(Frame(time, position.copy(), shot.boresight, camera.sun(time), units))
        if place % 20 == 0:
            progress(place / len(shots), f"frame {place} of {len(shots)} as flown")
    return tuple(frames), seen

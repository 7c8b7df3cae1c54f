"""What frames truly showed, their file, and the coverage worked out again from that file and the flight's alone."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from keepout.apps.inspection.light import Camera, Light
from keepout.apps.inspection.problem import patch_size, rules_of
from keepout.apps.inspection.seeing.patches import Marks, Patches, Units, cut
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.led.camera import angle_between
from keepout.core.errors import InspectionError
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.distance import Point
from keepout.core.geometry.target import Target
from keepout.core.kept import digest
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.target import load_target
from keepout.core.mission.task_entries import CameraEntry
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole

FORMAT, VERSION = "keepout-frames", 1
_HEADER = "keepout_frames"
_AXES = ("x", "y", "z")
_NONE = np.full(3, np.nan)
_APART, _ROUNDING = 1e-6, 1e-7
"""Seconds, and radians or lengths, by which frames may be off a camera's limits."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a flight, as flown.

    Attributes:
        time: s.
        position: (3,) of the camera, m, body frame: the truth of the record.
        boresight: (3,) unit vector, body frame.
        sun: (3,) unit vector towards the sun, body frame; None in the Earth's shadow, or where light does not matter.
        units: (k,) wholly seen in it, by all the rules.

    """

    time: float
    position: Point
    boresight: Point
    sun: Point | None
    units: Units

    @property
    def sun_or_nan(self) -> Point:
        """The sun as arrays of numbers hold it: nan where there is none."""
        return _NONE if self.sun is None else self.sun


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame as the camera was told: at which row of the flight's record, and along which unit vector."""

    row: int
    boresight: Point


def as_flown(
    record: FlightRecord, shots: Sequence[Shot], camera: Camera, *, progress: Progress = silent
) -> tuple[tuple[Frame, ...], Marks]:
    """Say what each frame truly showed, and what all of them together.

    Args:
        record: of the flight: true positions and times.
        shots: at which rows, and where the camera looked.
        camera: its rule and the true mesh.
        progress: called as frames are looked at.

    Raises:
        InspectionError: a shot at a row that the record has not.

    """
    frames, seen = [], np.zeros(camera.sight.patches.units, dtype=bool)
    for place, shot in enumerate(shots):
        if not 0 <= shot.row < len(record.time):
            raise InspectionError(f"frames: row {shot.row}; the flight has rows 0 to {len(record.time) - 1}")
        time, position = float(record.time[shot.row]), record.position[shot.row]
        units = camera.units(time, position, shot.boresight)
        seen[units] = True
        frames.append(Frame(time, position.copy(), shot.boresight, camera.light.sun(time), units))
        if place % 20 == 0:
            progress(place / len(shots), f"frame {place} of {len(shots)} as flown")
    return tuple(frames), seen


@dataclass(frozen=True, eq=False)
class Recomputed:
    """What a flight file and a frames file say of coverage.

    Attributes:
        patches: of the target, cut anew.
        frames: worked out anew from the flight's true positions.
        seen: (2 n,) units seen in some of them.
        breaches: of the camera's limits by the frames: times between frames that are no whole periods, turns faster
            than its rate, boresights that are no unit vectors. Empty if the camera could have taken them.
        same: whether there are none, and each frame shows exactly the units that the frames file names.

    """

    patches: Patches
    frames: tuple[Frame, ...]
    seen: Marks
    breaches: tuple[str, ...]
    same: bool

    @property
    def coverage(self) -> float:
        """Share of the area counted that was seen."""
        return self.patches.coverage(self.seen)


def save_frames(path: Path, frames: tuple[Frame, ...], *, target_sha256: str) -> Path:
    """Write frames to a Parquet file, a row each: time, position, boresight, sun (null without light), units seen.

    Raises:
        InspectionError: a place that cannot be written.

    """
    columns: dict[str, pa.Array] = {"time": pa.array([frame.time for frame in frames], pa.float64())}
    vectors = {"position": [frame.position for frame in frames], "boresight": [frame.boresight for frame in frames]}
    for name, rows in (vectors | {"sun": [frame.sun_or_nan for frame in frames]}).items():
        array = np.asarray(rows, dtype=np.float64).reshape(-1, 3)
        for axis, letter in enumerate(_AXES):
            columns[f"{name}_{letter}"] = pa.array(array[:, axis], pa.float64(), from_pandas=True)
    columns["units"] = pa.array([np.asarray(frame.units, np.int64) for frame in frames], pa.list_(pa.int64()))
    told = {"format": FORMAT, "version": VERSION, "target_sha256": target_sha256, "sha256": _digest(frames)}
    table = pa.table(columns).replace_schema_metadata({_HEADER: json.dumps(told)})
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    write_whole(path, buffer.getvalue(), refusal=InspectionError)
    return path


def load_frames(path: Path) -> tuple[tuple[Frame, ...], str]:
    """Read frames, and the digest of the target that they were taken of.

    Raises:
        InspectionError: a file that is missing, damaged, foreign, or of a later format.

    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InspectionError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        table = pq.read_table(io.BytesIO(content))
    except (OSError, pa.ArrowException) as error:
        raise InspectionError(f"{path}: damaged or not a frames file") from error
    told = json.loads((table.schema.metadata or {}).get(_HEADER.encode(), b"{}"))
    if told.get("format") != FORMAT:
        raise InspectionError(f"{path}: not a frames file")
    if told.get("version") != VERSION:
        raise InspectionError(
            f"{path}: frames format {told.get('version')!r}; this version of keepout reads format {VERSION}"
        )
    vectors = (
        np.stack([table[f"{name}_{letter}"].to_numpy(zero_copy_only=False) for letter in _AXES], axis=1, dtype=float)
        for name in ("position", "boresight", "sun")
    )
    rows = zip(table["time"].to_pylist(), *vectors, table["units"].to_pylist(), strict=True)
    frames = tuple(
        Frame(time, place, boresight, None if np.isnan(sun[0]) else sun, np.asarray(units, dtype=np.int64))
        for time, place, boresight, sun, units in rows
    )
    if _digest(frames) != told.get("sha256"):
        raise InspectionError(f"{path}: damaged: its content does not match its checksum")
    return frames, str(told["target_sha256"])


def coverage_of_files(
    flight: str | Path, frames: str | Path, *, target: Target | None = None, progress: Progress = silent
) -> Recomputed:
    """Work out the coverage again from the files that an inspection wrote, and from the mesh.

    Positions and times are the flight file's, the boresights the frames file's; sun, patches and sight lines are made
    anew.

    Args:
        flight: the flight file, whose header holds the scenario.
        frames: the frames file.
        target: the mesh, already loaded; else the scenario's.
        progress: called as the work goes on.

    Raises:
        KeepoutError: files that are missing or damaged, or not of one flight around this mesh.

    """
    record = FlightRecord.load(flight)
    kept, sha256 = load_frames(Path(frames))
    scenario = Scenario.parse(json.loads(record.header["scenario"]), where=str(flight))
    target = load_target(scenario.target) if target is None else target
    for name, of in ((flight, record.header["target_sha256"]), (frames, sha256)):
        if of != target.sha256:
            raise InspectionError(f"{name}: of another target than {target.name}: {of[:12]}, not {target.sha256[:12]}")
    patches = cut(target, patch_size(scenario, target), progress=progress)
    sight = Sightlines(target.vertices, target.faces, patches)
    shots = []
    for frame in kept:
        row = int(np.searchsorted(record.time, frame.time))
        if row == len(record.time) or record.time[row] != frame.time:
            raise InspectionError(f"{frames}: a frame at {frame.time:g} s, and {flight} has no row of that time")
        shots.append(Shot(row, frame.boresight))
    camera = Camera(sight, rules_of(scenario), Light(scenario))
    again, seen = as_flown(record, shots, camera, progress=progress)
    breaches = camera_breaches(kept, scenario.camera)
    same = all(np.array_equal(np.sort(a.units), np.sort(b.units)) for a, b in zip(again, kept, strict=True))
    return Recomputed(patches, again, seen, breaches, same and not breaches)


def camera_breaches(frames: tuple[Frame, ...], camera: CameraEntry) -> tuple[str, ...]:
    """Say in lines which limits of a camera a row of frames breaks: its period, its turn rate, unit vectors.

    Every frame is at a whole number of periods, later than the one before, and looks no farther from where that one
    looked than the camera turns in the time between. How fast the turn begins and ends is not judged.
    """
    found = []
    for place, frame in enumerate(frames):
        periods = frame.time / camera.period
        if abs(periods - round(periods)) * camera.period > _APART or (
            place > 0 and frame.time <= frames[place - 1].time + _APART
        ):
            found.append(
                f"frame {place} at {frame.time:.9g} s: frames are taken every camera.period, {camera.period:g} s, each "
                "later than the one before"
            )
        length = float(np.linalg.norm(frame.boresight))
        if not abs(length - 1.0) <= _ROUNDING:
            found.append(f"frame {place}: a boresight of length {length:.9g}, which must be a unit vector")
        if place == 0:
            continue
        before, passed = frames[place - 1], frame.time - frames[place - 1].time
        turned = angle_between(before.boresight, frame.boresight)
        if not turned <= camera.turn_rate * passed + _ROUNDING:
            found.append(
                f"frame {place} at {frame.time:.9g} s: the boresight turned by {turned:.4g} rad in {passed:.4g} s, and "
                f"camera.turn_rate, {camera.turn_rate:.4g} rad/s, allows {camera.turn_rate * max(passed, 0.0):.4g} rad"
            )
    return tuple(found)


def _digest(frames: tuple[Frame, ...]) -> str:
    parts: list[str | np.ndarray] = []
    for frame in frames:
        parts.append(f"{len(frame.units)} units")
        parts.append(np.array([frame.time, *frame.position, *frame.boresight, *frame.sun_or_nan]))
        parts.append(np.asarray(frame.units, np.int64))
    return digest(*parts)

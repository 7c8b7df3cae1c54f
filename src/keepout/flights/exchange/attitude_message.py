"""Attitude ephemeris messages (AEM, CCSDS 504.0-B-2): quaternions Q1, Q2, Q3, QC from frame A to frame B.

The standard's quaternion has the components e sin(φ/2) and cos(φ/2), e and φ being the axis and the angle that turn
the axes of frame A into those of frame B. It is the conjugate of what `motion.rotation` calls `b_from_a`, and what
SciPy calls `Rotation.from_quat([Q1, Q2, Q3, QC])`, which takes components in B to components in A. Version 1.0
(504.0-B-1) may turn the direction round (`ATTITUDE_DIR`) and put QC first (`QUATERNION_TYPE`); version 2.0 knows
neither: A to B, and QC last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import ExchangeError
from keepout.core.mission.epoch import format_instant
from keepout.flights.exchange.ephemeris import SpaceObject, State, read_ephemeris
from keepout.flights.exchange.message import Segment, write_message

VERSION = "2.0"
VERSIONS = ("1.0", "2.0")
TYPES = {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7, "QUATERNION/ANGVEL": 7}
"""Attitude types whose rows begin with a quaternion, and how many numbers their rows have."""
_NORM = 1e-3
"""A quaternion's length may differ from 1 by so much, or by what its digits say where that is more."""
_SAME = ("REF_FRAME_A", "REF_FRAME_B")


@dataclass(frozen=True, eq=False)
class Attitude:
    """How one object is turned: epochs (ns, of `time_system`) and unit quaternions (Q1, Q2, Q3, QC) as in the standard.

    `quaternion` turns the axes of `frame_a` into those of `frame_b`.

    Attributes:
        path: the file it was read from, or is to be written to.
        name: of the object.
        frame_a: one of the frames.
        frame_b: the other.
        time_system: of the epochs.
        epochs: rising, ns.
        quaternion: a row an epoch.
        identifier: of the object, its OBJECT_ID; the name, where absent.
        centre: of frame A, if the file says.
        error: of each row, rad: the angle by which its digits let it be turned from the truth.
        comments: of the file.
        unuseable: rows that the file holds beyond its useable times, and that are left out.

    """

    path: Path
    name: str
    frame_a: str
    frame_b: str
    time_system: str
    epochs: Int[np.ndarray, "n"]
    quaternion: Float[np.ndarray, "n 4"]
    identifier: str = ""
    centre: str = ""
    error: Float[np.ndarray, "n"] | None = None
    comments: tuple[str, ...] = ()
    unuseable: int = 0

    @property
    def subject(self) -> SpaceObject:
        """The object."""
        return SpaceObject(self.name, self.identifier or self.name)


def write_aem(attitude: Attitude, *, centre: str, comments: Sequence[str], xml: bool) -> None:
    """Write an attitude to its path, with the sign of each quaternion that lies next to the one before.

    Raises:
        ExchangeError: a name is too long or not ASCII, or the file cannot be written.

    """
    times = [format_instant(int(epoch)) for epoch in attitude.epochs]
    metadata = {
        "OBJECT_NAME": attitude.name,
        "OBJECT_ID": attitude.identifier or attitude.name,
        "CENTER_NAME": centre,
        "REF_FRAME_A": attitude.frame_a,
        "REF_FRAME_B": attitude.frame_b,
        "TIME_SYSTEM": attitude.time_system,
        "START_TIME": times[0],
        "STOP_TIME": times[-1],
        "ATTITUDE_TYPE": "QUATERNION",
    }
    quaternions = _without_jumps(attitude.quaternion)
    rows = [(time, *(f"{number:.15e}" for number in row)) for time, row in zip(times, quaternions.tolist())]
    write_message(attitude.path, "AEM", VERSION, metadata, rows, comments=comments, xml=xml)


def _without_jumps(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Give the same attitudes with QC ≥ 0 in the first row and no change of sign from row to row."""
    flips = np.sign(np.sum(quaternion[1:] * quaternion[:-1], axis=1))
    start = -1.0 if quaternion[0, 3] < 0.0 else 1.0
    signs = start * np.cumprod(np.concatenate([[1.0], np.where(flips < 0.0, -1.0, 1.0)]))
    return quaternion * signs[:, None]


def read_aem(path: Path, *, wanted: SpaceObject | str | None = None) -> Attitude:
    """Read the attitude of one object, in either form and of either version.

    Args:
        path: the file.
        wanted: the object, or its OBJECT_NAME or OBJECT_ID; where absent, the file must be of one object.

    Raises:
        ExchangeError: the file is missing, damaged, not an AEM, of a version unknown here, without quaternions, of
            another object, or contradicts itself.

    """
    directions = []

    def columns(segment: Segment) -> tuple[tuple[int, ...], tuple[int, ...]]:
        kind = segment.required(path, "ATTITUDE_TYPE").upper()
        if kind not in TYPES:
            raise ExchangeError(f"{path}: ATTITUDE_TYPE is {kind}; valid: {', '.join(TYPES)}")
        first_edition = segment.version == "1.0"
        order = segment.required(path, "QUATERNION_TYPE").upper() if first_edition else "LAST"
        if order not in ("FIRST", "LAST"):
            raise ExchangeError(f"{path}: QUATERNION_TYPE is {order}; valid: FIRST, LAST")
        directions.append(segment.required(path, "ATTITUDE_DIR").upper() if first_edition else "A2B")
        if directions[-1] not in ("A2B", "B2A"):
            raise ExchangeError(f"{path}: ATTITUDE_DIR is {directions[-1]}; valid: A2B, B2A")
        if directions[-1] != directions[0]:
            raise ExchangeError(f"{path}: ATTITUDE_DIR is A2B in one segment and B2A in another; one for all is valid")
        return (2, 3, 4, 1) if order == "FIRST" else (1, 2, 3, 4), (TYPES[kind],)

    def contradiction(one: State, other: State, _: float) -> str | None:
        quaternions = np.array([one[0], other[0]])
        units = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1), 1e-300)[:, None]
        # From the chord between the two points of the sphere: precise for the smallest angles.
        chord = min(np.linalg.norm(units[0] - units[1]), np.linalg.norm(units[0] + units[1]))
        apart, allowed = 4.0 * np.arcsin(0.5 * chord), _errors(quaternions, np.array([one[1], other[1]])).sum()
        if apart <= allowed:
            return None
        pair = " and ".join(str(quaternion.tolist()) for quaternion in quaternions)
        return f"quaternions {pair} are {apart:.4g} rad apart; at most {allowed:.4g} rad is valid"

    rows = read_ephemeris(
        path, "AEM", versions=VERSIONS, wanted=wanted, same=_SAME, columns=columns, contradiction=contradiction
    )
    a, b, system = (rows.metadata[keyword].upper() for keyword in (*_SAME, "TIME_SYSTEM"))
    if directions[0] == "B2A":
        a, b = b, a
    length = np.linalg.norm(rows.numbers, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > np.clip(np.linalg.norm(rows.units, axis=1), _NORM, 0.5))
    if wrong.size:
        epoch = format_instant(int(rows.epochs[wrong[0]]))
        raise ExchangeError(f"{path}: the quaternion of {epoch} has length {length[wrong[0]]:.6g}; it must be 1")
    return Attitude(
        path,
        rows.subject.name,
        a,
        b,
        system,
        rows.epochs,
        rows.numbers / length[:, None],
        rows.subject.identifier,
        rows.metadata.get("CENTER_NAME", "").upper(),
        _errors(rows.numbers, rows.units),
        rows.comments,
        rows.unuseable,
    )


def _errors(quaternion: Float[np.ndarray, "n 4"], units: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Give the angles, rad, by which attitudes may be turned from the truth, of their digits and their lengths.

    A quaternion that lies within δ < 1 of a unit one points within asin δ of it, and turns by at most twice as much.
    A length that differs from 1 shows an error at least as large.
    """
    shown = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0)
    return 2.0 * np.arcsin(np.minimum(np.maximum(np.linalg.norm(units, axis=1), shown), 1.0))

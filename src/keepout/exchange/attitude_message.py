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

from keepout.errors import ExchangeError
from keepout.exchange.ephemeris import joined
from keepout.exchange.message import Segment, read_message, write_message
from keepout.mission.epoch import format_instant

VERSION = "2.0"
VERSIONS = ("1.0", "2.0")
TYPES = ("QUATERNION", "QUATERNION/DERIVATIVE", "QUATERNION/RATE", "QUATERNION/ANGVEL")
"""Attitude types whose rows begin with a quaternion."""
_NORM = 1e-3
"""A quaternion's length may differ from 1 by so much: it was printed with few digits."""


@dataclass(frozen=True, eq=False)
class Attitude:
    """How one object is turned: epochs (ns, of `time_system`) and unit quaternions (Q1, Q2, Q3, QC) as in the standard.

    `quaternion` turns the axes of `frame_a` into those of `frame_b`.
    """

    path: Path
    name: str
    frame_a: str
    frame_b: str
    time_system: str
    epochs: Int[np.ndarray, "n"]
    quaternion: Float[np.ndarray, "n 4"]


def write_aem(attitude: Attitude, *, centre: str, comments: Sequence[str], xml: bool) -> None:
    """Write an attitude to its path, with the sign of each quaternion that lies next to the one before.

    Raises:
        ExchangeError: the file cannot be written.

    """
    times = [format_instant(int(epoch)) for epoch in attitude.epochs]
    metadata = {
        "OBJECT_NAME": attitude.name,
        "OBJECT_ID": attitude.name,
        "CENTER_NAME": centre,
        "REF_FRAME_A": attitude.frame_a,
        "REF_FRAME_B": attitude.frame_b,
        "TIME_SYSTEM": attitude.time_system,
        "START_TIME": times[0],
        "STOP_TIME": times[-1],
        "ATTITUDE_TYPE": "QUATERNION",
    }
    quaternions = _without_jumps(attitude.quaternion)
    rows = [(time, *(f"{number:.16e}" for number in row)) for time, row in zip(times, quaternions.tolist())]
    write_message(attitude.path, "AEM", VERSION, metadata, rows, comments=comments, xml=xml)


def _without_jumps(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """Give the same attitudes with QC ≥ 0 in the first row and no change of sign from row to row."""
    flips = np.sign(np.sum(quaternion[1:] * quaternion[:-1], axis=1))
    start = -1.0 if quaternion[0, 3] < 0.0 else 1.0
    signs = start * np.cumprod(np.concatenate([[1.0], np.where(flips < 0.0, -1.0, 1.0)]))
    return quaternion * signs[:, None]


def read_aem(path: Path) -> Attitude:
    """Read an attitude, in either form and of either version.

    Raises:
        ExchangeError: the file is missing, damaged, not an AEM, of a version unknown here, or without quaternions.

    """
    message = read_message(path, "AEM")
    if message.version not in VERSIONS:
        raise ExchangeError(f"{path}: CCSDS_AEM_VERS is {message.version}; valid: {', '.join(VERSIONS)}")
    directed = message.version == "1.0"

    def columns(segment: Segment) -> tuple[int, ...]:
        kind = segment.required(path, "ATTITUDE_TYPE").upper()
        if kind not in TYPES:
            raise ExchangeError(f"{path}: ATTITUDE_TYPE is {kind}; valid: {', '.join(TYPES)}")
        order = segment.required(path, "QUATERNION_TYPE").upper() if directed else "LAST"
        if order not in ("FIRST", "LAST"):
            raise ExchangeError(f"{path}: QUATERNION_TYPE is {order}; valid: FIRST, LAST")
        return (2, 3, 4, 1) if order == "FIRST" else (1, 2, 3, 4)

    same = ("OBJECT_NAME", "REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", *(("ATTITUDE_DIR",) if directed else ()))
    rows = joined(path, message, same=same, columns=columns)
    name, a, b, system = (rows.metadata[keyword] for keyword in same[:4])
    direction = rows.metadata["ATTITUDE_DIR"].upper() if directed else "A2B"
    if direction not in ("A2B", "B2A"):
        raise ExchangeError(f"{path}: ATTITUDE_DIR is {direction}; valid: A2B, B2A")
    if direction == "B2A":
        a, b = b, a
    length = np.linalg.norm(rows.numbers, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > _NORM)
    if wrong.size:
        epoch = format_instant(int(rows.epochs[wrong[0]]))
        raise ExchangeError(f"{path}: the quaternion of {epoch} has length {length[wrong[0]]:.6g}; it must be 1")
    return Attitude(path, name, a.upper(), b.upper(), system.upper(), rows.epochs, rows.numbers / length[:, None])

"""Orbit ephemeris messages (OEM, CCSDS 502.0-B-3): positions and velocities of one object, in kilometres there."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from keepout.errors import ExchangeError
from keepout.exchange.ephemeris import joined
from keepout.exchange.message import read_message, write_message
from keepout.mission.epoch import format_instant

VERSION = "3.0"
VERSIONS = ("1.0", "2.0", "3.0")
"""Of the standard, that are read: their rows are alike."""


@dataclass(frozen=True, eq=False)
class Orbit:
    """Where one object is: epochs (ns, of `time_system`), position (m) and velocity (m/s) in `frame` about `centre`."""

    path: Path
    name: str
    centre: str
    frame: str
    time_system: str
    epochs: Int[np.ndarray, "n"]
    position: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]


def write_oem(orbit: Orbit, *, comments: Sequence[str], xml: bool) -> None:
    """Write an orbit to its path; every number reads back to the same double in kilometres.

    Raises:
        ExchangeError: the file cannot be written.

    """
    times = [format_instant(int(epoch)) for epoch in orbit.epochs]
    metadata = {
        "OBJECT_NAME": orbit.name,
        "OBJECT_ID": orbit.name,
        "CENTER_NAME": orbit.centre,
        "REF_FRAME": orbit.frame,
        "TIME_SYSTEM": orbit.time_system,
        "START_TIME": times[0],
        "STOP_TIME": times[-1],
        "INTERPOLATION": "HERMITE",
        "INTERPOLATION_DEGREE": "3",
    }
    numbers = np.concatenate([orbit.position, orbit.velocity], axis=1) / 1000.0
    rows = [(time, *(f"{number:.16e}" for number in row)) for time, row in zip(times, numbers.tolist())]
    write_message(orbit.path, "OEM", VERSION, metadata, rows, comments=comments, xml=xml)


def read_oem(path: Path) -> Orbit:
    """Read an orbit, in either form.

    Raises:
        ExchangeError: the file is missing, damaged, not an OEM, or of a version unknown here.

    """
    message = read_message(path, "OEM")
    if message.version not in VERSIONS:
        raise ExchangeError(f"{path}: CCSDS_OEM_VERS is {message.version}; valid: {', '.join(VERSIONS)}")
    same = ("OBJECT_NAME", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM")
    rows = joined(path, message, same=same, columns=lambda segment: tuple(range(1, 7)))
    name, centre, frame, system = (rows.metadata[keyword] for keyword in same)
    metres = rows.numbers * 1000.0
    return Orbit(path, name, centre.upper(), frame.upper(), system.upper(), rows.epochs, metres[:, :3], metres[:, 3:])

"""Orbit ephemeris messages (OEM, CCSDS 502.0-B-3): positions and velocities of one object, in kilometres there."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from keepout.core.mission.epoch import format_instant
from keepout.flights.exchange.ephemeris import SpaceObject, State, read_ephemeris
from keepout.flights.exchange.message import write_message

VERSION = "3.0"
VERSIONS = ("1.0", "2.0", "3.0")
"""Of the standard, that are read: their rows are alike."""


_SAME = ("CENTER_NAME", "REF_FRAME")
_ROUNDING = 4e-16
"""Of a position, relative: what is lost between kilometres and metres."""


@dataclass(frozen=True, eq=False)
class Orbit:
    """Where one object is: epochs (ns, of `time_system`), position (m) and velocity (m/s) in `frame` about `centre`.

    Attributes:
        path: the file it was read from, or is to be written to.
        name: of the object.
        centre: of the frame.
        frame: the axes.
        time_system: of the epochs.
        epochs: rising, ns.
        position: m.
        velocity: m/s.
        identifier: of the object, its OBJECT_ID; the name, where absent.
        position_error: of each row, m: how far its digits let a position be from the truth.
        velocity_error: the same of a velocity, m/s.
        comments: of the file.
        unuseable: rows that the file holds beyond its useable times, and that are left out.

    """

    path: Path
    name: str
    centre: str
    frame: str
    time_system: str
    epochs: Int[np.ndarray, "n"]
    position: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]
    identifier: str = ""
    position_error: Float[np.ndarray, "n"] | None = None
    velocity_error: Float[np.ndarray, "n"] | None = None
    comments: tuple[str, ...] = ()
    unuseable: int = 0

    @property
    def subject(self) -> SpaceObject:
        """The object."""
        return SpaceObject(self.name, self.identifier or self.name)


def write_oem(orbit: Orbit, *, comments: Sequence[str], xml: bool) -> None:
    """Write an orbit to its path, with the 16 digits that the standard allows a number.

    Raises:
        ExchangeError: a name is too long or not ASCII, or the file cannot be written.

    """
    times = [format_instant(int(epoch)) for epoch in orbit.epochs]
    metadata = {
        "OBJECT_NAME": orbit.name,
        "OBJECT_ID": orbit.identifier or orbit.name,
        "CENTER_NAME": orbit.centre,
        "REF_FRAME": orbit.frame,
        "TIME_SYSTEM": orbit.time_system,
        "START_TIME": times[0],
        "STOP_TIME": times[-1],
        "INTERPOLATION": "HERMITE",
        "INTERPOLATION_DEGREE": "3",
    }
    numbers = np.concatenate([orbit.position, orbit.velocity], axis=1) / 1000.0
    rows = [(time, *(f"{number:.15e}" for number in row)) for time, row in zip(times, numbers.tolist())]
    write_message(orbit.path, "OEM", VERSION, metadata, rows, comments=comments, xml=xml)


def read_oem(path: Path, *, wanted: SpaceObject | str | None = None, sample_error: float = 0.0) -> Orbit:
    """Read the orbit of one object, in either form.

    Args:
        path: the file.
        wanted: the object, or its OBJECT_NAME or OBJECT_ID; where absent, the file must be of one object.
        sample_error: how far two states of the same epoch may be apart, where their digits do not allow more, m.

    Raises:
        ExchangeError: the file is missing, damaged, not an OEM, of a version unknown here, of another object, or
            contradicts itself.

    """

    def contradiction(one: State, other: State, step: float) -> str | None:
        numbers, units = (np.array([one[k], other[k]]) for k in (0, 1))
        metres = numbers.reshape(2, 2, 3) * 1000.0
        apart = np.linalg.norm(metres[0] - metres[1], axis=1)
        allowed = np.maximum(_errors(units).sum(axis=1), [sample_error, sample_error / step])
        for kind, unit, k in (("positions", "m", 0), ("velocities", "m/s", 1)):
            if apart[k] > allowed[k]:
                pair = " and ".join(str(state[k].tolist()) for state in metres)
                return f"{kind} {pair} {unit} are {apart[k]:.4g} {unit} apart; at most {allowed[k]:.4g} {unit} is valid"
        return None

    rows = read_ephemeris(
        path,
        "OEM",
        versions=VERSIONS,
        wanted=wanted,
        same=_SAME,
        columns=lambda _: (tuple(range(1, 7)), (6, 9)),
        contradiction=contradiction,
    )
    centre, frame, system = (rows.metadata[keyword].upper() for keyword in (*_SAME, "TIME_SYSTEM"))
    metres = rows.numbers * 1000.0
    position_error, velocity_error = _errors(rows.units)
    return Orbit(
        path,
        rows.subject.name,
        centre,
        frame,
        system,
        rows.epochs,
        metres[:, :3],
        metres[:, 3:],
        rows.subject.identifier,
        position_error + _ROUNDING * np.linalg.norm(metres[:, :3], axis=1),
        velocity_error,
        rows.comments,
        rows.unuseable,
    )


def _errors(units: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "2 n"]:
    """Give how far positions (m) and velocities (m/s) may be from the truth, of the units of last digits (km, km/s)."""
    return np.linalg.norm(units.reshape(-1, 2, 3) * 1000.0, axis=2).T

"""Orbit and attitude ephemeris messages (OEM, CCSDS 502.0-B-3; AEM, 504.0-B-2), read and written.

What both share when they are read: of which object, in which frames and time, and when. Epochs are whole nanoseconds of
the message's own time system since 1970-01-01 of its clock. Beside each number stands the unit of its last digit: a
file does not say whether its writer rounded or cut off, so a number is known to one whole unit of the last digit
written, and no better.

An OEM has positions and velocities, in kilometres there. An AEM has quaternions Q1, Q2, Q3, QC from frame A to frame B.
The standard's quaternion has the components e sin(φ/2) and cos(φ/2), e and φ being the axis and the angle that turn
the axes of frame A into those of frame B. It is the conjugate of what `motion.rotation` calls `b_from_a`, and what
SciPy calls `Rotation.from_quat([Q1, Q2, Q3, QC])`, which takes components in B to components in A. Version 1.0
(504.0-B-1) may turn the direction round (`ATTITUDE_DIR`) and put QC first (`QUATERNION_TYPE`); version 2.0 knows
neither: A to B, and QC last.
"""

import math
import re
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import ExchangeError
from keepout.core.mission.epoch import format_instant, parse_instant
from keepout.core.motion.rotation import without_jumps
from keepout.flights.exchange.message import Kind, Row, Segment, read_message, write_message

VERSIONS: dict[Kind, tuple[str, ...]] = {"OEM": ("1.0", "2.0", "3.0"), "AEM": ("1.0", "2.0")}
"""Of the standards, that are read; the last one is written."""
FRAMES: dict[Kind, tuple[str, ...]] = {"OEM": ("CENTER_NAME", "REF_FRAME"), "AEM": ("REF_FRAME_A", "REF_FRAME_B")}
"""Keywords that every segment of an object must have, with one value for all."""
TYPES = {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7, "QUATERNION/ANGVEL": 7}
"""Attitude types whose rows begin with a quaternion, and how many numbers their rows have."""
_ROUNDING = 4e-16
"""Of a position, relative: what is lost between kilometres and metres."""
_NORM = 1e-3
"""A quaternion's length may differ from 1 by so much, or by what its digits say where that is more."""
_MILLISECOND = 1_000_000
"""In ns: a start or a stop time may be rounded otherwise than the rows."""
_FURTHEST = 2**62
"""In ns from 1970: the difference of two such instants is a 64-bit integer."""

TIME_SYSTEMS = ("UTC", "TAI", "TT", "GPS", "TDB", "TCB", "UT1")
_REQUIRED = ("OBJECT_NAME", "OBJECT_ID", "TIME_SYSTEM", "START_TIME", "STOP_TIME")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.([0-9]*))?|\.([0-9]+))(?:[eE]([+-]?[0-9]{1,4}))?")
_UNKNOWN = "UNKNOWN"


@dataclass(frozen=True)
class SpaceObject:
    """Whom a message is about, as its metadata say: OBJECT_NAME and OBJECT_ID."""

    name: str
    identifier: str

    def __str__(self) -> str:
        return f"{self.name} ({self.identifier})"

    def is_same(self, other: "SpaceObject") -> bool:
        """Whether both are one object: by identifier, or by name where an identifier is UNKNOWN."""
        own, others = _plain(self.identifier), _plain(other.identifier)
        if _UNKNOWN not in (own, others):
            return own == others
        return _plain(self.name) == _plain(other.name) != _UNKNOWN

    def is_called(self, wanted: str) -> bool:
        """Whether it has a name or an identifier, in whatever case."""
        return _plain(wanted) in (_plain(self.name), _plain(self.identifier))


@dataclass(frozen=True, eq=False, kw_only=True)
class Ephemeris:
    """What a message says of one object.

    Attributes:
        path: the file it was read from, or is to be written to.
        name: of the object, its OBJECT_NAME.
        identifier: of the object, its OBJECT_ID; the name, where absent.
        centre: of the frame, or of frame A if the file says.
        time_system: of the epochs.
        epochs: rising, ns.
        comments: of the file.
        unuseable: rows that the file holds beyond its useable times, and that are left out.

    """

    path: Path
    name: str
    identifier: str = ""
    centre: str = ""
    time_system: str
    epochs: Int[np.ndarray, "n"]
    comments: tuple[str, ...] = ()
    unuseable: int = 0

    @property
    def subject(self) -> SpaceObject:
        """The object."""
        return SpaceObject(self.name, self.identifier or self.name)


@dataclass(frozen=True, eq=False, kw_only=True)
class Orbit(Ephemeris):
    """Where one object is: position (m) and velocity (m/s) in `frame` about `centre`.

    Attributes:
        frame: the axes.
        position: m.
        velocity: m/s.
        position_error: of each row, m: how far its digits let a position be from the truth.
        velocity_error: the same of a velocity, m/s.

    """

    frame: str
    position: Float[np.ndarray, "n 3"]
    velocity: Float[np.ndarray, "n 3"]
    position_error: Float[np.ndarray, "n"] | None = None
    velocity_error: Float[np.ndarray, "n"] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Attitude(Ephemeris):
    """How one object is turned: unit quaternions (Q1, Q2, Q3, QC) that turn the axes of `frame_a` into `frame_b`'s.

    Attributes:
        frame_a: one of the frames.
        frame_b: the other.
        quaternion: a row an epoch, as in the standard.
        error: of each row, rad: the angle by which its digits let it be turned from the truth.

    """

    frame_a: str
    frame_b: str
    quaternion: Float[np.ndarray, "n 4"]
    error: Float[np.ndarray, "n"] | None = None


def write_oem(orbit: Orbit, *, comments: Sequence[str], xml: bool) -> None:
    """Write an orbit to its path, with the 16 digits that the standard allows a number.

    Raises:
        ExchangeError: a name is too long or not ASCII, or the file cannot be written.

    """
    numbers = np.concatenate([orbit.position, orbit.velocity], axis=1) / 1000.0
    ending = {"INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "3"}
    _write("OEM", orbit, {"REF_FRAME": orbit.frame}, ending, numbers, comments=comments, xml=xml)


def write_aem(attitude: Attitude, *, comments: Sequence[str], xml: bool) -> None:
    """Write an attitude to its path: QC ≥ 0 in the first row, and each sign the one next to the row before.

    Raises:
        ExchangeError: a name is too long or not ASCII, or the file cannot be written.

    """
    q = without_jumps(attitude.quaternion)
    frames = {"REF_FRAME_A": attitude.frame_a, "REF_FRAME_B": attitude.frame_b}
    signed = -q if q[0, 3] < 0.0 else q
    _write("AEM", attitude, frames, {"ATTITUDE_TYPE": "QUATERNION"}, signed, comments=comments, xml=xml)


def _write(
    kind: Kind,
    of: Ephemeris,
    frames: Mapping[str, str],
    ending: Mapping[str, str],
    numbers: Float[np.ndarray, "n columns"],
    *,
    comments: Sequence[str],
    xml: bool,
) -> None:
    times = [format_instant(int(epoch)) for epoch in of.epochs]
    metadata = {
        "OBJECT_NAME": of.name,
        "OBJECT_ID": of.identifier or of.name,
        "CENTER_NAME": of.centre,
        **frames,
        "TIME_SYSTEM": of.time_system,
        "START_TIME": times[0],
        "STOP_TIME": times[-1],
        **ending,
    }
    rows = [(time, *(f"{number:.15e}" for number in row)) for time, row in zip(times, numbers.tolist())]
    write_message(of.path, kind, Segment(VERSIONS[kind][-1], metadata, tuple(rows)), comments=comments, xml=xml)


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
        allowed = np.maximum(_lengths(units).sum(axis=1), [sample_error, sample_error / step])
        for kind, unit, k in (("positions", "m", 0), ("velocities", "m/s", 1)):
            if apart[k] > allowed[k]:
                pair = " and ".join(str(state[k].tolist()) for state in metres)
                return f"{kind} {pair} {unit} are {apart[k]:.4g} {unit} apart; at most {allowed[k]:.4g} {unit} is valid"
        return None

    rows = _read(path, "OEM", wanted, lambda _: (tuple(range(1, 7)), (6, 9)), contradiction)
    metres = rows.numbers * 1000.0
    position_error, velocity_error = _lengths(rows.units)
    return Orbit(
        **rows.about,
        frame=rows.metadata["REF_FRAME"].upper(),
        position=metres[:, :3],
        velocity=metres[:, 3:],
        position_error=position_error + _ROUNDING * np.linalg.norm(metres[:, :3], axis=1),
        velocity_error=velocity_error,
    )


def _lengths(units: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "2 n"]:
    """Give how far positions (m) and velocities (m/s) may be from the truth, of the units of last digits (km, km/s)."""
    return np.linalg.norm(units.reshape(-1, 2, 3) * 1000.0, axis=2).T


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
        kind = segment.one_of(path, "ATTITUDE_TYPE", TYPES)
        first_edition = segment.version == "1.0"
        order = segment.one_of(path, "QUATERNION_TYPE", ("FIRST", "LAST")) if first_edition else "LAST"
        directions.append(segment.one_of(path, "ATTITUDE_DIR", ("A2B", "B2A")) if first_edition else "A2B")
        if directions[-1] != directions[0]:
            raise ExchangeError(f"{path}: ATTITUDE_DIR is A2B in one segment and B2A in another; one for all is valid")
        return (2, 3, 4, 1) if order == "FIRST" else (1, 2, 3, 4), (TYPES[kind],)

    def contradiction(one: State, other: State, _: float) -> str | None:
        quaternions = np.array([one[0], other[0]])
        units = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1), 1e-300)[:, None]
        # From the chord between the two points of the sphere: precise for the smallest angles.
        chord = min(np.linalg.norm(units[0] - units[1]), np.linalg.norm(units[0] + units[1]))
        apart, allowed = 4.0 * np.arcsin(0.5 * chord), _angles(quaternions, np.array([one[1], other[1]])).sum()
        if apart <= allowed:
            return None
        pair = " and ".join(str(quaternion.tolist()) for quaternion in quaternions)
        return f"quaternions {pair} are {apart:.4g} rad apart; at most {allowed:.4g} rad is valid"

    rows = _read(path, "AEM", wanted, columns, contradiction)
    frames = [rows.metadata[keyword].upper() for keyword in FRAMES["AEM"]]
    a, b = frames if directions[0] == "A2B" else reversed(frames)
    length = np.linalg.norm(rows.numbers, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > np.clip(np.linalg.norm(rows.units, axis=1), _NORM, 0.5))
    if wrong.size:
        epoch = format_instant(int(rows.about["epochs"][wrong[0]]))
        raise ExchangeError(f"{path}: the quaternion of {epoch} has length {length[wrong[0]]:.6g}; it must be 1")
    quaternion, error = rows.numbers / length[:, None], _angles(rows.numbers, rows.units)
    return Attitude(**rows.about, frame_a=a, frame_b=b, quaternion=quaternion, error=error)


def _angles(quaternion: Float[np.ndarray, "n 4"], units: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Give the angles, rad, by which attitudes may be turned from the truth, of their digits and their lengths.

    A quaternion that lies within δ < 1 of a unit one points within asin δ of it, and turns by at most twice as much.
    A length that differs from 1 shows an error at least as large.
    """
    shown = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0)
    return 2.0 * np.arcsin(np.minimum(np.maximum(np.linalg.norm(units, axis=1), shown), 1.0))


State = tuple[list[float], list[float]]
"""Numbers of one row, and the units of their last digits."""
_Columns = Callable[[Segment], tuple[tuple[int, ...], tuple[int, ...]]]
"""Gives the places of the numbers wanted within a segment's rows, the epoch being 0, and how many numbers its rows may
have."""
_Contradiction = Callable[[State, State, float], str | None]
"""Says how two states of one epoch disagree, or None; the last argument is the time (s) to a neighbouring epoch."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of one object: what an `Ephemeris` is made of, the first segment's metadata, numbers and last digits."""

    about: dict[str, Any]
    metadata: dict[str, str]
    numbers: Float[np.ndarray, "n columns"]
    units: Float[np.ndarray, "n columns"]


def _read(
    path: Path, kind: Kind, wanted: SpaceObject | str | None, columns: _Columns, contradiction: _Contradiction
) -> _Rows:
    """Read all segments of one object, those of several messages in one file too.

    Rows outside a segment's USEABLE_START_TIME and USEABLE_STOP_TIME only serve an interpolation and are left out.
    Where what is left of two segments overlaps, each epoch of either must be in both, with states that agree.

    Raises:
        ExchangeError: the file is damaged, of another object or of several, a keyword is missing or differs between
            segments, or segments contradict each other.

    """
    told, comments = read_message(path, kind)
    for segment in told:
        if segment.version not in VERSIONS[kind]:
            raise ExchangeError(f"{path}: CCSDS_{kind}_VERS is {segment.version}; valid: {', '.join(VERSIONS[kind])}")
    subject, segments = _of_one_object(path, told, wanted)
    first = segments[0]
    for keyword in (*FRAMES[kind], "TIME_SYSTEM"):
        for segment in segments:
            value = segment.required(path, keyword)
            if value.upper() != first.required(path, keyword).upper():
                raise ExchangeError(
                    f"{path}: {keyword} is {first.metadata[keyword]} in one segment and {value} in another; "
                    "one for all segments is valid"
                )
    system = first.one_of(path, "TIME_SYSTEM", TIME_SYSTEMS)
    useable = [_useable_rows(path, segment, columns) for segment in segments]
    rows: dict[int, State] = {}
    for states in sorted(filter(None, useable), key=lambda states: next(iter(states))):
        _join(path, rows, states, contradiction)
    if len(rows) < 2:
        raise ExchangeError(f"{path}: has {len(rows)} epochs that may be used; it must have at least 2")
    about = {
        "path": path,
        "name": subject.name,
        "identifier": subject.identifier,
        "centre": first.metadata.get("CENTER_NAME", "").upper(),
        "time_system": system,
        "epochs": np.array(list(rows), np.int64),
        "comments": comments,
        "unuseable": sum(len(segment.rows) for segment in segments) - sum(map(len, useable)),
    }
    numbers, units = (np.array(part) for part in zip(*rows.values()))
    return _Rows(about, first.metadata, numbers, units)


def _of_one_object(
    path: Path, segments: Sequence[Segment], wanted: SpaceObject | str | None
) -> tuple[SpaceObject, list[Segment]]:
    of = []
    for segment in segments:
        for keyword in _REQUIRED:
            segment.required(path, keyword)
        of.append(SpaceObject(segment.metadata["OBJECT_NAME"], segment.metadata["OBJECT_ID"]))
    held = ", ".join(dict.fromkeys(map(str, of)))
    chosen = [(one, segment) for one, segment in zip(of, segments) if _is_wanted(one, wanted)]
    if not chosen:
        raise ExchangeError(f"{path}: is of {held}, not of {wanted}; a file of that object is valid")
    subject = chosen[0][0]
    if not all(one == subject or one.is_same(subject) for one, _ in chosen):
        raise ExchangeError(f"{path}: holds several objects, {held}; say by its OBJECT_ID which one is meant")
    return subject, [segment for _, segment in chosen]


def _is_wanted(one: SpaceObject, wanted: SpaceObject | str | None) -> bool:
    if wanted is None:
        return True
    return one.is_called(wanted) if isinstance(wanted, str) else one.is_same(wanted)


def _plain(name: str) -> str:
    return " ".join(name.upper().split())


def _useable_rows(path: Path, segment: Segment, columns: _Columns) -> dict[int, State]:
    """Give the rows of a segment that lie within its useable times; all of them are read and checked."""
    places, widths = columns(segment)
    rows: dict[int, State] = {}
    before = None
    for row in segment.rows:
        epoch = _instant(path, "EPOCH", row[0])
        if before is not None and epoch <= before:
            raise ExchangeError(f"{path}: EPOCH {row[0]} does not come after the one before it; epochs must rise")
        rows[epoch] = _numbers(path, row, places, widths)
        before = epoch
    epochs = list(rows)
    start, stop = (_instant(path, keyword, segment.metadata[keyword]) for keyword in ("START_TIME", "STOP_TIME"))
    if not rows or epochs[-1] < stop - _MILLISECOND:
        end = segment.rows[-1][0] if rows else "once"
        raise ExchangeError(
            f"{path}: the rows end at {end}, before STOP_TIME, {segment.metadata['STOP_TIME']}; the file is cut off"
        )
    for keyword, told, row in (("START_TIME", start, 0), ("STOP_TIME", stop, -1)):
        if abs(epochs[row] - told) > _MILLISECOND:
            raise ExchangeError(
                f"{path}: {keyword} is {segment.metadata[keyword]}, but the {'last' if row else 'first'} row is of "
                f"{segment.rows[row][0]}; they must be the same"
            )
    spans = []
    for keyword, whole in (("USEABLE_START_TIME", epochs[0]), ("USEABLE_STOP_TIME", epochs[-1])):
        spans.append(_instant(path, keyword, segment.metadata[keyword]) if keyword in segment.metadata else whole)
    if spans[0] > spans[1]:
        raise ExchangeError(
            f"{path}: USEABLE_START_TIME is after USEABLE_STOP_TIME, {segment.metadata['USEABLE_STOP_TIME']}; it must "
            "be before"
        )
    return {epoch: state for epoch, state in rows.items() if spans[0] <= epoch <= spans[1]}


def _join(path: Path, rows: dict[int, State], states: dict[int, State], contradiction: _Contradiction) -> None:
    """Append the rows of a segment to those of segments that begin no later."""
    before, own = list(rows), list(states)
    until = min(before[-1], own[-1]) if before else own[0] - 1
    shared = before[bisect_left(before, own[0]) : bisect_right(before, until)]
    repeated = own[: bisect_right(own, until)]
    if shared != repeated:
        raise ExchangeError(
            f"{path}: two segments overlap, and the epochs there are not the same ({len(shared)} and {len(repeated)}); "
            "useable times that meet at one epoch are valid"
        )
    for epoch in shared:
        neighbours = [every[place] for every in (before, own) for place in _beside(every, epoch)]
        step = min((abs(epoch - other) for other in neighbours), default=_FURTHEST) / 1e9
        said = contradiction(rows[epoch], states[epoch], step)
        if said is not None:
            raise ExchangeError(f"{path}: two segments hold the same epoch with other states: {said}")
    rows.update((epoch, states[epoch]) for epoch in own[len(repeated) :])


def _beside(epochs: list[int], epoch: int) -> list[int]:
    place = bisect_left(epochs, epoch)
    return [beside for beside in (place - 1, place + 1) if 0 <= beside < len(epochs)]


def _instant(path: Path, keyword: str, text: str) -> int:
    try:
        epoch = parse_instant(text)
    except ValueError as error:
        raise ExchangeError(f"{path}: {keyword} {text!r} {error}") from None
    if abs(epoch) >= _FURTHEST:
        raise ExchangeError(f"{path}: {keyword} {text!r} must lie between 1824 and 2116")
    return epoch


@lru_cache
def _unit(exponent: int) -> float:
    return float(f"1e{exponent}")


def _numbers(path: Path, row: Row, places: tuple[int, ...], widths: tuple[int, ...]) -> State:
    if len(row) - 1 not in widths:
        raise ExchangeError(
            f"{path}: the row of {row[0]} has {len(row) - 1} numbers; it must have {' or '.join(map(str, widths))}"
        )
    numbers, units = [], []
    for place in places:
        found = _NUMBER.fullmatch(row[place])
        number = unit = math.nan
        if found is not None:
            number = float(row[place])
            decimals = found[1] or found[2] or ""
            unit = _unit(int(found[3] or 0) - len(decimals))
        if not (math.isfinite(number) and math.isfinite(unit)):
            raise ExchangeError(f"{path}: the row of {row[0]} holds {row[place]!r}; it must be a finite number")
        numbers.append(number)
        units.append(unit)
    return numbers, units

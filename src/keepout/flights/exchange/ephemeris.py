"""What orbit and attitude messages share when they are read: of which object, in which frames and time, and when.

Epochs are whole nanoseconds of the message's own time system since 1970-01-01 of its clock. Beside each number stands
the unit of its last digit: a file does not say whether its writer rounded or cut off, so a number is known to one whole
unit of the last digit written, and no better.
"""

import math
import re
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import ExchangeError
from keepout.core.mission.epoch import parse_instant
from keepout.flights.exchange.message import Kind, Row, Segment, read_message

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


@dataclass(frozen=True, eq=False)
class Ephemeris:
    """Rows of one object.

    Attributes:
        subject: the object.
        metadata: the first segment's.
        epochs: rising, ns.
        numbers: a row an epoch.
        units: of the last digit written of each number.
        comments: of the whole file.
        unuseable: how many rows were left out because they lie outside the useable times of their segment.

    """

    subject: SpaceObject
    metadata: dict[str, str]
    epochs: Int[np.ndarray, "n"]
    numbers: Float[np.ndarray, "n columns"]
    units: Float[np.ndarray, "n columns"]
    comments: tuple[str, ...]
    unuseable: int


State = tuple[list[float], list[float]]
"""Numbers of one row, and the units of their last digits."""


def read_ephemeris(
    path: Path,
    kind: Kind,
    *,
    versions: tuple[str, ...],
    wanted: SpaceObject | str | None,
    same: tuple[str, ...],
    columns: Callable[[Segment], tuple[tuple[int, ...], tuple[int, ...]]],
    contradiction: Callable[[State, State, float], str | None],
) -> Ephemeris:
    """Read all segments of one object, those of several messages in one file too.

    Rows outside a segment's USEABLE_START_TIME and USEABLE_STOP_TIME only serve an interpolation and are left out.
    Where what is left of two segments overlaps, each epoch of either must be in both, with states that agree.

    Args:
        path: the file.
        kind: of message.
        versions: of the standard, that are valid.
        wanted: the object, or what it is called; where absent, the file must be of one.
        same: keywords that every segment of the object must have, with one value for all.
        columns: gives the places of the numbers wanted within a segment's rows, the epoch being 0, and how many
            numbers its rows may have.
        contradiction: says how two states of one epoch disagree, or None; the last argument is the time (s) to a
            neighbouring epoch.

    Raises:
        ExchangeError: the file is damaged, of another object or of several, a keyword is missing or differs between
            segments, or segments contradict each other.

    """
    message = read_message(path, kind)
    for segment in message.segments:
        if segment.version not in versions:
            raise ExchangeError(f"{path}: CCSDS_{kind}_VERS is {segment.version}; valid: {', '.join(versions)}")
    subject, segments = _of_one_object(path, message.segments, wanted)
    first = segments[0]
    for keyword in (*same, "TIME_SYSTEM"):
        for segment in segments:
            value = segment.required(path, keyword)
            if value.upper() != first.required(path, keyword).upper():
                raise ExchangeError(
                    f"{path}: {keyword} is {first.metadata[keyword]} in one segment and {value} in another; "
                    "one for all segments is valid"
                )
    system = first.required(path, "TIME_SYSTEM").upper()
    if system not in TIME_SYSTEMS:
        raise ExchangeError(f"{path}: TIME_SYSTEM is {system}; valid: {', '.join(TIME_SYSTEMS)}")
    useable = [_useable_rows(path, segment, columns) for segment in segments]
    rows: dict[int, State] = {}
    for states in sorted(filter(None, useable), key=lambda states: next(iter(states))):
        _join(path, rows, states, contradiction)
    if len(rows) < 2:
        raise ExchangeError(f"{path}: has {len(rows)} epochs that may be used; it must have at least 2")
    return Ephemeris(
        subject,
        first.metadata,
        np.array(list(rows), np.int64),
        np.array([numbers for numbers, _ in rows.values()]),
        np.array([units for _, units in rows.values()]),
        message.comments,
        sum(len(segment.rows) for segment in segments) - sum(map(len, useable)),
    )


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


def _useable_rows(
    path: Path, segment: Segment, columns: Callable[[Segment], tuple[tuple[int, ...], tuple[int, ...]]]
) -> dict[int, State]:
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


def _join(
    path: Path,
    rows: dict[int, State],
    states: dict[int, State],
    contradiction: Callable[[State, State, float], str | None],
) -> None:
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

"""What orbit and attitude messages share when they are read: who, in which frames and time, and when.

Epochs are whole nanoseconds of the message's own time system since 1970-01-01 of its clock.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from keepout.errors import ExchangeError
from keepout.exchange.message import Message, Row, Segment
from keepout.mission.epoch import parse_instant

_MILLISECOND = 1_000_000
"""In ns: a stop time may be rounded otherwise than the rows."""

TIME_SYSTEMS = ("UTC", "TAI", "TT", "GPS", "TDB", "TCB", "UT1")


@dataclass(frozen=True, eq=False)
class Ephemeris:
    """Rows of one object: epochs (ns) and numbers.

    Attributes:
        path: the file it was read from, or is to be written to.
        metadata: the first segment's.
        epochs: rising, ns.
        numbers: a row an epoch.

    """

    path: Path
    metadata: dict[str, str]
    epochs: Int[np.ndarray, "n"]
    numbers: Float[np.ndarray, "n columns"]


def joined(
    path: Path,
    message: Message,
    *,
    same: tuple[str, ...],
    columns: Callable[[Segment], tuple[int, ...]],
) -> Ephemeris:
    """Join the segments of a message.

    Args:
        path: where it was read from.
        message: the message.
        same: keywords that every segment must have, with one value for all.
        columns: gives the places of the numbers wanted within a segment's rows, the epoch being 0.

    Raises:
        ExchangeError: a keyword is missing or differs between segments, a row is damaged, or epochs do not rise.

    """
    first = message.segments[0]
    for keyword in same:
        for segment in message.segments:
            value = segment.required(path, keyword)
            if value.upper() != first.required(path, keyword).upper():
                raise ExchangeError(
                    f"{path}: {keyword} is {first.metadata[keyword]} in one segment and {value} in another; "
                    "one for all segments is valid"
                )
    system = first.required(path, "TIME_SYSTEM").upper()
    if system not in TIME_SYSTEMS:
        raise ExchangeError(f"{path}: TIME_SYSTEM is {system}; valid: {', '.join(TIME_SYSTEMS)}")
    rows: dict[int, list[float]] = {}
    for segment in message.segments:
        places = columns(segment)
        for row in segment.rows:
            epoch, numbers = _read_row(path, row, places)
            # The last row of a segment and the first of the next may be one and the same instant.
            if rows and epoch <= next(reversed(rows)) and (epoch not in rows or row is not segment.rows[0]):
                raise ExchangeError(f"{path}: EPOCH {row[0]} does not come after the one before it; epochs must rise")
            rows.setdefault(epoch, numbers)
        _refuse_cut_off(path, segment)
    if len(rows) < 2:
        raise ExchangeError(f"{path}: has {len(rows)} epochs; it must have at least 2")
    return Ephemeris(path, first.metadata, np.array(list(rows), np.int64), np.array(list(rows.values())))


def _refuse_cut_off(path: Path, segment: Segment) -> None:
    """Refuse a segment whose rows end before it says that they do."""
    stop = segment.required(path, "STOP_TIME")
    try:
        last = parse_instant(stop)
    except ValueError as error:
        raise ExchangeError(f"{path}: STOP_TIME {stop!r} {error}") from None
    if not segment.rows or parse_instant(segment.rows[-1][0]) < last - _MILLISECOND:
        end = segment.rows[-1][0] if segment.rows else "once"
        raise ExchangeError(f"{path}: the rows end at {end}, before STOP_TIME, {stop}; the file is cut off")


def _read_row(path: Path, row: Row, places: tuple[int, ...]) -> tuple[int, list[float]]:
    try:
        epoch = parse_instant(row[0])
    except ValueError as error:
        raise ExchangeError(f"{path}: EPOCH {row[0]!r} {error}") from None
    if len(row) <= max(places):
        raise ExchangeError(f"{path}: the row of {row[0]} has {len(row) - 1} numbers; it must have {max(places)}")
    numbers = []
    for place in places:
        try:
            number = float(row[place])
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ExchangeError(f"{path}: the row of {row[0]} holds {row[place]!r}; it must be a finite number")
        numbers.append(number)
    return epoch, numbers

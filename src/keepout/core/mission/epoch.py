"""Instants of UTC as text: the epoch of a scenario, and the times of a flight in files that others read.

Between two instants seconds are counted as the difference of their clock readings, which is wrong by the leap seconds
between them; what spans one is therefore refused. Instants are kept to the nanosecond.
"""

import datetime
import re
from typing import Any

_FORM = re.compile(r"(\d{4}-(?:\d\d-\d\d|\d{3})T\d\d:\d\d:\d\d)(?:\.(\d*))?Z?", re.ASCII)
_NANOSECONDS = 1_000_000_000
_ORIGIN = datetime.datetime(1970, 1, 1)
_FURTHEST = 2**63 // _NANOSECONDS
"""Seconds from there, about 292 years: further on, nanoseconds are more than 64 bits count."""

_JUNE = (1972, 1981, 1982, 1983, 1985, 1992, 1993, 1994, 1997, 2012, 2015)
_DECEMBER = (1972, 1973, 1974, 1975, 1976, 1977, 1978, 1979, 1987, 1989, 1990, 1995, 1998, 2005, 2008, 2016)
LEAP_DAYS = tuple(
    sorted([datetime.date(year, 7, 1) for year in _JUNE] + [datetime.date(year + 1, 1, 1) for year in _DECEMBER])
)
"""The days before which a second was inserted, since 1972; none has been announced after the last."""
FIRST, LAST = datetime.date(1972, 1, 1), datetime.date(2100, 1, 1)
"""Epochs lie between these days: before the first, UTC had no leap seconds."""


def parse_instant(text: str) -> int:
    """Read an ISO 8601 instant of UTC, by month and day or by day of the year, as nanoseconds since 1970-01-01.

    Digits beyond the nanosecond are rounded.

    Raises:
        ValueError: not such an instant, within a leap second, or too far from 1970 for 64 bits; the message leaves the
            text to the caller.

    """
    found = _FORM.fullmatch(text.strip())
    if found is None:
        raise ValueError("must be an instant such as 2026-01-01T00:00:00Z")
    whole, digits = found.groups()
    if whole.endswith(":60"):
        raise ValueError("lies within a leap second; instants before or after one are valid")
    try:
        by_month = whole.count("-") == 2  # strptime is ten times as slow
        read = (
            datetime.datetime.fromisoformat(whole) if by_month else datetime.datetime.strptime(whole, "%Y-%jT%H:%M:%S")
        )
        seconds = (read - _ORIGIN) // datetime.timedelta(seconds=1)
    except ValueError:
        raise ValueError("must be a day and time that there are") from None
    if not abs(seconds) < _FURTHEST:
        raise ValueError("must lie from 1677-09-22 to 2262-04-11: nanoseconds are counted in 64 bits")
    return seconds * _NANOSECONDS + round(float(f"0.{digits or 0}") * _NANOSECONDS)


def format_instant(nanoseconds: int) -> str:
    """Write an instant with as many digits as it needs, six at least, and without a letter for UTC."""
    seconds, rest = divmod(nanoseconds, _NANOSECONDS)
    digits = f"{rest:09d}"
    digits = digits[:6] + digits[6:].rstrip("0")
    return f"{(_ORIGIN + datetime.timedelta(seconds=seconds)).isoformat()}.{digits}"


def leap_second_between(first: int, last: int) -> datetime.date | None:
    """Give the day before which a leap second lies between two instants (nanoseconds since 1970), if one does."""
    for day in LEAP_DAYS:
        start = (datetime.datetime(day.year, day.month, day.day) - _ORIGIN) // datetime.timedelta(seconds=1)
        if first < start * _NANOSECONDS <= last:
            return day
    return None


def checked_epoch(value: Any) -> Any:
    """Give an epoch of a scenario as text that ends in Z; a TOML time is turned into it.

    Raises:
        ValueError: it is no instant of UTC in the years in which UTC is known.

    """
    if isinstance(value, datetime.datetime):
        if value.utcoffset() != datetime.timedelta(0):
            raise ValueError(f"{value.isoformat()}: it must be in UTC and end in Z, as 2026-01-01T00:00:00Z")
        value = value.replace(tzinfo=None).isoformat() + "Z"
    if not isinstance(value, str) or not value.endswith("Z"):
        raise ValueError("must be an instant of UTC that ends in Z, such as 2026-01-01T00:00:00Z")
    day = (_ORIGIN + datetime.timedelta(seconds=parse_instant(value) // _NANOSECONDS)).date()
    if not FIRST <= day < LAST:
        raise ValueError(f"must lie from {FIRST} to {LAST}, where UTC is known")
    return value

"""Dates and times of day at run time: composed of numbers, split into numbers, and as text (IEC 61131-3, table 36).

A date or a date and time is a number of ns since 1970-01-01, a time of day a number of ns since midnight. A moment before 1677 or
after 2262 does not fit, and raises `LogicError`.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.plc.st.runtime.logic_error import LogicError

_DAY_NS = 86_400 * NS_PER_S
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_THURSDAY = 4
"""The day of the week of 1970-01-01; Sunday is 0."""


def date_of(year: int, month: int, day: int) -> int:
    """Return the date, for CONCAT_DATE. Raises `LogicError` for a day that does not exist."""
    try:
        days = (datetime(year, month, day, tzinfo=UTC) - _EPOCH).days
    except (ValueError, OverflowError) as e:
        raise LogicError("a date that does not exist", got=f"{year}-{month}-{day}") from e
    if not -(2**63) <= days * _DAY_NS < 2**63:
        raise LogicError(
            "a date outside the range of DATE", expected="1677-09-22 to 2262-04-11", got=f"{year}-{month}-{day}"
        )
    return days * _DAY_NS


def tod_of(hour: int, minute: int, second: int, millisecond: int) -> int:
    """Return the time of day, for CONCAT_TOD. Raises `LogicError` for a time that does not exist."""
    if not (0 <= hour < 24 and 0 <= minute < 60 and 0 <= second < 60 and 0 <= millisecond < 1000):
        raise LogicError(
            "a time of day that does not exist",
            expected="0 to 23 hours, 0 to 59 minutes and seconds, 0 to 999 ms",
            got=f"{hour}:{minute}:{second}, {millisecond} ms",
        )
    return (hour * 3600 + minute * 60 + second) * NS_PER_S + millisecond * NS_PER_MS


def dt_of(year: int, month: int, day: int, hour: int, minute: int, second: int, millisecond: int) -> int:
    """Return the date and time, for CONCAT_DT. Raises `LogicError` for one that does not exist."""
    ns = date_of(year, month, day) + tod_of(hour, minute, second, millisecond)
    if ns >= 2**63:
        raise LogicError("a date outside the range of DATE_AND_TIME", got=f"{year}-{month}-{day} {hour}:{minute}")
    return ns


def split_date(ns: int) -> tuple[int, int, int]:
    """Return year, month and day."""
    at = _moment(ns)
    return at.year, at.month, at.day


def split_tod(ns: int) -> tuple[int, int, int, int]:
    """Return hour, minute, second and millisecond of a time of day."""
    seconds, rest = divmod(ns % _DAY_NS, NS_PER_S)
    return seconds // 3600, seconds // 60 % 60, seconds % 60, rest // NS_PER_MS


def split_dt(ns: int) -> tuple[int, ...]:
    """Return year, month, day, hour, minute, second and millisecond."""
    return *split_date(ns), *split_tod(ns)


def day_of_week(ns: int) -> int:
    """Return the day of the week of a date: 0 for Sunday to 6 for Saturday."""
    return (ns // _DAY_NS + _THURSDAY) % 7


def date_text(ns: int) -> str:
    return f"D#{_moment(ns):%Y-%m-%d}"


def moment_text(ns: int) -> str:
    return f"DT#{_moment(ns):%Y-%m-%d-%H:%M:%S}"


def tod_text(ns: int) -> str:
    return f"TOD#{_moment(ns):%H:%M:%S}"


def _moment(ns: int) -> datetime:
    try:
        return _EPOCH + timedelta(microseconds=ns // 1000)
    except OverflowError as e:
        raise LogicError("a date outside the calendar", got=f"{ns} ns since 1970") from e

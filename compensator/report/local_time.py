"""Times of day for people, in this computer's zone in every view; recordings, messages and JSON stay in UTC."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from compensator.clock import NS, SystemClock


def here(time_ns: int) -> datetime:
    """Return a time in this computer's zone; recordings and messages stay in UTC.

    Parameters
    ----------
    time_ns : int
        ns since 1970 UTC.
    """
    return datetime.fromtimestamp(time_ns / NS, UTC).astimezone()


def zone(time: datetime) -> str:
    """Return the time zone of a local time with its offset from UTC.

    Examples
    --------
    >>> from datetime import timedelta, timezone
    >>> zone(datetime(2026, 1, 5, tzinfo=timezone(timedelta(hours=1), "CET"))), zone(datetime(2026, 1, 5, tzinfo=UTC))
    ('CET (UTC+01:00)', 'UTC')
    """
    name, ahead = f"{time:%Z}", f"{time:%z}"
    return "UTC" if name == "UTC" else f"{name} (UTC{ahead[:3]}:{ahead[3:5]})"


def shown(t_s: float) -> str:
    """Return a time, s since 1970 UTC, as date and time of day; a dash where it is missing."""
    return "–" if math.isnan(t_s) else f"{here(round(t_s * NS)):%Y-%m-%d %H:%M}"


def zone_at(t_s: float) -> str:
    """Return the zone that `shown` is in, such as `UTC`."""
    return "UTC" if math.isnan(t_s) else zone(here(round(t_s * NS)))


def today() -> str:
    """Return today's date in this computer's zone."""
    return f"{here(SystemClock().utc_ns()):%Y-%m-%d}"
